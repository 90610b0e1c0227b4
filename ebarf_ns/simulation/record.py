"""Events of a view, rendered adaptively where and when brightness changes, so that no event is missed or late."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int64

from ebarf_ns.events.recording import Recording
from ebarf_ns.simulation.sensor import Crossings, EventSensor, SensorModel
from ebarf_ns.simulation.view import View

_PIXELS_PER_STEP = 1 / 3
_THRESHOLDS_PER_SAMPLE = 1 / 3
_STEPS_PER_LAG = 3
_FINEST_US = 1.0
_LONGEST_US = 10_000.0
_RAYS_AT_ONCE, _MOST_AT_ONCE = 2_000_000, 32
_SHARPENINGS, _SHARP_US = 12, 0.02


def record(
    view: View, model: SensorModel, end_us: int, seed: int, progress: Callable[[float], None] = lambda fraction: None
) -> Recording:
    """Simulate an event camera from time 0 to ``end_us``.

    Between two renders, nothing moves more than a third of a pixel; between two samples of a pixel, its log brightness
    changes by at most a third of a threshold, except for jumps, which are located to a microsecond. Peaks are sampled
    too. Event times are then solved for or, for pixels with limited bandwidth or a refractory period, interpolated
    between those samples.
    """
    steps = _Steps(view, model, end_us)
    radiance, distance = view.images(np.zeros(1))
    t_us, brightness = np.zeros(1), np.log(radiance)
    sensor = EventSensor(model, end_us, seed, brightness[0])
    largest_change = _THRESHOLDS_PER_SAMPLE * min(model.threshold_on, model.threshold_off)
    chunks, seen = [], 0
    while t_us[seen] < end_us:
        if t_us[-1] < end_us:
            following_us = steps.following(float(t_us[-1]), distance[-1])
            radiance, distance = view.images(following_us)
            t_us, brightness = np.r_[t_us, following_us], np.concatenate([brightness, np.log(radiance)])
        # A peak is only detected once the samples before and after it are known.
        until = len(t_us) - (1 if t_us[-1] == end_us else 2)
        if until > seen:
            crossings = sensor.see(*_samples(view, t_us, brightness, seen, until, largest_change))
            at_us = crossings.t_us if model.cutoff_hz or model.refractory_us else _sharpened(view, sensor, crossings)
            chunks.append((crossings.pixel, at_us, crossings.polarity))
            progress(t_us[until] / end_us)
        kept = max(until - 1, 0)
        t_us, brightness, seen = t_us[kept:], brightness[kept:], until - kept
    pixel, at_us, polarity = (np.concatenate(columns) for columns in zip(*chunks, strict=True))
    at_us = sensor.jitter(at_us)
    order = np.argsort(at_us, kind="stable")
    row, column = np.divmod(pixel[order], view.camera.width)
    return Recording(column.astype(np.uint16), row.astype(np.uint16), at_us[order], polarity[order].astype(np.int8))


class _Steps:
    """Adaptive render times, several at once."""

    def __init__(self, view: View, model: SensorModel, end_us: int):
        self._view, self._end_us = view, float(end_us)
        self._longest_us = 1e6 / (2 * np.pi * model.widest_hz) / _STEPS_PER_LAG if model.cutoff_hz else _LONGEST_US
        rays = view.camera.width * view.camera.height * view.rays_per_pixel
        self._at_once = int(np.clip(_RAYS_AT_ONCE // rays, 1, _MOST_AT_ONCE))
        # Lower bound of a distance after these steps, relative to the current one.
        few_rad = self._at_once * _PIXELS_PER_STEP / view.pixels_per_rad.min()
        self._nearer = max(0.5, 1 - 2 * few_rad)
        # Hand velocity is constant within a millisecond.
        self._velocity, self._turn = view.velocities(np.arange(0.0, end_us + 1000, 1000))

    def following(self, t_us: float, distance: Float[np.ndarray, "pixels"]) -> Float[np.ndarray, "times"]:
        """The next render times after ``t_us``, at which the scene is at ``distance``."""
        times = [t_us]
        distance = self._nearer * distance
        while len(times) <= self._at_once and times[-1] < self._end_us:
            step_us = self._step_us(times[-1], distance)
            # The camera may be faster at the end of the step.
            step_us = min(step_us, self._step_us(times[-1] + step_us, distance))
            times.append(min(times[-1] + max(step_us, _FINEST_US), self._end_us))
        return np.array(times[1:])

    def _step_us(self, t_us: float, distance: Float[np.ndarray, "pixels"]) -> float:
        k = min(round(t_us / 1000), len(self._turn) - 1)
        pixels_per_s = max(self._view.fastest(distance, self._velocity[k], self._turn[k]), 1e-3)
        return min(_PIXELS_PER_STEP / pixels_per_s * 1e6, self._longest_us)


def _samples(
    view: View,
    t_us: Float[np.ndarray, "times"],
    brightness: Float[np.ndarray, "times pixels"],
    seen: int,
    until: int,
    largest_change: float,
) -> tuple[Int64[np.ndarray, "samples"], Float[np.ndarray, "samples"], Float[np.ndarray, "samples"]]:
    """Pixel, time and log brightness after index ``seen`` up to index ``until`` of the times, sorted by pixel and time.

    Samples are at the times themselves, at peaks, and at bisections of intervals with too large a change.
    """
    steps, count = until - seen, brightness.shape[1]
    pixel = np.repeat(np.arange(count), steps)
    before_us, after_us = (np.tile(t_us[seen + k : until + k], count) for k in (0, 1))
    before, after = (brightness[seen + k : until + k].T.ravel() for k in (0, 1))
    peak, peak_us = _peaks(t_us, brightness)
    within = (peak_us > t_us[seen]) & (peak_us < t_us[until])
    peak, peak_us = peak[within], peak_us[within]
    samples = [(pixel, after_us, after), (peak, peak_us, np.log(view.see(peak, peak_us)[0]))]
    parts = np.stack([pixel, before_us, before, after_us, after])
    while True:
        parts = parts[:, (np.abs(parts[4] - parts[2]) > largest_change) & (parts[3] - parts[1] > _FINEST_US)]
        if not parts.shape[1]:
            break
        pixel, middle_us = parts[0].astype(np.int64), (parts[1] + parts[3]) / 2
        middle = np.log(view.see(pixel, middle_us)[0])
        samples.append((pixel, middle_us, middle))
        first, second = parts.copy(), parts
        first[3:], second[1:3] = (middle_us, middle), (middle_us, middle)
        parts = np.concatenate([first, second], axis=1)
    pixel, at_us, log_brightness = (np.concatenate(columns) for columns in zip(*samples, strict=True))
    # Sort by pixel, then time, scaled to below 1; the data are nearly sorted, which a stable sort exploits.
    order = np.argsort(pixel + (at_us - t_us[seen]) / (t_us[until] - t_us[seen] + 1), kind="stable")
    return pixel[order], at_us[order], log_brightness[order]


def _peaks(
    t_us: Float[np.ndarray, "times"], brightness: Float[np.ndarray, "times pixels"]
) -> tuple[Int64[np.ndarray, "peaks"], Float[np.ndarray, "peaks"]]:
    """Pixel and time of extrema, from the parabola through the three samples around each."""
    slope = np.diff(brightness, axis=0) / np.diff(t_us)[:, None]
    row, pixel = np.nonzero(slope[:-1] * slope[1:] < 0)
    middle_us = (t_us[1:] + t_us[:-1]) / 2
    first, second = slope[row, pixel], slope[row + 1, pixel]
    return pixel, middle_us[row] + (middle_us[row + 1] - middle_us[row]) * first / (first - second)


def _sharpened(view: View, sensor: EventSensor, crossings: Crossings) -> Float[np.ndarray, "events"]:
    """Exact times at which the view crosses the levels, by the Illinois method between the samples around each."""
    t_us = crossings.t_us.copy()
    below_us, below = crossings.before_us.copy(), crossings.before - crossings.level
    above_us, above = crossings.after_us.copy(), crossings.after - crossings.level
    # A shrinking threshold can cause a crossing without a sign change, which has no root to find.
    (some,) = np.nonzero((above_us - below_us > _FINEST_US) & (np.sign(below) != np.sign(above)))
    for _ in range(_SHARPENINGS):
        if not len(some):
            break
        value = np.log(view.see(crossings.pixel[some], t_us[some])[0]) + sensor.leak(t_us[some]) - crossings.level[some]
        early = np.sign(value) == np.sign(below[some])
        low, high = some[early], some[~early]
        below_us[low], below[low], above[low] = t_us[low], value[early], above[low] / 2
        above_us[high], above[high], below[high] = t_us[high], value[~early], below[high] / 2
        rise = above[some] - below[some]
        share = np.divide(-below[some], rise, out=np.zeros_like(rise), where=rise != 0)
        better_us = below_us[some] + share * (above_us[some] - below_us[some])
        moved_us, t_us[some] = np.abs(better_us - t_us[some]), better_us
        some = some[moved_us > _SHARP_US]
    return t_us
