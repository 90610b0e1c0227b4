"""A running average of the parameters over the last steps, less noisy than the last step's (Polyak, Juditsky 1992)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn


class Averaging:
    """A running mean of parameters over about the last tenth of the steps, at most ``steps`` of them."""

    def __init__(self, parameters: list[nn.Parameter], steps: int):
        self.parameters, self.steps = parameters, steps
        self.mean: list[Tensor] | None = None

    def follow(self, steps_done: int) -> None:
        """Update the mean after a training step."""
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
        """Use the current parameters as the mean, and replace them with ``trained``, if given."""
        self.mean = [parameter.detach().clone() for parameter in self.parameters]
        self._put(trained or self.mean)

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Replace the parameters by their mean while the block runs."""
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
