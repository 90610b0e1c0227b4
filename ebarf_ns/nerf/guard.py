"""Guards against non-finite numbers: steps with bad gradients are skipped, and bad parameters end the training."""

from __future__ import annotations

from collections import deque
from typing import Any

import torch
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor, nn

from ebarf_ns.errors import TrainingError

_SKIPPED_IN_A_ROW, _BELIEVED = 10, 2
_SKIPPED_SHARE, _RECENT_STEPS = 0.01, 1000
_KNOWN, _BEYOND_REASON = 20, 1e4
_SMALL, _PARTS = 1 << 16, 64


class GuardedOptimizers(Optimizers):
    """Steps all groups, or none if any gradient is not finite or exceeds 10,000 times its usual norm.

    One bad batch must not spoil Adam's moments, which decay slowly. If gradients stay that large, they are accepted
    from the third on.
    """

    skipped = 0
    skipped_in_a_row = 0
    usual: Tensor | None = None
    """Running mean of each parameter's gradient norm, and the number of gradients, up to 99."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.recently_skipped: deque[bool] = deque(maxlen=_RECENT_STEPS)

    def guard_state(self) -> dict[str, Any]:
        """The state for a resumed training, as tensors and plain values."""
        return {
            "skipped_steps": self.skipped,
            "skipped_in_a_row": self.skipped_in_a_row,
            "recently_skipped": torch.tensor(self.recently_skipped, dtype=torch.bool),
            "usual_gradients": self.usual,
        }

    def load_guard_state(self, state: dict[str, Any]) -> None:
        """Restore :meth:`guard_state`; missing entries keep their initial values."""
        self.skipped = state.get("skipped_steps", 0)
        self.skipped_in_a_row = state.get("skipped_in_a_row", 0)
        self.recently_skipped.extend(state.get("recently_skipped", torch.zeros(0)).tolist())
        self.usual = state.get("usual_gradients")

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
        """Step, or skip the step; raises :class:`TrainingError` if too many steps are skipped."""
        parameters = [parameter for group in param_groups for parameter in self.parameters[group]]
        # A gradient scaler checks for overflow itself and lowers its scale. With gradient accumulation, no group may
        # be due.
        if grad_scaler.is_enabled() or not parameters or self._trusted(parameters):
            # A step in which the keyframes do not learn says nothing about their gradients.
            if all(one.grad is not None for one in self.parameters.get("camera_opt", ())):
                self.skipped_in_a_row = 0
            self.recently_skipped.append(False)
            super().optimizer_scaler_step_some(grad_scaler, param_groups)
            return
        self.skipped += 1
        self.skipped_in_a_row += 1
        self.recently_skipped.append(True)
        cause = "had gradients that are not finite, or 10,000 times their usual norm"
        if self.skipped_in_a_row >= _SKIPPED_IN_A_ROW:
            raise TrainingError(f"{_SKIPPED_IN_A_ROW} training steps in a row {cause}")
        if sum(self.recently_skipped) > _SKIPPED_SHARE * _RECENT_STEPS:
            raise TrainingError(f"{sum(self.recently_skipped)} of the last {len(self.recently_skipped)} steps {cause}")

    def check_parameters(self, step: int) -> None:
        """Raise :class:`TrainingError` if a parameter is not finite; of large ones, only a part is checked per step."""
        sums = []
        for parameter in (one for group in self.parameters.values() for one in group):
            flat = parameter.detach().reshape(-1)
            if len(flat) > _SMALL:
                flat = flat.chunk(_PARTS)[step % _PARTS]
            sums.append(flat.float().abs().amax() if len(flat) else flat.new_zeros((), dtype=torch.float32))
        if not bool(torch.stack(sums).isfinite().all()):
            raise TrainingError("parameters are no longer finite")
