"""Pairs of events at one pixel: what the event generation model (Eq. 1) says something about.

Between two events of a pixel, the log brightness changed by the sum of what the events after the first one report; and
while the pixel is silent, by less than a threshold more. Events are kept ordered by pixel, then time, so that "n steps
back" is a subtraction of indices; a running sum of polarities over that order gives the sum between any two of them.
Batches are a function of (seed, batch number) alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int64, Shaped

EVENT = np.dtype([("t_us", "<i8"), ("running_polarity", "<i4")])
"""Side by side, so that looking an event up touches one place in memory."""
_ROUNDS = 100
_MOST_MISSED = 3.0
_BLANK_REACH, _VARIANCE_OF_BLANK = 0.1, 30.0
_VARIANCE_OF_MISSED = 8.0
"""Of a missed event, over that of one with a threshold of usual spread (5 %): 0.3 against 0.035 squared thresholds."""


@dataclass(frozen=True)
class EventPairs:
    """Pairs of times at a pixel: both, the sum of polarities in (t0, t1] and the number of events in it.

    An event begins each pair, and another one ends it, or else a time at which the pixel is silent. Pairs of blank
    pixels lie at one time and two pixels.
    """

    pixel: Int64[np.ndarray, "pairs"]
    """Row-major index y * width + x."""
    pixel_before: Int64[np.ndarray, "pairs"]
    """Where a pair begins: at the same pixel but for pairs of blank pixels."""
    t0_us: Int64[np.ndarray, "pairs"]
    t1_us: Int64[np.ndarray, "pairs"]
    polarity_sum: Float[np.ndarray, "pairs"]
    event_count: Float[np.ndarray, "pairs"]
    """With an estimate of the events that the pixel was blind for, both are no whole numbers."""
    variance: Float[np.ndarray, "pairs"]
    """Of the change that they report, up to a factor: one for each event, and much more for each one estimated."""
    silent: Bool[np.ndarray, "pairs"]
    """Whether they end between events: the change is what was reported, give or take a threshold."""

    def __len__(self) -> int:
        return len(self.pixel)

    @property
    def duration_us(self) -> Int64[np.ndarray, "pairs"]:
        """Time between both."""
        return self.t1_us - self.t0_us

    def select(self, which: slice | Bool[np.ndarray, "pairs"]) -> EventPairs:
        """The pairs at a slice or mask."""
        return EventPairs(*(getattr(self, column.name)[which] for column in fields(self)))


@dataclass(frozen=True)
class PairIndex:
    """Events ordered by pixel and time, ready to draw pairs any number of steps apart, uniformly over such pairs
    but for those of hot pixels, which are left out.

    Takes 12 bytes an event and 24 a pixel, in memory or in a file.
    """

    events: Shaped[np.ndarray, "events"]
    """``t_us``, and ``running_polarity``: the sum of a pixel's polarities up to and including each event."""
    first: Int64[np.ndarray, "pixels+1"]
    """Where each pixel's events begin."""
    busiest: Int64[np.ndarray, "pixels"]
    """Pixels, those with the most events first but for the hot ones, which come last and count for nothing."""
    events_before: Int64[np.ndarray, "pixels+1"]
    """Number of events of all the pixels before each place of ``busiest``."""
    responsive: Int64[np.ndarray, "responsive"]
    """Pixels whose silence means something: neither hot nor dead."""

    @cached_property
    def blank(self) -> Int64[np.ndarray, "blank"]:
        """Responsive pixels that never fire."""
        return self.responsive[np.diff(self.first)[self.responsive] == 0]

    @cached_property
    def _is_blank(self) -> Bool[np.ndarray, "pixels"]:
        found = np.zeros(len(self.first) - 1, bool)
        found[self.blank] = True
        return found

    @property
    def max_steps(self) -> int:
        """The longest pair there is, in steps."""
        return int(self.events_before[1]) - 1

    def count(self, steps: Int64[np.ndarray, "*batch"]) -> Int64[np.ndarray, "*batch"]:
        """The number of pairs that many steps apart."""
        return self._count(steps)[1]

    @cached_property
    def _less_events(self) -> Int64[np.ndarray, "pixels"]:
        """Minus the number of events of each of ``busiest``, which rises."""
        return -np.diff(self.events_before)

    @cached_property
    def _counting_pixels(self) -> int:
        """Number of pixels that have events and are not hot: the first of ``busiest``."""
        return int(np.count_nonzero(self._less_events))

    def _count(self, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels that have pairs that many steps apart, which are the first of ``busiest``, and the pairs in them."""
        pixels = np.searchsorted(self._less_events, -steps)
        return pixels, self.events_before[pixels] - steps * pixels

    @property
    def hot_pixels(self) -> int:
        """Number of pixels that are left out for being far busier than usual."""
        return int(np.count_nonzero(np.diff(self.first))) - self._counting_pixels

    def without(self, pixels: Bool[np.ndarray, "pixels"]) -> PairIndex:
        """The same events, those of some pixels counting for nothing."""
        counts = np.zeros(len(pixels), np.int64)
        counts[self.busiest] = -self._less_events
        return counting(self.events, self.first, np.where(pixels, 0, counts), self.responsive[~pixels[self.responsive]])

    def with_hot_pixels(self) -> PairIndex:
        """The same events, those of hot pixels counting like all others."""
        counts = np.diff(self.first)
        hot = np.setdiff1d(np.nonzero(counts)[0], self.responsive)
        return counting(self.events, self.first, counts, np.union1d(self.responsive, hot))

    def draw(
        self, steps: Int64[np.ndarray, "pairs"], random: np.random.Generator, refractory_us: int = 0
    ) -> EventPairs:
        """One pair for each entry of ``steps`` (at most the longest there is), uniform over all so many steps apart.

        A pixel that is blind for ``refractory_us`` after each event compares with what it sees then (Low & Lee 2023):
        pairs begin so much later, and what it missed in between goes by the events before and after.
        """
        steps = np.minimum(steps, self.max_steps)
        pixels, pairs = self._count(steps)
        order = (self.events_before, self.busiest, self.first, self.events)
        pixel, *times_and_sums = _look_up(random.integers(pairs), steps, pixels, *order, refractory_us)
        return EventPairs(pixel, pixel, *times_and_sums, silent=np.zeros(len(pixel), bool))

    def draw_silent(
        self, count: int, longest: int, span_us: tuple[int, int], random: np.random.Generator, refractory_us: int = 0
    ) -> EventPairs:
        """Pairs that end at any time within the span, and begin with an event, 0 to ``longest`` of them before.

        Uniform over time and the ``responsive`` pixels. While a pixel has not fired yet, or where it never does, a pair
        begins at any time before.
        """
        pixel = self.responsive[random.integers(len(self.responsive), size=count)]
        t1_us = random.integers(span_us[0], span_us[1], size=count, endpoint=True)
        before_us = random.integers(span_us[0], t1_us, endpoint=True)
        steps = draw_steps(count, longest + 1, random) - 1
        columns = _look_back(pixel, t1_us, before_us, steps, self.first, self.events, refractory_us)
        return EventPairs(pixel, pixel, *columns, silent=np.ones(count, bool))

    def draw_blank(self, count: int, width: int, span_us: tuple[int, int], random: np.random.Generator) -> EventPairs:
        """Pairs of ``blank`` pixels at one time, a tenth of the sensor's width apart (standard deviation).

        What no pixel has ever fired at is taken as one surface of one brightness, loosely: the variance is that of 30
        events. Fewer than ``count``, as many have a pixel that fires at their other end.
        """
        if not len(self.blank):
            count = 0
        pixel = self.blank[random.integers(max(len(self.blank), 1), size=count)]
        away = np.rint(random.normal(0, _BLANK_REACH * width, (2, count))).astype(np.int64)
        x, y = pixel % width + away[0], pixel // width + away[1]
        inside = (x >= 0) & (x < width) & (y >= 0) & (y * width + x < len(self._is_blank))
        other = np.where(inside, y * width + x, pixel)
        t_us, zeros = random.integers(*span_us, size=count, endpoint=True), np.zeros(count)
        variance, silent = np.full(count, _VARIANCE_OF_BLANK), zeros.astype(bool)
        pairs = EventPairs(pixel, other, t_us, t_us, zeros, zeros, variance, silent)
        return pairs.select(inside & self._is_blank[other])

    def draw_accepted(
        self,
        count: int,
        longest: int,
        random: np.random.Generator,
        accepted: Callable[[EventPairs], Bool[np.ndarray, "pairs"]],
        refractory_us: int = 0,
    ) -> EventPairs:
        """``count`` pairs that ``accepted`` lets through, 1 to ``longest`` steps apart, log-uniformly.

        Fewer, possibly none, where a hundred times as many drawn at random hold no more.
        """
        found: list[EventPairs] = []
        missing = count
        while missing and len(found) < _ROUNDS:
            # As many as are likely to be enough, in later rounds too: few may be accepted.
            drawn = self.draw(draw_steps(min(2 * missing, count), longest, random), random, refractory_us)
            found.append(drawn.select(accepted(drawn)).select(slice(missing)))
            missing -= len(found[-1])
        return joined(found)


def joined(parts: Sequence[EventPairs]) -> EventPairs:
    """Pairs one after the other."""
    return EventPairs(*(np.concatenate([getattr(part, c.name) for part in parts]) for c in fields(EventPairs)))


@njit(cache=True, nogil=True)
def _look_up(number, steps, pixels, events_before, busiest, first, events, refractory_us):
    """What :class:`EventPairs` holds of pair ``number`` among those ``steps`` apart, counted along ``busiest``."""
    pixel = np.empty(len(number), np.int64)
    t0_us, t1_us = np.empty(len(number), np.int64), np.empty(len(number), np.int64)
    total, count, variance = np.empty(len(number)), np.empty(len(number)), np.empty(len(number))
    for i in range(len(number)):
        low, high = 0, pixels[i] - 1
        while low < high:
            middle = (low + high + 1) // 2
            if events_before[middle] - steps[i] * middle <= number[i]:
                low = middle
            else:
                high = middle - 1
        pixel[i] = busiest[low]
        pair = number[i] - (events_before[low] - steps[i] * low)
        last = first[pixel[i]] + steps[i] + pair
        t1_us[i] = events[last].t_us
        t0_us[i] = min(events[last - steps[i]].t_us + refractory_us, t1_us[i])
        total[i], count[i], variance[i] = _told(events, first, pixel[i], last - steps[i], last, last, refractory_us)
    return pixel, t0_us, t1_us, total, count, variance


@njit(cache=True, nogil=True)
def _look_back(pixel, t1_us, before_us, steps, first, events, refractory_us):
    """What :class:`EventPairs` holds of the pair that ends at each time; it begins at ``before_us`` where there is no
    event before."""
    t0_us = before_us.copy()
    total, count, variance = np.zeros(len(pixel)), np.zeros(len(pixel)), np.zeros(len(pixel))
    for i in range(len(pixel)):
        begin, low = first[pixel[i]], first[pixel[i]]
        high = end = first[pixel[i] + 1]
        while low < high:
            middle = (low + high) // 2
            if events[middle].t_us <= t1_us[i]:
                low = middle + 1
            else:
                high = middle
        last = low - 1
        if last < begin:
            continue
        before = max(last - steps[i], begin)
        t0_us[i] = min(events[before].t_us + refractory_us, t1_us[i])
        # What the pixel missed after its last event is known by the next one, where there is one.
        after = min(low, end - 1)
        total[i], count[i], variance[i] = _told(events, first, pixel[i], before, last, after, refractory_us)
    return t0_us, t1_us, total, count, variance


@njit(cache=True, inline="always")
def _told(events, first, pixel, before, last, after, refractory_us):
    """Sum of polarities, count and variance of the events of a pixel after ``before`` up to ``last``, with what was
    missed between those up to ``after``."""
    steps = last - before
    total = np.float64(np.int64(events[last].running_polarity) - events[before].running_polarity)
    count = np.float64(steps)
    if refractory_us > 0:
        for k in range(before + 1, after):
            missed = missed_after(events, k, first[pixel], refractory_us)
            total += missed
            count += abs(missed)
    return total, count, steps + _VARIANCE_OF_MISSED * (count - steps)


@njit(cache=True, inline="always")
def missed_after(events, k, first, refractory_us):
    """Events missed right after event ``k``, with its sign: at the rate of the faster one next to it that has its sign.

    At most three: what changes faster has changed when the pixel sees again. (The mean of both rates, or what gaps
    like this one have missed on average, is nearer the truth on the whole. But then less of every sharp edge is seen,
    and the brightness of what lies beyond is off.)
    """
    before, event, after = events[k - 1], events[k], events[k + 1]
    polarity = event.running_polarity - before.running_polarity
    earlier = before.running_polarity - (events[k - 2].running_polarity if k - 2 >= first else 0)
    interval_us = np.inf
    if earlier == polarity:
        interval_us = event.t_us - before.t_us
    if after.running_polarity - event.running_polarity == polarity:
        interval_us = min(interval_us, after.t_us - event.t_us)
    return polarity * refractory_us / max(interval_us - refractory_us, refractory_us / _MOST_MISSED)


def counting(events: np.ndarray, first: np.ndarray, counted: np.ndarray, responsive: np.ndarray) -> PairIndex:
    """An index in which each pixel counts for ``counted`` events."""
    busiest = np.argsort(-counted, kind="stable")
    return PairIndex(events, first, busiest, np.r_[0, counted[busiest].cumsum()], responsive)


def draw_steps(count: int, longest: int, random: np.random.Generator) -> Int64[np.ndarray, "pairs"]:
    """Steps between the events of a pair: log-uniform over 1 to ``longest``."""
    return np.exp(random.random(count) * np.log(longest + 1)).astype(np.int64)
