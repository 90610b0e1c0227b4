"""What steps the parameters: optimizers, schedules that follow a budget, and a guard against bad gradients."""

from dataclasses import dataclass, field
from typing import Any

import torch
from nerfstudio.engine.optimizers import OptimizerConfig, Optimizers
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from ebarf_ns.errors import TrainingError
from ebarf_ns.nerf.keyframe_adam import KeyframeAdam

_SKIPPED_IN_A_ROW, _BELIEVED = 10, 2
_KNOWN, _BEYOND_REASON = 20, 1e4


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


class GuardedOptimizers(Optimizers):
    """Steps all groups, or none where any gradient is not finite, or 10,000 times its usual norm.

    One bad batch must not poison Adam's moments, which forget slowly. Gradients that stay so large are taken from the
    third on: then that is their norm.
    """

    skipped = 0
    skipped_in_a_row = 0
    usual: Tensor | None = None
    """Running mean of the norm of each parameter's gradient, and the number of gradients, up to 99."""

    def _trusted(self, parameters: list[nn.Parameter]) -> bool:
        zero = torch.zeros((), device=parameters[0].device)
        norms = torch.stack([zero if one.grad is None else one.grad.float().norm() for one in parameters])
        if self.usual is None or self.usual.shape[1] != len(parameters):
            self.usual = torch.zeros(2, len(parameters))
        usual, count = self.usual.to(norms)
        finite = bool(norms.isfinite().all())
        beyond = (count >= _KNOWN) & (norms > _BEYOND_REASON * usual)
        if finite and (self.skipped_in_a_row >= _BELIEVED or not bool(beyond.any())):
            seen = norms > 0
            usual = usual.where(~seen, usual.lerp(norms, 1 / (count + 1).clamp(max=100)))
            self.usual = torch.stack([usual, (count + seen).clamp(max=99)])
            return True
        return False

    def optimizer_scaler_step_some(self, grad_scaler: Any, param_groups: list[str]) -> None:
        """Raises :class:`TrainingError` when too many steps in a row had to be skipped."""
        parameters = [parameter for group in param_groups for parameter in self.parameters[group]]
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        # A gradient scaler looks for overflow itself, and lowers its scale when it finds it. Accumulating gradients, no
        # group may be due.
        if grad_scaler.is_enabled() or not gradients or self._trusted(parameters):
            # A step in which the keyframes do not learn says nothing of their gradients.
            if all(one.grad is not None for one in self.parameters.get("camera_opt", ())):
                self.skipped_in_a_row = 0
            super().optimizer_scaler_step_some(grad_scaler, param_groups)
            return
        self.skipped += 1
        self.skipped_in_a_row += 1
        if self.skipped_in_a_row >= _SKIPPED_IN_A_ROW:
            raise TrainingError(f"{_SKIPPED_IN_A_ROW} training steps in a row had gradients that are not finite")
