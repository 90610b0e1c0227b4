"""Sensor properties estimated from a recording: the refractory period and the ratio of the contrast thresholds.

Every property is an estimate with a range. Both are computed from times and polarities alone, before any training;
values given by the scene or a flag take precedence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ebarf_ns.compiled import njit
from ebarf_ns.errors import RecordingError
from ebarf_ns.events.indexing import index_pairs
from ebarf_ns.events.pairs import PairIndex, missed_after
from ebarf_ns.events.recording import Recording, RecordingFile
from ebarf_ns.events.timing import clock_step_us, doubles, flicker_hz

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int64

_ENOUGH_INTERVALS = 10_000
_AT_MOST_EVENTS, _AT_MOST_INDEXED = 5_000_000, 20_000_000
_FASTEST, _FAST = 0.0003, 0.003
_FAST_OVER_FASTEST = 1.6
_USUAL_OVER_FASTEST = 75
_SHORTEST_BLIND_US = 50
_EVENTS_TO_BALANCE, _PIXELS_TO_BALANCE = 6, 100
_LEAST_DEVIATION = 0.03
_UNKNOWN_DEVIATION = 0.5


@dataclass(frozen=True)
class Estimate:
    """A number and its plausible range."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class SensorFacts:
    """Result of :func:`identify`."""

    refractory_us: Estimate
    """Refractory period: a pixel is blind for this long after an event."""
    threshold_ratio: Estimate
    """C_on / C_off, given the refractory period in use."""
    doubles_us: int
    """Events that repeat the previous one at their pixel within this time report one crossing twice; 0: none do."""
    doubles_share: float
    clock_step_us: int
    """1 for a microsecond clock; more if the camera reads out in steps."""
    flicker_hz: float | None
    """Flicker frequency of lamps in view."""
    flicker_share: float
    """Share of the pixels that follow the flicker."""
    hot_pixels: int
    dead_pixels: int
    """Pixels that cannot fire, recognised by their active neighbours."""
    blank_share: float
    """Share of the other pixels that never fired because no edge passed them."""


_UNKNOWN_RATIO = Estimate(1.0, float(np.exp(-2 * _UNKNOWN_DEVIATION)), float(np.exp(2 * _UNKNOWN_DEVIATION)))
UNKNOWN_SENSOR = SensorFacts(Estimate(0, 0, 0), _UNKNOWN_RATIO, 0, 0.0, 1, None, 0.0, 0, 0, 0.0)
"""For recordings from which nothing can be estimated."""


def identify(index: PairIndex, refractory_us: int | None = None) -> SensorFacts:
    """Estimate the sensor's properties from a recording without doubles; a given refractory period takes precedence."""
    found = estimated_refractory_us(index)
    in_force = round(found.value) if refractory_us is None else refractory_us
    step_us = clock_step_us(index.events["t_us"])
    flicker = flicker_hz(index.events, index.first, step_us)
    return SensorFacts(
        refractory_us=found,
        threshold_ratio=estimated_threshold_ratio(index, in_force),
        doubles_us=0,
        doubles_share=0.0,
        clock_step_us=step_us,
        flicker_hz=flicker.hz,
        flicker_share=flicker.share_of_pixels,
        hot_pixels=index.hot_pixels,
        dead_pixels=len(index.first) - 1 - len(index.responsive) - index.hot_pixels,
        blank_share=len(index.blank) / max(len(index.responsive), 1),
    )


def identify_recording(file: RecordingFile, span_us: tuple[int, int], refractory_us: int | None = None) -> SensorFacts:
    """:func:`identify` on the first 20 million events in a span; ``UNKNOWN_SENSOR`` if no pixel has two of them."""
    kept: list[Recording] = []
    for chunk in file.chunks():
        kept.append(chunk.between(*span_us))
        if sum(map(len, kept)) > _AT_MOST_INDEXED:
            break
    try:
        index = index_pairs(lambda: kept, file.width, file.height)
        share, within_us = doubles(index.events, index.first, clock_step_us(index.events["t_us"]))
        if within_us:
            index = index_pairs(lambda: kept, file.width, file.height, doubles_us=within_us)
    except RecordingError:
        return UNKNOWN_SENSOR
    return replace(identify(index, refractory_us), doubles_us=within_us, doubles_share=share)


def estimated_refractory_us(index: PairIndex) -> Estimate:
    """Refractory period in whole microseconds; 0 if the recording shows none.

    An interval between events of one polarity at a pixel is the refractory period plus the time that the edge takes.
    Two observations separate them. Without a refractory period, intervals reach down to 1/75 of the median; the
    shortest interval's excess over that is the refractory period. And the shortest intervals spread: the 0.3 % quantile
    is 1.6 times the 0.03 % quantile; an added refractory period brings them closer together. The first estimate has
    weight two, the second one; both ratios were measured on photographed and drawn scenes at speeds a factor of ten
    apart. Noise produces equal and opposite polarities alike, so the count of intervals of opposite polarity is
    subtracted. A result below 50 us, which blurred edges also give, is set to 0.
    """
    interval_us, same = _intervals(index)
    like, unlike = np.sort(interval_us[same]), np.sort(interval_us[~same])
    if len(like) < _ENOUGH_INTERVALS:
        return Estimate(0, 0, float(like[0]) if len(like) else 0)
    beyond_chance = np.arange(1, len(like) + 1) - np.searchsorted(unlike, like, side="right")
    fastest, fast = (float(like[np.argmax(beyond_chance >= share * len(like))]) for share in (_FASTEST, _FAST))
    by_spread = max(fastest - (fast - fastest) / (_FAST_OVER_FASTEST - 1), 0)
    by_usual = max(fastest - float(np.median(like)) / _USUAL_OVER_FASTEST, 0)
    value = (by_spread + 2 * by_usual) / 3
    low, high = min(by_spread, by_usual), fastest
    return Estimate(round(value) if value >= _SHORTEST_BLIND_US else 0, low, high)


def estimated_threshold_ratio(index: PairIndex, refractory_us: int) -> Estimate:
    """C_on / C_off by balance: brightness returns to earlier values, so ON and OFF events must cancel.

    Events, including estimates of those missed in the refractory period, are counted between extrema of the same kind
    of a pixel's brightness (maximum to maximum, or minimum to minimum): between those, log brightness changes less than
    between other times, and the unknown fraction of a threshold at either end drops out. The estimate is the median
    over pixels, weighted by their events. Its deviation is the spread between quarters of the sensor, at least 3 %, or
    50 % if fewer than 100 pixels have enough events.
    """
    brighter, darker = _between_extrema(index.events, index.first, index.responsive, refractory_us)
    pixel = np.tile(index.responsive, 2)
    enough = brighter + darker >= _EVENTS_TO_BALANCE
    if np.count_nonzero(enough) < _PIXELS_TO_BALANCE:
        return _UNKNOWN_RATIO
    brighter, darker, pixel = brighter[enough], darker[enough], pixel[enough]
    log_ratio, weight = np.log((darker + 0.5) / (brighter + 0.5)), brighter + darker
    middle = _weighted_median(log_ratio, weight)
    # Quarters are blocks of consecutive pixels: horizontal bands of the sensor.
    quarters = np.array_split(np.argsort(pixel, kind="stable"), 4)
    apart = [_weighted_median(log_ratio[part], weight[part]) - middle for part in quarters]
    deviation = max(_LEAST_DEVIATION, float(np.sqrt(np.mean(np.square(apart)))))
    return Estimate(*(float(np.exp(middle + k * deviation)) for k in (0, -2, 2)))


def _intervals(index: PairIndex) -> tuple[Int64[np.ndarray, "intervals"], Bool[np.ndarray, "intervals"]]:
    """Times between consecutive events at a pixel and whether their polarities are equal; pixels are subsampled if
    there are very many events."""
    counts = np.diff(index.first)[index.responsive]
    every = max(int(counts.sum()) // _AT_MOST_EVENTS, 1)
    return _intervals_of(index.events, index.first, index.responsive[::every])


@njit(cache=True)
def _intervals_of(events, first, pixels):
    most = 0
    for pixel in pixels:
        most += first[pixel + 1] - first[pixel]
    interval_us, same = np.empty(most, np.int64), np.empty(most, np.bool_)
    n = 0
    for pixel in pixels:
        before = 0
        for k in range(first[pixel], first[pixel + 1]):
            sum_before = events[k - 1].running_polarity if k > first[pixel] else 0
            polarity = events[k].running_polarity - sum_before
            if k > first[pixel]:
                interval_us[n], same[n] = events[k].t_us - events[k - 1].t_us, polarity == before
                n += 1
            before = polarity
    return interval_us[:n], same[:n]


@njit(cache=True)
def _between_extrema(events, first, pixels, refractory_us):
    """ON and OFF events of each pixel from its first brightness extremum to the last one of the same kind; then the
    same from its second extremum."""
    brighter, darker = np.zeros((2, len(pixels))), np.zeros((2, len(pixels)))
    for i in range(len(pixels)):
        begin, end = first[pixels[i]], first[pixels[i] + 1]
        # Sums up to and including the event before each extremum, for the two alternating kinds.
        on = off = 0.0
        start_on, start_off = np.zeros(2), np.zeros(2)
        extrema, before = 0, 0
        for k in range(begin, end):
            polarity = events[k].running_polarity - (events[k - 1].running_polarity if k > begin else 0)
            if before != 0 and polarity != before:
                kind = extrema % 2
                if extrema < 2:
                    start_on[kind], start_off[kind] = on, off
                else:
                    brighter[kind, i], darker[kind, i] = on - start_on[kind], off - start_off[kind]
                extrema += 1
            size = 1.0
            if refractory_us > 0 and begin < k < end - 1:
                size += abs(missed_after(events, k, begin, refractory_us))
            if polarity > 0:
                on += size
            else:
                off += size
            before = polarity
    return brighter.ravel(), darker.ravel()


def _weighted_median(values: Float[np.ndarray, "n"], weight: Float[np.ndarray, "n"]) -> float:
    order = np.argsort(values)
    cumulative = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(cumulative, cumulative[-1] / 2)])
