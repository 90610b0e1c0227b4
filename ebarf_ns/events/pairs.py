"""Pairs of events at one pixel, to which the event generation model (Eq. 1) applies.

Between two events of a pixel, log brightness changes by the sum of what the events after the first one report; while
the pixel is silent, it changes by less than one more threshold. Events are sorted by pixel, then time, so that "n steps
back" is an index subtraction; a running sum of polarities gives the sum between any two events. Batches depend only on
(seed, batch number).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ebarf_ns.compiled import njit

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int64, Shaped

EVENT = np.dtype([("t_us", "<i8"), ("running_polarity", "<i4")])
"""Stored as an array of structs, so that a lookup touches one cache line."""
_ROUNDS = 100
_MOST_MISSED = 3.0
_BLANK_REACH, _VARIANCE_OF_BLANK = 0.1, 30.0
_VARIANCE_OF_MISSED = 8.0
"""Variance of a missed event relative to one whose threshold has the usual 5 % spread: 0.3 to 0.035 C²."""


@dataclass(frozen=True)
class EventPairs:
    """Pairs of times (t0, t1) at a pixel, with the sum of polarities and the number of events in (t0, t1].

    A pair begins at an event and ends at another event or at a time when the pixel is silent. Pairs of blank pixels
    have one time and two pixels.
    """

    pixel: Int64[np.ndarray, "pairs"]
    """Row-major index y * width + x."""
    pixel_before: Int64[np.ndarray, "pairs"]
    """Pixel at t0; differs from ``pixel`` only for pairs of blank pixels."""
    t0_us: Int64[np.ndarray, "pairs"]
    t1_us: Int64[np.ndarray, "pairs"]
    polarity_sum: Float[np.ndarray, "pairs"]
    event_count: Float[np.ndarray, "pairs"]
    """Both are fractional when they include estimated events missed in the refractory period."""
    variance: Float[np.ndarray, "pairs"]
    """Variance of the reported change, up to a factor: 1 per event, and much more per estimated event."""
    silent: Bool[np.ndarray, "pairs"]
    """Whether the pair ends between events: the change is then known only to within a threshold."""

    def __len__(self) -> int:
        return len(self.pixel)

    @property
    def duration_us(self) -> Int64[np.ndarray, "pairs"]:
        """t1 - t0."""
        return self.t1_us - self.t0_us

    def select(self, which: slice | Bool[np.ndarray, "pairs"]) -> EventPairs:
        """The pairs selected by a slice or mask."""
        return EventPairs(*(getattr(self, column.name)[which] for column in fields(self)))


@dataclass(frozen=True)
class PairIndex:
    """Events sorted by pixel and time, from which pairs any number of steps apart are drawn uniformly; hot pixels are
    excluded.

    Takes 12 bytes per event and 24 per pixel, in memory or in a file.
    """

    events: Shaped[np.ndarray, "events"]
    """``t_us`` and ``running_polarity``, the sum of a pixel's polarities up to and including each event."""
    first: Int64[np.ndarray, "pixels+1"]
    """Start index of each pixel's events."""
    busiest: Int64[np.ndarray, "pixels"]
    """Pixels by decreasing number of events; hot pixels come last and count as having none."""
    events_before: Int64[np.ndarray, "pixels+1"]
    """Number of events of all pixels before each position in ``busiest``."""
    responsive: Int64[np.ndarray, "responsive"]
    """Pixels whose silence is informative: neither hot nor dead."""

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
        """Length of the longest pair, in steps."""
        return int(self.events_before[1]) - 1

    def count(self, steps: Int64[np.ndarray, "*batch"]) -> Int64[np.ndarray, "*batch"]:
        """Number of pairs that are ``steps`` apart."""
        return self._count(steps)[1]

    @cached_property
    def _less_events(self) -> Int64[np.ndarray, "pixels"]:
        """Negated event counts of ``busiest``, in ascending order for ``searchsorted``."""
        return -np.diff(self.events_before)

    @cached_property
    def _counting_pixels(self) -> int:
        """Number of pixels that have events and are not hot, which come first in ``busiest``."""
        return int(np.count_nonzero(self._less_events))

    def _count(self, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Number of pixels with pairs ``steps`` apart (the first ones of ``busiest``), and the number of such pairs."""
        pixels = np.searchsorted(self._less_events, -steps)
        return pixels, self.events_before[pixels] - steps * pixels

    @property
    def hot_pixels(self) -> int:
        """Number of excluded hot pixels."""
        return int(np.count_nonzero(np.diff(self.first))) - self._counting_pixels

    def without(self, pixels: Bool[np.ndarray, "pixels"]) -> PairIndex:
        """The same events, with the given pixels excluded."""
        counts = np.zeros(len(pixels), np.int64)
        counts[self.busiest] = -self._less_events
        return counting(self.events, self.first, np.where(pixels, 0, counts), self.responsive[~pixels[self.responsive]])

    def with_hot_pixels(self) -> PairIndex:
        """The same events, with hot pixels included."""
        counts = np.diff(self.first)
        hot = np.setdiff1d(np.nonzero(counts)[0], self.responsive)
        return counting(self.events, self.first, counts, np.union1d(self.responsive, hot))

    def draw(
        self, steps: Int64[np.ndarray, "pairs"], random: np.random.Generator, refractory_us: int = 0
    ) -> EventPairs:
        """Draw one pair per entry of ``steps`` (clipped to the longest), uniformly over all pairs that far apart.

        After the refractory period ``refractory_us``, a pixel takes the brightness it then sees as its reference
        (Low & Lee 2023): pairs begin that much later, and missed events are estimated from the neighbouring ones.
        """
        steps = np.minimum(steps, self.max_steps)
        pixels, pairs = self._count(steps)
        order = (self.events_before, self.busiest, self.first, self.events)
        pixel, *times_and_sums = _look_up(random.integers(pairs), steps, pixels, *order, refractory_us)
        return EventPairs(pixel, pixel, *times_and_sums, silent=np.zeros(len(pixel), bool))

    def draw_silent(
        self, count: int, longest: int, span_us: tuple[int, int], random: np.random.Generator, refractory_us: int = 0
    ) -> EventPairs:
        """Draw pairs that begin at an event and end at a random time in the span, with 0 to ``longest`` events between.

        Uniform over time and the ``responsive`` pixels. For a pixel that has not fired by then, the pair begins at a
        random earlier time.
        """
        pixel = self.responsive[random.integers(len(self.responsive), size=count)]
        t1_us = random.integers(span_us[0], span_us[1], size=count, endpoint=True)
        before_us = random.integers(span_us[0], t1_us, endpoint=True)
        steps = draw_steps(count, longest + 1, random) - 1
        columns = _look_back(pixel, t1_us, before_us, steps, self.first, self.events, refractory_us)
        return EventPairs(pixel, pixel, *columns, silent=np.ones(count, bool))

    def draw_blank(self, count: int, width: int, span_us: tuple[int, int], random: np.random.Generator) -> EventPairs:
        """Draw pairs of ``blank`` pixels at one time, a tenth of the sensor's width apart (standard deviation).

        Regions without events are weakly assumed to be of uniform brightness: the variance is that of 30 events.
        Returns fewer than ``count`` pairs, since those whose second pixel fires are dropped.
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
        """Draw ``count`` pairs that pass ``accepted``, with step counts log-uniform from 1 to ``longest``.

        Gives up after a hundred times as many draws, and may then return fewer pairs or none.
        """
        found: list[EventPairs] = []
        missing = count
        while missing and len(found) < _ROUNDS:
            # Oversample in every round, since few may be accepted.
            drawn = self.draw(draw_steps(min(2 * missing, count), longest, random), random, refractory_us)
            found.append(drawn.select(accepted(drawn)).select(slice(missing)))
            missing -= len(found[-1])
        return joined(found)


def joined(parts: Sequence[EventPairs]) -> EventPairs:
    """Concatenate pairs."""
    return EventPairs(*(np.concatenate([getattr(part, c.name) for part in parts]) for c in fields(EventPairs)))


@njit(cache=True, nogil=True)
def _look_up(number, steps, pixels, events_before, busiest, first, events, refractory_us):
    """Columns of :class:`EventPairs` for pair ``number`` among those ``steps`` apart, counted along ``busiest``."""
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
        total[i], count[i], variance[i] = _sum_between(
            events, first, pixel[i], last - steps[i], last, last, refractory_us
        )
    return pixel, t0_us, t1_us, total, count, variance


@njit(cache=True, nogil=True)
def _look_back(pixel, t1_us, before_us, steps, first, events, refractory_us):
    """Columns of :class:`EventPairs` for the pairs that end at each time; a pair without an earlier event begins at
    ``before_us``."""
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
        # The next event, if any, shows what the pixel missed after its last one.
        after = min(low, end - 1)
        total[i], count[i], variance[i] = _sum_between(events, first, pixel[i], before, last, after, refractory_us)
    return t0_us, t1_us, total, count, variance


@njit(cache=True, inline="always")
def _sum_between(events, first, pixel, before, last, after, refractory_us):
    """Polarity sum, count and variance of a pixel's events after ``before`` up to ``last``, including estimates of the
    events missed up to ``after``."""
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
    """Signed number of events missed right after event ``k``, from the higher rate of the neighbours of equal polarity.

    At most three: a faster change is over when the refractory period ends. (The mean of both rates, or the average
    number missed in such intervals, is more accurate overall, but underestimates every sharp edge and so biases the
    brightness beyond it.)
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
    """Build an index in which each pixel counts as having ``counted`` events."""
    busiest = np.argsort(-counted, kind="stable")
    return PairIndex(events, first, busiest, np.r_[0, counted[busiest].cumsum()], responsive)


def draw_steps(count: int, longest: int, random: np.random.Generator) -> Int64[np.ndarray, "pairs"]:
    """Draw numbers of steps between the events of a pair, log-uniform from 1 to ``longest``."""
    return np.exp(random.random(count) * np.log(longest + 1)).astype(np.int64)
