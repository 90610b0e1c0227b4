"""What is not known of an event sensor, and found out in training."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

_MOST_HALF_LOG_RATIO, _MOST_LEAK_HZ = math.log(3) / 2, 1.0


class Response(NamedTuple):
    """How a sensor's events go with log brightness."""

    threshold_on: Tensor | float
    threshold_off: Tensor | float
    leak_hz: Tensor | float
    """Events a second that report "brighter" where nothing changes; "darker" where negative."""


class SensorResponse(nn.Module):
    """Thresholds whose ratio is learned, and the rate at which pixels leak.

    Nominal thresholds are seldom those in force, and the ratio of on and off matters: where brightness comes back to
    what it was, events must add up to nothing. And pixels leak: with nothing to see they report "brighter" now and then
    (Nozaki & Delbruck 2017). Not ``learned``, the thresholds stand and nothing leaks.

    Neither may explain a recording away: where all events are of one polarity, a constant image would do if their
    threshold were 0, or if all were leaks. The ratio stays within a third and three times the nominal one, and the
    leak within one event a second.
    """

    def __init__(self, threshold_on: float, threshold_off: float, learned: bool = True):
        super().__init__()
        self.nominal = Response(threshold_on, threshold_off, 0.0)
        self.learned = learned
        if learned:
            self.half_log_ratio = nn.Parameter(torch.zeros(()))
            self.leak_hz = nn.Parameter(torch.zeros(()))

    def forward(self) -> Response:
        """What the sensor is taken to be by now."""
        if not self.learned:
            return self.nominal
        uneven = torch.exp(_MOST_HALF_LOG_RATIO * torch.tanh(self.half_log_ratio / _MOST_HALF_LOG_RATIO))
        leak_hz = _MOST_LEAK_HZ * torch.tanh(self.leak_hz / _MOST_LEAK_HZ)
        return Response(self.nominal.threshold_on * uneven, self.nominal.threshold_off / uneven, leak_hz)
