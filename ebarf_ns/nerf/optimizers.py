"""Optimizers, and learning rate schedules that follow a budget."""

from dataclasses import dataclass, field

import torch
from nerfstudio.engine.optimizers import OptimizerConfig
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from ebarf_ns.nerf.keyframe_adam import KeyframeAdam


@dataclass
class FusedAdamConfig(OptimizerConfig):
    """Adam with one pass over memory per step."""

    _target: type = torch.optim.Adam
    betas: tuple[float, float] = (0.9, 0.99)
    fused: bool = True


@dataclass
class KeyframeAdamConfig(OptimizerConfig):
    """Adam with a full-matrix second moment for the six numbers of a keyframe's correction, and for whole stretches."""

    _target: type = KeyframeAdam
    betas: tuple[float, float] = (0.9, 0.99)
    eps: float = 1e-3
    """Share of a keyframe's mean second moment that is added to each eigenvalue."""
    coupled: bool = True
    """Scale rotation and shift jointly, so that they are told apart; if False, scale each number separately."""
    stretches: bool = True
    """Also move whole stretches of the trajectory, as drift bends them; if False, move each keyframe alone."""


@dataclass
class BudgetDecayConfig(SchedulerConfig):
    """Exponential decay over the budget of the run, counted in steps or in seconds."""

    _target: type = field(default_factory=lambda: BudgetDecayScheduler)
    lr_final_ratio: float = 0.1
    """Ratio of the final to the initial learning rate."""


class BudgetDecay(LambdaLR):
    """Decays with ``progress``, the used fraction of the budget, which the trainer sets before every step."""

    progress: float = 0.0

    def __init__(self, optimizer: Optimizer, final_ratio: float):
        super().__init__(optimizer, lambda _: float(final_ratio**self.progress))


class BudgetDecayScheduler(Scheduler):
    """Creates :class:`BudgetDecay` schedules."""

    config: BudgetDecayConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> BudgetDecay:
        """The schedule of one optimizer."""
        return BudgetDecay(optimizer, self.config.lr_final_ratio)
