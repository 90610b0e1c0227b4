"""The event sensor: log brightness in, threshold crossings with interpolated times out (Eq. 1)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numba import njit

from ebarf_ns.events.recording import Recording


@dataclass
class EventSensor:
    """Compares each pixel's log brightness with the level at its last event.

    Between two samples the log brightness is taken as linear in time; each level crossed gives one event.
    """

    threshold_on: float
    threshold_off: float
    width: int

    def __post_init__(self) -> None:
        self._level: np.ndarray | None = None
        self._previous: np.ndarray | None = None
        self._t_us = 0
        self._chunks: list[tuple[np.ndarray, ...]] = []

    def see(self, t_us: int, log_brightness: Float[np.ndarray, "pixels"]) -> None:
        """Take the log brightness of all pixels at a time later than the one before it."""
        if self._level is None or self._previous is None:
            # A sensor switched on long ago: levels lie anywhere within a threshold of the brightness.
            phase = np.random.default_rng(0).uniform(-1, 1, len(log_brightness))
            self._level = log_brightness + phase * np.where(phase > 0, self.threshold_off, self.threshold_on)
        else:
            events = _crossings(
                self._level, self._previous, log_brightness, self._t_us, t_us, self.threshold_on, self.threshold_off
            )
            self._chunks.append(tuple(column[np.argsort(events[1], kind="stable")] for column in events))
        self._previous, self._t_us = log_brightness, t_us

    def recording(self) -> Recording:
        """All events so far, in order of time."""
        pixel, t_us, polarity = (np.concatenate(columns) for columns in zip(*self._chunks, strict=True))
        order = np.argsort(t_us, kind="stable")
        pixel, t_us, polarity = pixel[order], t_us[order], polarity[order]
        return Recording(
            (pixel % self.width).astype(np.uint16), (pixel // self.width).astype(np.uint16), t_us, polarity
        )


@njit(cache=True)
def _crossings(level, previous, current, t0_us, t1_us, threshold_on, threshold_off):
    """Events of one interval; ``level`` is moved to that of each pixel's last event."""
    count = 0
    for pixel in range(len(level)):
        change = current[pixel] - level[pixel]
        count += int(change / threshold_on) if change > 0 else int(-change / threshold_off)
    pixels = np.empty(count, np.int64)
    times_us = np.empty(count, np.int64)
    polarities = np.empty(count, np.int8)
    i = 0
    for pixel in range(len(level)):
        change = current[pixel] - level[pixel]
        rising = change > 0
        step = threshold_on if rising else -threshold_off
        for _ in range(int(change / step)):
            level[pixel] += step
            slope = current[pixel] - previous[pixel]
            fraction = (level[pixel] - previous[pixel]) / slope if slope != 0 else 1.0
            pixels[i] = pixel
            times_us[i] = t0_us + int(round((t1_us - t0_us) * min(max(fraction, 0.0), 1.0)))
            polarities[i] = 1 if rising else -1
            i += 1
    return pixels[:i], times_us[:i], polarities[:i]
