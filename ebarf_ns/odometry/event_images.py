"""Images from events at given times: zero-phase high-pass filtered log brightness.

A leaky sum of the events before a time is high-pass filtered log brightness that lags behind moving edges. The negated
leaky sum of the events after it leads them. Their sum has zero phase, and is defined from the first event on.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from numba import njit

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jaxtyping import Bool, Float32, Float64, Int64, UInt8

    from ebarf_ns.events.recording import RecordingFile
    from ebarf_ns.odometry.pace import Pace

_SEGMENT_PIXELS, _FEWEST_IMAGES = 1 << 23, 20
_TIME_CONSTANTS_AHEAD = 4.0
_BLUR_PX, _CLIPPED_AT_STD = 0.7, 2.5


def event_images(
    file: RecordingFile,
    pace: Pace,
    t_us: Int64[np.ndarray, "images"],
    time_constant_s: float,
    threshold_ratio: float = 1.0,
    left_out: Bool[np.ndarray, "pixels"] | None = None,
) -> Iterator[UInt8[np.ndarray, "height width"]]:
    """Yield 8-bit images at increasing times, mid grey without events; the recording is read in segments.

    The time constant is on the clock of ``pace``; ``threshold_ratio`` is C_on / C_off; pixels that are ``left_out`` get
    the mean of their neighbours.
    """
    width, height = file.width, file.height
    up, down = np.sqrt(threshold_ratio), -1 / np.sqrt(threshold_ratio)
    before, done_us, contrast = np.zeros(width * height, np.float32), int(t_us[0]), 0.0
    segment = max(_SEGMENT_PIXELS // (width * height), _FEWEST_IMAGES)
    for first in range(0, len(t_us), segment):
        times = t_us[first : first + segment]
        until_s = float(pace.at(times[-1:])[0]) + _TIME_CONSTANTS_AHEAD * time_constant_s
        events = file.window(done_us, int(pace.when_us(np.array([until_s]))[0]))
        if left_out is not None:
            events = events.select(~left_out[events.pixels(width)])
        now, last = np.searchsorted(events.t_us, [times[0], times[-1]])
        pixel, change = events.pixels(width), np.where(events.polarity > 0, up, down)
        start_s = float(pace.at(np.array([done_us]))[0])
        event_s, image_s = pace.at(events.t_us), pace.at(times)
        past = _leaky_sums(
            pixel[:last], event_s[:last] - start_s, change[:last], image_s - start_s, before, time_constant_s
        )
        future = _leaky_sums(
            pixel[now:][::-1], until_s - event_s[now:][::-1], -change[now:][::-1],
            until_s - image_s[::-1], np.zeros_like(before), time_constant_s,
        )  # fmt: skip
        before, done_us = past[-1].copy(), int(times[-1])
        images = (past + future[::-1]).reshape(-1, height, width)
        if left_out is not None and left_out.any():
            images = _inpainted(images, left_out.reshape(height, width))
        images = np.stack([cv2.GaussianBlur(image, (0, 0), _BLUR_PX) for image in images])
        contrast = contrast or float(images.std()) or 1.0
        yield from (127.5 + 127.5 / _CLIPPED_AT_STD / contrast * images).clip(0, 255).astype(np.uint8)


def _inpainted(
    images: Float32[np.ndarray, "images height width"], left_out: Bool[np.ndarray, "height width"]
) -> Float32[np.ndarray, "images height width"]:
    """Replace the pixels that are left out by the mean of the others among their 3 x 3 neighbours."""
    kept = (~left_out).astype(np.float32)
    share = np.maximum(cv2.blur(kept, (3, 3)), 1e-6)
    return np.stack([np.where(left_out, cv2.blur(image * kept, (3, 3)) / share, image) for image in images])


@njit(cache=True)
def _leaky_sums(
    pixel: Int64[np.ndarray, "events"],
    t: Float64[np.ndarray, "events"],
    change: Float64[np.ndarray, "events"],
    at: Float64[np.ndarray, "images"],
    start: Float32[np.ndarray, "pixels"],
    time_constant: float,
) -> Float32[np.ndarray, "images pixels"]:
    """Return exponentially decaying sums of changes at increasing times; ``start`` is the sum at time 0."""
    images = np.empty((len(at), len(start)), np.float32)
    total = start.astype(np.float64)
    updated = np.zeros(len(start))
    k = 0
    for i in range(len(at)):
        while k < len(pixel) and t[k] < at[i]:
            p = pixel[k]
            total[p] = total[p] * np.exp((updated[p] - t[k]) / time_constant) + change[k]
            updated[p] = t[k]
            k += 1
        for p in range(len(start)):
            images[i, p] = total[p] * np.exp((updated[p] - at[i]) / time_constant)
    return images
