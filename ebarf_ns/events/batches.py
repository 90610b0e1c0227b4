"""Batches of event pairs: held-out time windows, per-batch random numbers, prefetching."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ebarf_ns.events.pairs import EventPairs

if TYPE_CHECKING:
    from jaxtyping import Bool, Int64


@dataclass(frozen=True)
class HeldoutBlocks:
    """``blocks`` evenly spaced windows that together cover ``share`` of the time from ``start_us`` to ``end_us``."""

    start_us: int
    end_us: int
    share: float
    blocks: int = 20

    def contain(self, t_us: Int64[np.ndarray, "*batch"]) -> Bool[np.ndarray, "*batch"]:
        """Whether each time lies in a window."""
        phase = (t_us - self.start_us) / max(self.end_us - self.start_us, 1) * self.blocks % 1
        return np.abs(phase - 0.5) < self.share / 2

    def middle_s(self, number: int) -> float:
        """Centre of a window, in seconds."""
        return round((self.start_us + (number + 0.5) * (self.end_us - self.start_us) / self.blocks) * 1e-6, 3)

    def number(self, t_us: Int64[np.ndarray, "*batch"]) -> Int64[np.ndarray, "*batch"]:
        """Index of the window that contains each time or is nearest to it."""
        return ((t_us - self.start_us) * self.blocks // max(self.end_us - self.start_us, 1)).clip(0, self.blocks - 1)

    def training(self, pairs: EventPairs) -> Bool[np.ndarray, "pairs"]:
        """Pairs that begin and end outside the windows; their sums still include the events in between."""
        return ~(self.contain(pairs.t0_us) | self.contain(pairs.t1_us))

    def heldout(self, pairs: EventPairs) -> Bool[np.ndarray, "pairs"]:
        """Pairs that end in a window."""
        return self.contain(pairs.t1_us)


class DrawAhead:
    """Prefetches the next ``ahead`` batches, numbered ``stride`` apart, in background threads."""

    def __init__(self, draw: Callable[[int], EventPairs], stride: int = 1, ahead: int = 1):
        self._draw, self._stride, self._ahead = draw, stride, ahead
        self._workers = ThreadPoolExecutor(ahead, thread_name_prefix="event pairs")
        self._drawn: dict[int, Future[EventPairs]] = {}

    def batch(self, number: int) -> EventPairs:
        """Return batch ``number``; an unexpected number is drawn on demand."""
        wanted = [number + k * self._stride for k in range(self._ahead + 1)]
        self._drawn = {k: self._drawn.get(k) or self._workers.submit(self._draw, k) for k in wanted}
        return self._drawn.pop(number).result()


def batch_random(seed: int, batch: int) -> np.random.Generator:
    """Counter-based random generator for batch number ``batch`` of ``seed``, so that batches are independent."""
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 0, batch]))
