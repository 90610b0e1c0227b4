"""What is not known of an event sensor, and found out in training."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

_MOST_DEVIATIONS = 2.0


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
    """

    def __init__(self, threshold_on: float, threshold_off: float, deviation: float = 0.0):
        super().__init__()
        self.nominal = Response(threshold_on, threshold_off)
        self.deviation = deviation
        if deviation:
            self.deviations = nn.Parameter(torch.zeros(()))

    @property
    def learned(self) -> bool:
        """Whether there is anything to learn."""
        return self.deviation > 0

    def forward(self) -> Response:
        """What the thresholds are taken to be by now."""
        if not self.learned:
            return self.nominal
        bounded = _MOST_DEVIATIONS * torch.tanh(self.deviations / _MOST_DEVIATIONS)
        uneven = torch.exp(self.deviation / 2 * bounded)
        return Response(self.nominal.threshold_on * uneven, self.nominal.threshold_off / uneven)

    def prior(self) -> Tensor:
        """Half the squared number of deviations from the nominal ratio."""
        return self.deviations.square() / 2


def thresholds_of_ratio(ratio: float, mean: float) -> tuple[float, float]:
    """Thresholds (on, off) with the given ratio on / off and geometric mean."""
    return mean * math.sqrt(ratio), mean / math.sqrt(ratio)
