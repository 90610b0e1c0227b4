"""What steps the parameters: optimizers, and schedules that follow a budget."""

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
    """Adam with a second moment over the six numbers of a keyframe's correction, and of whole stretches'."""

    _target: type = KeyframeAdam
    betas: tuple[float, float] = (0.9, 0.99)
    eps: float = 1e-3
    """Share of a keyframe's mean second moment that is added to that of every direction."""
    coupled: bool = True
    """Scale rotation and shift together, so that what tells them apart is followed; else each number by itself."""
    stretches: bool = True
    """Move stretches of the trajectory too, as drift bends them; else each keyframe for itself alone."""


@dataclass
class BudgetDecayConfig(SchedulerConfig):
    """Exponential decay over the budget of the run, whether it is counted in steps or in seconds."""

    _target: type = field(default_factory=lambda: BudgetDecayScheduler)
    lr_final_ratio: float = 0.1
    """Learning rate at the end over that at the start."""


class BudgetDecay(LambdaLR):
    """Follows ``progress``, the used fraction of the budget, which the trainer sets before every step."""

    progress: float = 0.0

    def __init__(self, optimizer: Optimizer, final_ratio: float):
        super().__init__(optimizer, lambda _: float(final_ratio**self.progress))


class BudgetDecayScheduler(Scheduler):
    """Makes :class:`BudgetDecay`."""

    config: BudgetDecayConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> BudgetDecay:
        """The scheduler of one optimizer."""
        return BudgetDecay(optimizer, self.config.lr_final_ratio)
