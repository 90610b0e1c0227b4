"""Properties estimated from event times: steps of the camera's clock, double events, and flicker.

Each is reported only if it is clear, since false positives would harm good recordings. The cost is linear in the number
of events.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter
from scipy.signal import welch

from ebarf_ns.compiled import njit

if TYPE_CHECKING:
    from jaxtyping import Bool, Int64, Shaped

_MOST_TIMES, _LEAST_TIMES, _LEAST_DISTINCT = 5_000_000, 100, 10
_WINDOW_US, _PADDING = 1 << 18, 4
_COHERENT, _ON_GRID, _OFF_GRID_US = 0.93, 0.99, 0.75
_COARSEST_CLOCK_US, _LONGEST_DOUBLE_US, _GAP_US = 10, 50, 200
_SPARSER, _LEAST_DOUBLES, _MOST_DOUBLES = 10, 0.001, 0.1
_SHORTEST_S, _SEGMENT_S, _BIN_US = 0.2, 1.0, 250
_LOWEST_HZ, _HIGHEST_HZ = 40, 1000
_PEAK, _MOST_SCREENED, _MOST_SEGMENTS, _MOST_BINS = 10, 1_000_000, 100, 1 << 24
_RAYLEIGH, _LEAST_PIXELS, _ALIKE = 10, 0.01, 0.7


def clock_step_us(t_us: Int64[np.ndarray, "events"]) -> int:
    """Step of the camera's clock to the nearest microsecond: 1, except for cameras that read out in steps.

    Times may be in any order. Only the quarter second around their median is used, subsampled above 5 million times.
    A step is 4 us to 26 ms long, and over 99 % of the times lie on it up to rounding to whole microseconds. By chance,
    1.5 / step of them would.
    """
    t_us = t_us[:: len(t_us) // _MOST_TIMES + 1]
    near = t_us[np.abs(t_us - np.median(t_us)) < _WINDOW_US // 2] if len(t_us) else t_us
    if len(near) < _LEAST_TIMES or len(np.unique(near)) < _LEAST_DISTINCT:
        return 1
    t = near - near.min()
    # A grid is coherent at all multiples of its frequency; the lowest gives the step.
    coherence = np.abs(np.fft.rfft(np.bincount(t), _PADDING * _WINDOW_US)) / len(t)
    lowest = 10 * _PADDING * _WINDOW_US // (int(t.max()) + 1)
    above = np.flatnonzero(coherence[lowest:] > _COHERENT)
    if not len(above):
        return 1
    first = lowest + above[0]
    step = _PADDING * _WINDOW_US / (first + np.argmax(coherence[first : first + 2 * _PADDING]))
    kept, off = np.ones(len(t), bool), 0.0
    for _ in range(3):
        phase = np.angle(np.exp(2j * np.pi * t[kept] / step).sum()) / (2 * np.pi)
        index = np.rint(t / step - phase)
        step, start = np.polyfit(index[kept], t[kept], 1)
        off = np.abs(t - start - step * index)
        kept = off <= np.quantile(off, _ON_GRID)
    found = step >= 4 and np.mean(off < _OFF_GRID_US) > _ON_GRID
    return round(step) if found else 1


def doubles(
    events: Shaped[np.ndarray, "events"], first: Int64[np.ndarray, "pixels+1"], clock_step_us: int = 1
) -> tuple[float, int]:
    """Share of events that repeat the previous one at their pixel, and the time in microseconds within which they do.

    Some sensors report one crossing twice: the same polarity within a few microseconds, then nothing for hundreds.
    Returns (0.0, 0) if there is no such gap up to 200 us, since genuine crossings in quick succession have intervals of
    any length; for over a tenth of the events, which are fast edges; and for clock steps over 10 us.
    """
    within, bound_us = np.cumsum(_repeats(events, first, _GAP_US)), np.arange(_LONGEST_DOUBLE_US + 1)
    gaps = np.flatnonzero(within[-1] - within[bound_us] <= within[bound_us] / _SPARSER)
    if clock_step_us > _COARSEST_CLOCK_US or not len(gaps):
        return 0.0, 0
    # The emptiest gap, or the first with almost no doubles beyond it.
    beyond = np.maximum(within[4 * gaps] - within[gaps], 0.005 * within[gaps[-1]])
    within_us = max(int(gaps[np.argmin(beyond)]), 1)
    share = float(within[within_us] / max(len(events), 1))
    return (share, within_us) if _LEAST_DOUBLES < share < _MOST_DOUBLES else (0.0, 0)


@njit(cache=True, nogil=True)
def _repeats(events, first, longest_us):
    """Histogram of the time since the previous event at the pixel, if that had the same polarity."""
    count = np.zeros(longest_us + 1, np.int64)
    for p in range(len(first) - 1):
        before = sum_before = 0
        for k in range(first[p], first[p + 1]):
            polarity = events[k].running_polarity - sum_before
            if k > first[p] and polarity == before:
                interval_us = events[k].t_us - events[k - 1].t_us
                if 0 <= interval_us <= longest_us:
                    count[interval_us] += 1
            before, sum_before = polarity, events[k].running_polarity
    return count


@dataclass(frozen=True)
class Flicker:
    """Lamp flicker that pixels follow."""

    hz: float | None
    """Flicker frequency, for most lamps twice that of the mains; None without flicker."""
    share_of_pixels: float
    pixels: Bool[np.ndarray, "pixels"]
    """Pixels that follow a lamp in at least part of the recording."""


def flicker_hz(
    events: Shaped[np.ndarray, "events"], first: Int64[np.ndarray, "pixels+1"], clock_step_us: int = 1
) -> Flicker:
    """Frequency of flickering lamps, 40 to 1000 Hz, and the pixels that follow them; none for recordings under 0.2 s.

    A lamp produces a line in the spectrum of ON minus OFF events of the whole sensor, in both halves of the recording.
    So do edges that cross one column of pixels after another, frames that disturb the pixels, and a stepped clock. So
    1 % of the pixels must also alternate between ON and OFF in phase with the line, cycle by cycle, and most of them in
    common phase: under vibration or a passing grating, each pixel has its own phase. A lamp that swings by less than
    the thresholds is not found: pixels do not follow it, even though their events cluster in its phase. The lowest of
    several frequencies is returned. Lines are searched in the first 100 s of each half; recordings over an hour are
    skipped.
    """
    pixels = len(first) - 1
    none = Flicker(None, 0.0, np.zeros(pixels, bool))
    begin_us, end_us = (int(events["t_us"].min()), int(events["t_us"].max())) if len(events) else (0, 0)
    # Bins are multiples of the clock step to avoid a beat between the two.
    bin_us = max(_BIN_US // clock_step_us, 1) * clock_step_us
    bins = (end_us - begin_us) // bin_us + 1
    length = min(bins // 2, int(_SEGMENT_S * 1e6 / bin_us))
    if end_us - begin_us < _SHORTEST_S * 1e6 or length < 16 or bins > _MOST_BINS:
        return none
    rate = _signed_rate(events, first, begin_us, bin_us, bins)
    halves = [rate[at : at + bins // 2][: _MOST_SEGMENTS * length] for at in (0, bins // 2)]
    spectra = [welch(half, 1e6 / bin_us, nperseg=length, nfft=_PADDING * length) for half in halves]
    hz, powers = spectra[0][0], [np.maximum(power, 1e-30) for _, power in spectra]
    peak = np.min([power / median_filter(power, 30 * _PADDING + 1) for power in powers], axis=0)
    resolution = _PADDING * hz[1]
    from_clock = np.abs((hz + 5e5 / clock_step_us) % (1e6 / clock_step_us) - 5e5 / clock_step_us) < 2 * resolution
    is_line = (hz + hz[1] >= _LOWEST_HZ) & (hz <= min(_HIGHEST_HZ + hz[1], hz[-2])) & (peak >= _PEAK)
    is_line &= (peak == maximum_filter1d(peak, 4 * _PADDING + 1)) & ~from_clock
    for k in np.flatnonzero(is_line):
        low, middle, high = np.log(powers[0] + powers[1])[k - 1 : k + 2]
        line_hz = hz[k] + hz[1] * (low - high) / (2 * (low - 2 * middle + high) - 1e-30)
        segments = rate[: bins // length * length].reshape(-1, length)
        cycles = line_hz * 1e-6 * bin_us * np.arange(length)
        # The mains frequency drifts, so the phase is estimated per segment.
        lamp = segments @ (np.hanning(length) * np.exp(-2j * np.pi * cycles))
        lamp /= np.maximum(np.abs(lamp), 1e-30)
        # Frames that disturb the pixels give many lines: every n-th pixel first decides whether one is a lamp.
        for every in (len(events) // _MOST_SCREENED + 1, 1):
            found = _following(events, first, begin_us, length * bin_us, line_hz * 1e-6, lamp, every)
            if not found.any():
                break
        else:
            return Flicker(float(line_hz), float(found.mean()), found)
    return none


@njit(cache=True, nogil=True)
def _signed_rate(events, first, begin_us, bin_us, bins):
    """ON minus OFF events of all pixels per time bin."""
    rate = np.zeros(bins)
    for p in range(len(first) - 1):
        sum_before = 0
        for k in range(first[p], first[p + 1]):
            rate[(events[k].t_us - begin_us) // bin_us] += events[k].running_polarity - sum_before
            sum_before = events[k].running_polarity
    return rate


def _following(events, first, begin_us, segment_us, cycles_per_us, lamp, every) -> np.ndarray:
    """Pixels among every ``every``-th that follow the lamp; none unless they are enough and in common phase."""
    total, count, cyclic = _reversals(events, first, begin_us, segment_us, cycles_per_us, lamp, every)
    found = (np.abs(total) ** 2 > _RAYLEIGH * count) & (cyclic > 0.1 * count)
    enough = found.sum() >= max(_LEAST_PIXELS * len(found) / every, 1)
    return found & (enough and np.abs(np.mean(total[found] / np.abs(total[found]))) > _ALIKE)


@njit(cache=True, nogil=True)
def _reversals(events, first, begin_us, segment_us, cycles_per_us, lamp, every):
    """Statistics of each pixel's polarity reversals: sum of phasors, with those to OFF negated; number; and how many
    reversals to ON come one cycle after the previous one.

    A run of equal polarities counts once: the events of one edge share a phase at any frequency.
    """
    pixels = len(first) - 1
    total, count, cyclic = np.zeros(pixels, np.complex128), np.zeros(pixels), np.zeros(pixels)
    for p in range(0, pixels, every):
        before, sum_before, last_on_us = 0, 0, -1
        for k in range(first[p], first[p + 1]):
            polarity = events[k].running_polarity - sum_before
            sum_before = events[k].running_polarity
            if polarity == before:
                continue
            before = polarity
            since_us = events[k].t_us - begin_us
            segment = min(since_us // segment_us, len(lamp) - 1)
            cycles = cycles_per_us * (since_us - segment * segment_us)
            total[p] += polarity * np.exp(2j * np.pi * cycles) * lamp[segment]
            count[p] += 1
            if polarity > 0:
                cyclic[p] += last_on_us >= 0 and 0.5 < cycles_per_us * (since_us - last_on_us) < 1.5
                last_on_us = since_us
    return total, count, cyclic
