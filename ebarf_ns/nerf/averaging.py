"""The mean of the last steps' parameters, which chance moves less than the last ones (Polyak and Juditsky, 1992)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn


class Averaging:
    """Follows parameters with their mean over the last tenth of the steps, over ``steps`` of them at most."""

    def __init__(self, parameters: list[nn.Parameter], steps: int):
        self.parameters, self.steps = parameters, steps
        self.mean: list[Tensor] | None = None

    def follow(self, steps_done: int) -> None:
        """Take in the parameters after a step."""
        if self.steps == 1:
            self.mean = None
            return
        share = max(10 / (steps_done + 9), 1 / self.steps)
        live = [parameter.detach() for parameter in self.parameters]
        if self.mean is None:
            self.mean = [parameter.clone() for parameter in live]
        for mean, parameter in zip(self.mean, live, strict=True):
            mean.lerp_(parameter, share)

    def begin_from(self, trained: list[Tensor] | None) -> None:
        """Take the parameters as they are for the mean, and those ``trained`` in their place, where there are any."""
        self.mean = [parameter.detach().clone() for parameter in self.parameters]
        self._put(trained or self.mean)

    @contextmanager
    def shown(self) -> Iterator[None]:
        """The parameters at their mean, for as long as the block lasts."""
        live = [parameter.detach().clone() for parameter in self.parameters]
        try:
            self._put(self.mean or live)
            yield
        finally:
            self._put(live)

    @torch.no_grad()
    def _put(self, values: list[Tensor]) -> None:
        for parameter, value in zip(self.parameters, values, strict=True):
            parameter.copy_(value)
