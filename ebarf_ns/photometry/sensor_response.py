"""What is not known of an event sensor, and found out in training."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

_MOST_HALF_LOG_RATIO = math.log(3) / 2


class Response(NamedTuple):
    """By how much log brightness changes for one event."""

    threshold_on: Tensor | float
    threshold_off: Tensor | float


class SensorResponse(nn.Module):
    """Thresholds whose ratio is learned.

    Nominal thresholds are seldom those in force, and the ratio of on and off matters: where brightness comes back to
    what it was, events must add up to nothing. Not ``learned``, the thresholds stand.

    The ratio may not explain a recording away: where all events are of one polarity, a constant image would do if their
    threshold were 0. It stays within a third and three times the nominal one.
    """

    def __init__(self, threshold_on: float, threshold_off: float, learned: bool = True):
        super().__init__()
        self.nominal = Response(threshold_on, threshold_off)
        self.learned = learned
        if learned:
            self.half_log_ratio = nn.Parameter(torch.zeros(()))

    def forward(self) -> Response:
        """What the thresholds are taken to be by now."""
        if not self.learned:
            return self.nominal
        uneven = torch.exp(_MOST_HALF_LOG_RATIO * torch.tanh(self.half_log_ratio / _MOST_HALF_LOG_RATIO))
        return Response(self.nominal.threshold_on * uneven, self.nominal.threshold_off / uneven)
