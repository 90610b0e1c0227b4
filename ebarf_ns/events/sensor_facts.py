"""What a recording tells of the sensor that made it: how long its pixels are blind, and how its thresholds compare.

Every fact is an estimate with a range. Both are read from times and polarities alone, before anything is trained; what
the scene or a flag states goes before them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

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
    """A number, and the range that it may well lie in."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class SensorFacts:
    """What :func:`identify` found."""

    refractory_us: Estimate
    """Blind time of a pixel after an event."""
    threshold_ratio: Estimate
    """C_on / C_off, with the blind time in force."""
    doubles_us: int
    """Events that repeat the one before at their pixel within this time are one crossing reported twice; 0: none do."""
    doubles_share: float
    clock_step_us: int
    """1 for a clock of microseconds; more where a camera reads out in steps."""
    flicker_hz: float | None
    """Of lamps in the picture."""
    flicker_share: float
    """Share of the pixels that follow them."""
    hot_pixels: int
    dead_pixels: int
    """Those that cannot fire, told by neighbours that do."""
    blank_share: float
    """Share of the other pixels that never fired, as nothing passed them."""


_UNKNOWN_RATIO = Estimate(1.0, float(np.exp(-2 * _UNKNOWN_DEVIATION)), float(np.exp(2 * _UNKNOWN_DEVIATION)))
UNKNOWN_SENSOR = SensorFacts(Estimate(0, 0, 0), _UNKNOWN_RATIO, 0, 0.0, 1, None, 0.0, 0, 0, 0.0)
"""Of a recording that tells nothing."""


def identify(index: PairIndex, refractory_us: int | None = None) -> SensorFacts:
    """What a recording without doubles tells of its sensor; a blind time that is stated goes before the one found."""
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
    """:func:`identify`, from the first 20 million events within a span; nothing where no pixel has two of them."""
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
    """How long pixels are blind after an event, in whole microseconds; 0 where the recording shows no such time.

    Intervals between events of one polarity at a pixel are the blind time and what the fastest edges take. Two things
    tell these apart. Clean recordings have intervals down to a 75th of the usual one: what the shortest has beyond that
    is blind time. And their shortest intervals spread: three in a thousand lie below 1.6 times the length that three in
    ten thousand lie below; intervals that a blind time is added to lie closer together. The former counts twice, the
    latter once; both ratios are those of photographed and drawn scenes at speeds a factor of ten apart. Noise makes
    intervals of like and of unlike polarity alike, so that the latter are subtracted from the count of the former. A
    result below 50 us, which blurred edges make as well, is taken as 0.
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
    """C_on / C_off by balance: what a pixel sees comes back, so that brighter and darker events must cancel.

    Counted, with the events missed while blind, from one turn of a pixel's brightness to another of the same kind
    (maximum to maximum, or minimum to minimum): between those, log brightness has changed by less than between any
    other two moments, and neither end's unknown part of a threshold counts. The estimate is the median over pixels,
    weighted by their events. Its deviation is at least 3 %, and as large as the quarters of the sensor differ; 50 %
    where fewer than 100 pixels tell anything.
    """
    brighter, darker = _between_turns(index.events, index.first, index.responsive, refractory_us)
    pixel = np.tile(index.responsive, 2)
    told = brighter + darker >= _EVENTS_TO_BALANCE
    if np.count_nonzero(told) < _PIXELS_TO_BALANCE:
        return _UNKNOWN_RATIO
    brighter, darker, pixel = brighter[told], darker[told], pixel[told]
    log_ratio, weight = np.log((darker + 0.5) / (brighter + 0.5)), brighter + darker
    middle = _weighted_median(log_ratio, weight)
    # Quarters by blocks of pixels in order: bands of the sensor.
    quarters = np.array_split(np.argsort(pixel, kind="stable"), 4)
    apart = [_weighted_median(log_ratio[part], weight[part]) - middle for part in quarters]
    deviation = max(_LEAST_DEVIATION, float(np.sqrt(np.mean(np.square(apart)))))
    return Estimate(*(float(np.exp(middle + k * deviation)) for k in (0, -2, 2)))


def _intervals(index: PairIndex) -> tuple[Int64[np.ndarray, "intervals"], Bool[np.ndarray, "intervals"]]:
    """Times between events that follow one another at a pixel, of some of the pixels where there are very many events,
    and whether both are of one polarity."""
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
def _between_turns(events, first, pixels, refractory_us):
    """Brighter and darker events of each pixel from the first of its turns to the last one of the same kind; then the
    same from its second turn."""
    brighter, darker = np.zeros((2, len(pixels))), np.zeros((2, len(pixels)))
    for i in range(len(pixels)):
        begin, end = first[pixels[i]], first[pixels[i] + 1]
        # Sums up to and including the event before each turn, for the two kinds of turns in turn.
        on = off = 0.0
        start_on, start_off = np.zeros(2), np.zeros(2)
        turns, before = 0, 0
        for k in range(begin, end):
            polarity = events[k].running_polarity - (events[k - 1].running_polarity if k > begin else 0)
            if before != 0 and polarity != before:
                kind = turns % 2
                if turns < 2:
                    start_on[kind], start_off[kind] = on, off
                else:
                    brighter[kind, i], darker[kind, i] = on - start_on[kind], off - start_off[kind]
                turns += 1
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
