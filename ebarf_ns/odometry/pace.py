"""A clock that runs at the rate of the events, to adapt to the speed of the image motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter1d

from ebarf_ns.events.pixels import hot_pixels

if TYPE_CHECKING:
    from jaxtyping import Bool, Float64, Int64

    from ebarf_ns.events.recording import RecordingFile

_BIN_US, _SMOOTH_BINS = 2_000, 8.0
_LEAST_SPEED = 0.25


@dataclass(frozen=True)
class Pace:
    """A clock on which the event rate is constant, as for a scene that moves at constant speed.

    It starts at 0 and ends at the recording's length in seconds. Where events are few, the rate
    counts as a quarter of its mean.
    """

    t_us: Int64[np.ndarray, "knots"]
    seconds: Float64[np.ndarray, "knots"]

    def at(self, t_us: Int64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
        """Return the clock's seconds at times; after the end, it continues at normal speed."""
        over_us = np.maximum(t_us - self.t_us[-1], 0)
        return np.interp(t_us - self.t_us[0], self.t_us - self.t_us[0], self.seconds) + 1e-6 * over_us

    def when_us(self, seconds: Float64[np.ndarray, "n"]) -> Int64[np.ndarray, "n"]:
        """Return the times at which the clock shows these seconds."""
        since_us = np.interp(seconds, self.seconds, (self.t_us - self.t_us[0]).astype(float))
        return self.t_us[0] + since_us.round().astype(np.int64)


def paced(file: RecordingFile) -> tuple[Pace, Bool[np.ndarray, "pixels"]]:
    """Return the clock of a recording, and its hot pixels, which are not counted; reads all of it in pieces."""
    _, first_us, last_us = file.span()
    size = file.width * file.height
    bins = max(-(-(last_us - first_us) // _BIN_US), 1)
    per_pixel, per_bin = np.zeros(size, np.int64), np.zeros(bins)
    for chunk in file.chunks():
        per_pixel += np.bincount(chunk.pixels(file.width), minlength=size)
    hot = hot_pixels(per_pixel, file.width)
    for chunk in file.chunks():
        counted = ((chunk.t_us - first_us) // _BIN_US).clip(max=bins - 1)[~hot[chunk.pixels(file.width)]]
        per_bin += np.bincount(counted, minlength=bins)
    rate = gaussian_filter1d(per_bin, _SMOOTH_BINS, mode="nearest")
    rate = np.maximum(rate, _LEAST_SPEED * max(float(rate.mean()), 1e-9))
    seconds = np.r_[0.0, rate.cumsum()] * (1e-6 * (last_us - first_us) / rate.sum())
    knots_us = first_us + np.arange(bins + 1) * _BIN_US
    knots_us[-1] = last_us
    return Pace(knots_us, seconds), hot
