"""What is not known of an event sensor, and found out in training."""

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
    """By how much log brightness changes for one event."""

    threshold_on: Tensor | float
    threshold_off: Tensor | float


class SensorResponse(nn.Module):
    """Thresholds whose ratio is known up to a relative ``deviation``, and learned within it; at 0, they stand.

    The ratio of on and off matters: where brightness comes back to what it was, events must add up to nothing. But a
    camera that turns one way sees any ratio explained by brightness that rises or falls all along its way, so that a
    ratio learned without a bound leaves the truth: the further it is off, the better the ramp fits. What was counted in
    the recording holds it: leaving that costs :meth:`prior`, and 2 deviations is the end.

    The photoreceptor is a low pass of first order, its time constant inversely proportional to the intensity (Low & Lee
    2024). ``time_constant_us`` is that at the mean log brightness; None: learned. At 0 nothing is computed.
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
        # A running sum and its weight: the mean is known as soon as there is anything to take it of.
        self.register_buffer("seen_brightness", torch.zeros(2))
        self.seen_brightness: Tensor

    @property
    def learns_ratio(self) -> bool:
        """Whether the ratio of the thresholds is refined."""
        return self.deviation > 0

    def forward(self) -> Response:
        """What the thresholds are taken to be by now."""
        if not self.learns_ratio:
            return self.nominal
        bounded = _MOST_DEVIATIONS * torch.tanh(self.deviations / _MOST_DEVIATIONS)
        uneven = torch.exp(self.deviation / 2 * bounded)
        return Response(self.nominal.threshold_on * uneven, self.nominal.threshold_off / uneven)

    def begin_step(self, step: int) -> None:
        """Let the time constant learn in every eighth step, from 0 up: its gradient takes that of all rays."""
        if not self.learns_time_constant:
            return
        learns = step % _LEARN_EVERY == 0
        if learns:
            # Not where it is used: there, at 0, a clamp has no gradient.
            with torch.no_grad():
                self.time_constant.clamp_(min=0)
        self.time_constant.requires_grad_(learns)

    @property
    def time_constant_us(self) -> Tensor:
        """Of the photoreceptor, at the mean log brightness."""
        return self.time_constant * _UNIT_US

    @property
    def delays(self) -> bool:
        """Whether there is a delay that matters, or one to learn in this step."""
        return self.time_constant.requires_grad or bool(self.time_constant_us > _LEAST_US)

    def delay_us(self, brightness: Float[Tensor, "rays"]) -> Float[Tensor, "rays"]:
        """How long ago a pixel that looks at that log brightness saw what it reports: to first order, a time constant.

        At most 8 times that at the mean brightness: the dark current keeps pixels from becoming ever slower.
        """
        here = torch.stack([brightness.mean(), torch.ones_like(self.seen_brightness[1])])
        seen = self.seen_brightness.lerp(here, _LEVEL_SHARE)
        if self.training:
            self.seen_brightness.copy_(torch.where(here.isfinite().all(), seen, self.seen_brightness))
        mean = seen[0] / seen[1]
        slower = (mean - brightness).exp().clamp(max=_SLOWEST)
        return self.time_constant_us * slower

    def prior(self) -> Tensor:
        """Half the squared number of deviations from the nominal ratio."""
        return self.deviations.square() / 2


def thresholds_of_ratio(ratio: float, mean: float) -> tuple[float, float]:
    """Thresholds (on, off) with the given ratio on / off and geometric mean."""
    return mean * math.sqrt(ratio), mean / math.sqrt(ratio)
