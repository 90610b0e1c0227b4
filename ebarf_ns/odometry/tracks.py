"""Feature tracking through event images: corners, tracked by Lucas-Kanade."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jaxtyping import Bool, Float64, Int64, UInt8

    from ebarf_ns.geometry.cameras import Camera

_MOST_FEATURES, _QUALITY, _SPACING_PX = 400, 0.005, 6
_WINDOW_PX, _LEVELS = 15, 3
_ROUND_TRIP_PX, _BORDER_PX = 0.4, 4
_TEMPLATE_KEYFRAMES, _CORRECTED_PX = 3, 1.5
_LARGEST_SLOPE = 10.0
"""Bearings with a larger slope against the optical axis are left out."""

_SETTINGS: dict[str, Any] = {
    "winSize": (_WINDOW_PX, _WINDOW_PX),
    "maxLevel": _LEVELS - 1,
    "criteria": (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.003),
}


@dataclass(frozen=True)
class Tracks:
    """Observations of features in images, one per row, sorted by image."""

    track: Int64[np.ndarray, "observations"]
    image: Int64[np.ndarray, "observations"]
    plane: Float64[np.ndarray, "observations 2"]
    """Undistorted coordinates on the plane z = 1."""

    def select(self, which: Bool[np.ndarray, "observations"]) -> Tracks:
        """Return the observations selected by a mask."""
        return Tracks(self.track[which], self.image[which], self.plane[which])

    def lengths(self) -> Int64[np.ndarray, "tracks"]:
        """Return the number of observations of each track."""
        return np.bincount(self.track)


@dataclass
class _Features:
    """Tracked features: pixel positions, track numbers, and the keyframes and pixels of their templates."""

    pixel: np.ndarray
    number: np.ndarray
    keyframe: np.ndarray
    template: np.ndarray

    def select(self, which: np.ndarray) -> _Features:
        return _Features(self.pixel[which], self.number[which], self.keyframe[which], self.template[which])

    def with_corners(self, pixel: np.ndarray, first: int, keyframe: int) -> _Features:
        count = len(pixel)
        return _Features(
            np.concatenate([self.pixel, pixel]),
            np.concatenate([self.number, first + np.arange(count)]),
            np.concatenate([self.keyframe, np.full(count, keyframe)]),
            np.concatenate([self.template, pixel]),
        )


def followed(images: Iterable[UInt8[np.ndarray, "height width"]], camera: Camera, every: int) -> Tracks:
    """Track features through images; every ``every``-th image is a keyframe, in which they are observed.

    Image indices of the tracks count keyframes. Tracking from image to image drifts; therefore, each keyframe
    aligns the features with their templates in earlier keyframes.
    """
    previous, track_count = None, 0
    features = _Features(
        np.zeros((0, 2), np.float32), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2), np.float32)
    )
    keyframes: dict[int, np.ndarray] = {}
    found: list[tuple[np.ndarray, int, np.ndarray]] = []
    for k, current in enumerate(images):
        if previous is not None and len(features.pixel):
            position, kept = _track(previous, current, features.pixel)
            features.pixel = position
            features = features.select(kept)
        if k % every == 0:
            keyframe = k // every
            _correct_drift(features, keyframes, current, keyframe)
            corners = _corners(current, features.pixel)
            features = features.with_corners(corners, track_count, keyframe)
            track_count += len(corners)
            found.append((features.number, keyframe, features.pixel.astype(np.float64)))
            keyframes[keyframe] = current
            keyframes.pop(keyframe - _TEMPLATE_KEYFRAMES, None)
        previous = current
    track = np.concatenate([number for number, _, _ in found])
    image = np.concatenate([np.full(len(number), k) for number, k, _ in found])
    bearing = camera.bearings(torch.from_numpy(np.concatenate([pixel for _, _, pixel in found]))).numpy()
    ahead = bearing[:, 2] * _LARGEST_SLOPE > np.abs(bearing[:, :2]).max(axis=1)
    plane = bearing[:, :2] / np.where(ahead, bearing[:, 2], 1.0)[:, None]
    return Tracks(track, image, plane).select(ahead)


def _correct_drift(features: _Features, keyframes: dict[int, np.ndarray], current: np.ndarray, keyframe: int) -> None:
    """Align features with their templates in earlier keyframes, in place.

    Templates that are too old or do not match are replaced by this keyframe's.
    """
    stale = np.ones(len(features.pixel), bool)
    for old in np.unique(features.keyframe):
        if old not in keyframes:
            continue
        rows = np.nonzero(features.keyframe == old)[0]
        position, found, _ = cv2.calcOpticalFlowPyrLK(
            keyframes[old], current, features.template[rows], features.pixel[rows].copy(),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **{**_SETTINGS, "maxLevel": 0},
        )  # fmt: skip
        near = (found[:, 0] == 1) & (np.linalg.norm(position - features.pixel[rows], axis=1) < _CORRECTED_PX)
        features.pixel[rows[near]] = position[near]
        stale[rows[near]] = False
    stale |= features.keyframe <= keyframe - _TEMPLATE_KEYFRAMES + 1
    features.keyframe[stale] = keyframe
    features.template[stale] = features.pixel[stale]


def displacements_px(
    one: UInt8[np.ndarray, "height width"], two: UInt8[np.ndarray, "height width"]
) -> Float64[np.ndarray, "features"]:
    """Return how far features move from one image to another."""
    pixel = _corners(one, np.zeros((0, 2), np.float32))
    if not len(pixel):
        return np.zeros(0)
    position, kept = _track(one, two, pixel)
    return np.linalg.norm(position - pixel, axis=1)[kept].astype(float)


def _track(previous: np.ndarray, current: np.ndarray, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the new positions of features, and which of them pass the forward-backward check."""
    position, found, _ = cv2.calcOpticalFlowPyrLK(previous, current, pixel, None, **_SETTINGS)  # pyright: ignore
    back, returned, _ = cv2.calcOpticalFlowPyrLK(current, previous, position, None, **_SETTINGS)  # pyright: ignore
    height, width = current.shape
    inside = ((position > _BORDER_PX) & (position < [width - 1 - _BORDER_PX, height - 1 - _BORDER_PX])).all(axis=1)
    near = np.linalg.norm(back - pixel, axis=1) < _ROUND_TRIP_PX
    kept = inside & near & (found[:, 0] == 1) & (returned[:, 0] == 1)
    return position, kept & ~_crowded(position, kept, current.shape)


def _crowded(pixel: np.ndarray, kept: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return which features share a small cell with an older one."""
    cells = np.floor(pixel / (_SPACING_PX / 2)).astype(np.int64)
    cell = cells[:, 1] * (max(shape) + 1) + cells[:, 0]
    cell = np.where(kept, cell, -1 - np.arange(len(cell)))
    crowded = np.ones(len(pixel), bool)
    crowded[np.unique(cell, return_index=True)[1]] = False
    return crowded


def _corners(image: np.ndarray, existing: np.ndarray) -> np.ndarray:
    """Detect corners away from the border and from existing features."""
    free = np.zeros(image.shape, np.uint8)
    free[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX] = 255
    for x, y in existing:
        cv2.circle(free, (round(float(x)), round(float(y))), _SPACING_PX, (0,), -1)
    remaining = _MOST_FEATURES - len(existing)
    if remaining <= 0:
        return np.zeros((0, 2), np.float32)
    corners = cv2.goodFeaturesToTrack(image, remaining, _QUALITY, _SPACING_PX, mask=free, blockSize=5)
    return np.zeros((0, 2), np.float32) if corners is None else corners.reshape(-1, 2)
