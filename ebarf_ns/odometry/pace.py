"""How fast a picture changes: a clock that runs with the events, and how many pixels things move in a second of it."""

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
_SLOWEST = 0.25


@dataclass(frozen=True)
class Pace:
    """A clock on which events come evenly, as they do where a scene passes at an even speed; it ends with the
    recording's length in seconds. Where few come, it runs at a tenth of the usual speed."""

    t_us: Int64[np.ndarray, "knots"]
    seconds: Float64[np.ndarray, "knots"]

    def at(self, t_us: Int64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
        """What the clock says at a time; it goes on evenly after the end."""
        over_us = np.maximum(t_us - self.t_us[-1], 0)
        return np.interp(t_us - self.t_us[0], self.t_us - self.t_us[0], self.seconds) + 1e-6 * over_us

    def when_us(self, seconds: Float64[np.ndarray, "n"]) -> Int64[np.ndarray, "n"]:
        """When it says so."""
        since_us = np.interp(seconds, self.seconds, (self.t_us - self.t_us[0]).astype(float))
        return self.t_us[0] + since_us.round().astype(np.int64)


def paced(file: RecordingFile) -> tuple[Pace, Bool[np.ndarray, "pixels"]]:
    """The clock of a recording, and its hot pixels, which do not count; reads all of it, a piece at a time."""
    _, first_us, last_us = file.span()
    size = file.width * file.height
    bins = max(-(-(last_us - first_us) // _BIN_US), 1)
    by_pixel, by_bin = np.zeros(size, np.int64), np.zeros(bins)
    for chunk in file.chunks():
        by_pixel += np.bincount(chunk.pixels(file.width), minlength=size)
    hot = hot_pixels(by_pixel, file.width)
    for chunk in file.chunks():
        counted = ((chunk.t_us - first_us) // _BIN_US).clip(max=bins - 1)[~hot[chunk.pixels(file.width)]]
        by_bin += np.bincount(counted, minlength=bins)
    rate = gaussian_filter1d(by_bin, _SMOOTH_BINS, mode="nearest")
    rate = np.maximum(rate, _SLOWEST * max(float(rate.mean()), 1e-9))
    seconds = np.r_[0.0, rate.cumsum()] * (1e-6 * (last_us - first_us) / rate.sum())
    knots_us = first_us + np.arange(bins + 1) * _BIN_US
    knots_us[-1] = last_us
    return Pace(knots_us, seconds), hot
