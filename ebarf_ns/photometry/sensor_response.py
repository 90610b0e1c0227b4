"""Sensor parameters learned in training: threshold ratio and photoreceptor time constant."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from jaxtyping import Float

_MOST_DEVIATIONS = 2.0
_UNIT_US = 8000.0
_LEARN_EVERY = 8
_LEAST_US = 20.0
_SLOWEST = 8.0
_LEVEL_SHARE = 0.05


class Response(NamedTuple):
    """Contrast thresholds: change of log brightness per event."""

    threshold_on: Tensor | float
    threshold_off: Tensor | float


class SensorResponse(nn.Module):
    """Thresholds whose ratio is known up to a relative ``deviation`` and learned within it; fixed at 0.

    The ON/OFF ratio matters: where brightness returns to an earlier value, events must sum to zero. But for a camera
    that pans one way, any ratio can be explained by a brightness ramp along the pan, and without a bound the learned
    ratio drifts away: the further it is off, the better the ramp fits. The ratio counted in the recording therefore
    acts as a prior (:meth:`prior`) and limits the learned one to 2 deviations.

    The photoreceptor is a first-order low-pass filter whose time constant is inversely proportional to intensity (Low &
    Lee 2024). ``time_constant_us`` applies at the mean log brightness; None: learned; 0: no delay is computed.
    """

    def __init__(
        self, threshold_on: float, threshold_off: float, deviation: float = 0.0, time_constant_us: float | None = 0.0
    ):
        super().__init__()
        self.nominal = Response(threshold_on, threshold_off)
        self.deviation = deviation
        if deviation:
            self.deviations = nn.Parameter(torch.zeros(()))
        self.learns_time_constant = time_constant_us is None
        start = torch.tensor((time_constant_us or 0.0) / _UNIT_US)
        if self.learns_time_constant:
            self.time_constant = nn.Parameter(start)
        else:
            self.register_buffer("time_constant", start)
        self.time_constant: Tensor
        # Exponential moving sum and its weight, which give an unbiased mean from the first step.
        self.register_buffer("seen_brightness", torch.zeros(2))
        self.seen_brightness: Tensor

    @property
    def learns_ratio(self) -> bool:
        """Whether the threshold ratio is learned."""
        return self.deviation > 0

    def forward(self) -> Response:
        """The current thresholds."""
        if not self.learns_ratio:
            return self.nominal
        bounded = _MOST_DEVIATIONS * torch.tanh(self.deviations / _MOST_DEVIATIONS)
        root_ratio = torch.exp(self.deviation / 2 * bounded)
        return Response(self.nominal.threshold_on * root_ratio, self.nominal.threshold_off / root_ratio)

    def begin_step(self, step: int) -> None:
        """Enable learning of the time constant in every eighth step, since its gradient needs those of all rays."""
        if not self.learns_time_constant:
            return
        learns = step % _LEARN_EVERY == 0
        if learns:
            # Clamped here, not where it is used: a clamp in the graph has no gradient at 0.
            with torch.no_grad():
                self.time_constant.clamp_(min=0)
        self.time_constant.requires_grad_(learns)

    @property
    def time_constant_us(self) -> Tensor:
        """Time constant of the photoreceptor at the mean log brightness."""
        return self.time_constant * _UNIT_US

    @property
    def delays(self) -> bool:
        """Whether the delay is significant or learned in this step."""
        return self.time_constant.requires_grad or bool(self.time_constant_us > _LEAST_US)

    def delay_us(self, brightness: Float[Tensor, "rays"]) -> Float[Tensor, "rays"]:
        """Delay of a pixel at a given log brightness, to first order its time constant.

        At most 8 times that at the mean brightness, since the dark current bounds the time constant.
        """
        here = torch.stack([brightness.mean(), torch.ones_like(self.seen_brightness[1])])
        seen = self.seen_brightness.lerp(here, _LEVEL_SHARE)
        if self.training:
            self.seen_brightness.copy_(torch.where(here.isfinite().all(), seen, self.seen_brightness))
        mean = seen[0] / seen[1]
        slower = (mean - brightness).exp().clamp(max=_SLOWEST)
        return self.time_constant_us * slower

    def prior(self) -> Tensor:
        """Half the squared deviation from the nominal ratio, in standard deviations."""
        return self.deviations.square() / 2


def thresholds_of_ratio(ratio: float, mean: float) -> tuple[float, float]:
    """Thresholds (on, off) with the given ratio on / off and geometric mean."""
    return mean * math.sqrt(ratio), mean / math.sqrt(ratio)
