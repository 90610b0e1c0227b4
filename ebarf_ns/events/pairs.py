"""Pairs of events at one pixel: what the event generation model (Eq. 1) says something about.

Between two events of a pixel, the log brightness changed by the sum of what the events after the first one report.
Events are kept ordered by pixel, then time, so that "n steps back" is a subtraction of indices; a running sum of
polarities over that order gives the sum between any two of them. Batches are a function of (seed, batch number) alone.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int32, Int64, UInt8
from numba import njit

from ebarf_ns.errors import RecordingError
from ebarf_ns.events.recording import Recording


@dataclass(frozen=True)
class EventPairs:
    """Pairs of events: the pixel, both times, the sum of polarities in (t0, t1] and the number of events in it."""

    pixel: Int64[np.ndarray, "pairs"]
    """Row-major index y * width + x."""
    t0_us: Int64[np.ndarray, "pairs"]
    t1_us: Int64[np.ndarray, "pairs"]
    polarity_sum: Int64[np.ndarray, "pairs"]
    event_count: Int64[np.ndarray, "pairs"]

    def __len__(self) -> int:
        return len(self.pixel)


@dataclass(frozen=True)
class PairIndex:
    """Events ordered by pixel and time, ready to draw pairs any number of steps apart, uniformly over such pairs."""

    pixel: Int32[np.ndarray, "events"]
    t_us: Int64[np.ndarray, "events"]
    running_polarity: Int32[np.ndarray, "events"]
    """Sum of all polarities up to and including each event; meaningful as a difference within a pixel."""
    rank: Int32[np.ndarray, "events"]
    """Number of events of the same pixel before each event in the whole recording."""
    ends: Int64[np.ndarray, "ends"]
    """Events that may end a pair, those with the most predecessors first."""
    pairs_by_steps: Int64[np.ndarray, "steps"]
    """How many events have at least n predecessors, n = 0, 1, ...: the number of pairs n steps apart."""

    @property
    def max_steps(self) -> int:
        """The longest pair there is, in steps."""
        return len(self.pairs_by_steps) - 1

    def sample(self, steps: Int64[np.ndarray, "pairs"], random: np.random.Generator) -> EventPairs:
        """One pair for each entry of ``steps``, uniform over all pairs that many steps apart."""
        steps = np.minimum(steps, self.max_steps)
        last = self.ends[random.integers(self.pairs_by_steps[steps])]
        return self.pairs(last - steps, last)

    def pairs(self, first: Int64[np.ndarray, "pairs"], last: Int64[np.ndarray, "pairs"]) -> EventPairs:
        """The pairs between given positions of the order, which must lie in the same pixel."""
        return EventPairs(
            self.pixel[last].astype(np.int64),
            self.t_us[first],
            self.t_us[last],
            (self.running_polarity[last] - self.running_polarity[first]).astype(np.int64),
            (self.rank[last] - self.rank[first]).astype(np.int64),
        )


def split_pairs(
    recording: Recording, width: int, height: int, heldout: Bool[np.ndarray, "events"]
) -> tuple[PairIndex, PairIndex]:
    """Index the pairs for training and the pairs held out.

    Training pairs begin and end at events outside ``heldout`` (their sums count the events in between all the same);
    held-out pairs end at an event inside it. Raises :class:`RecordingError` when no pixel has two training events.
    """
    pixel = recording.y.astype(np.int32) * width + recording.x
    order, first_of_pixel = _order_by_pixel(pixel, width * height)
    pixel = pixel[order]
    rank = (np.arange(len(order)) - first_of_pixel[pixel]).astype(np.int32)
    columns = (pixel, recording.t_us[order], np.cumsum(recording.polarity[order], dtype=np.int32), rank)
    heldout = heldout[order]
    kept_pixel, kept_t_us, kept_polarity, kept_rank = (column[~heldout] for column in columns)
    predecessors = _predecessors(kept_pixel)
    if not (predecessors > 0).any():
        raise RecordingError(f"none of the {len(recording):,} events has another one at its pixel: no pair to train on")
    return (
        PairIndex(
            kept_pixel,
            kept_t_us,
            kept_polarity,
            kept_rank,
            *_by_predecessors(predecessors, np.arange(len(predecessors))),
        ),
        PairIndex(*columns, *_by_predecessors(rank[heldout], np.flatnonzero(heldout))),
    )


def _by_predecessors(predecessors: np.ndarray, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    histogram = np.bincount(predecessors, minlength=1)
    at_least = histogram[::-1].cumsum()[::-1]
    return positions[np.argsort(-predecessors, kind="stable")], at_least.astype(np.int64)


def _predecessors(pixel: np.ndarray) -> np.ndarray:
    starts = np.flatnonzero(np.r_[True, pixel[1:] != pixel[:-1]]) if len(pixel) else np.zeros(0, np.int64)
    return np.arange(len(pixel)) - np.repeat(starts, np.diff(np.r_[starts, len(pixel)]))


@njit(cache=True, nogil=True)
def _order_by_pixel(pixel: np.ndarray, pixel_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Stable counting sort: the order, and the position at which each pixel begins."""
    first = np.zeros(pixel_count + 1, np.int64)
    for i in range(len(pixel)):
        first[pixel[i] + 1] += 1
    for p in range(pixel_count):
        first[p + 1] += first[p]
    free = first[:-1].copy()
    order = np.empty(len(pixel), np.int64)
    for i in range(len(pixel)):
        order[free[pixel[i]]] = i
        free[pixel[i]] += 1
    return order, first[:-1]


def heldout_blocks(t_us: Int64[np.ndarray, "events"], share: float, blocks: int = 20) -> Bool[np.ndarray, "events"]:
    """Mark the events in ``blocks`` evenly spaced windows that together cover ``share`` of the recording's span."""
    phase = (t_us - t_us[0]) / max(int(t_us[-1] - t_us[0]), 1) * blocks % 1
    return np.abs(phase - 0.5) < share / 2


def draw_steps(count: int, longest: int, random: np.random.Generator) -> Int64[np.ndarray, "pairs"]:
    """Steps between the events of a pair: log-uniform over 1 to ``longest``."""
    return np.exp(random.random(count) * np.log(longest + 1)).astype(np.int64)


def batch_random(seed: int, batch: int) -> np.random.Generator:
    """The random numbers of batch number ``batch`` of ``seed``: counter-based, so that no batch depends on another."""
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 0, batch]))


def accumulate(recording: Recording, width: int, height: int) -> UInt8[np.ndarray, "height width"]:
    """A grey picture of the events: mid-grey where there are none, brighter or darker by the polarities' sum."""
    picture = np.zeros(width * height, np.int64)
    np.add.at(picture, recording.y.astype(np.int64) * width + recording.x, recording.polarity)
    return (128 + np.clip(32 * picture, -128, 127)).astype(np.uint8).reshape(height, width)
