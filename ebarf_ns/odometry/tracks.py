"""Features followed through event images: corners found where there is room for them, and moved on by Lucas-Kanade."""

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

_MOST_FEATURES, _QUALITY, _APART_PX = 400, 0.005, 6
_WINDOW_PX, _LEVELS = 15, 3
_RETURNS_PX, _BORDER_PX = 0.4, 4
_TEMPLATE_KEYFRAMES, _CORRECTED_PX = 3, 1.5
_STEEPEST = 10.0
"""Bearings further from the axis than this slope are left out."""

_SETTINGS: dict[str, Any] = {
    "winSize": (_WINDOW_PX, _WINDOW_PX),
    "maxLevel": _LEVELS - 1,
    "criteria": (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.003),
}


@dataclass(frozen=True)
class Tracks:
    """Where features are in some pictures, one row an observation, ordered by picture."""

    track: Int64[np.ndarray, "observations"]
    image: Int64[np.ndarray, "observations"]
    plane: Float64[np.ndarray, "observations 2"]
    """On the plane at distance 1 of the camera, without distortion."""

    def select(self, which: Bool[np.ndarray, "observations"]) -> Tracks:
        """The observations of a mask."""
        return Tracks(self.track[which], self.image[which], self.plane[which])

    def lengths(self) -> Int64[np.ndarray, "tracks"]:
        """Number of observations by track."""
        return np.bincount(self.track)


@dataclass
class _Features:
    """Those followed now: where, their numbers, and the keyframe and place that each is compared with."""

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
    """Tracks through pictures, observed in every so many of them, the keyframes; their numbers are those of images.

    From picture to picture features are moved on, and drift; in each keyframe they are compared with an earlier one.
    """
    before, known = None, 0
    features = _Features(np.zeros((0, 2), np.float32), *(np.zeros(0, np.int64),) * 2, np.zeros((0, 2), np.float32))
    keyframes: dict[int, np.ndarray] = {}
    found: list[tuple[np.ndarray, int, np.ndarray]] = []
    for k, picture in enumerate(images):
        if before is not None and len(features.pixel):
            there, kept = _moved(before, picture, features.pixel)
            features.pixel = there
            features = features.select(kept)
        if k % every == 0:
            keyframe = k // every
            _compare(features, keyframes, picture, keyframe)
            fresh = _corners(picture, features.pixel)
            features = features.with_corners(fresh, known, keyframe)
            known += len(fresh)
            found.append((features.number, keyframe, features.pixel.astype(np.float64)))
            keyframes[keyframe] = picture
            keyframes.pop(keyframe - _TEMPLATE_KEYFRAMES, None)
        before = picture
    track = np.concatenate([number for number, _, _ in found])
    image = np.concatenate([np.full(len(number), k) for number, k, _ in found])
    bearing = camera.bearings(torch.from_numpy(np.concatenate([pixel for _, _, pixel in found]))).numpy()
    ahead = bearing[:, 2] * _STEEPEST > np.abs(bearing[:, :2]).max(axis=1)
    plane = bearing[:, :2] / np.where(ahead, bearing[:, 2], 1.0)[:, None]
    return Tracks(track, image, plane).select(ahead)


def _compare(features: _Features, keyframes: dict[int, np.ndarray], picture: np.ndarray, keyframe: int) -> None:
    """Correct features by what they looked like in earlier keyframes, in place; those too old or too different are
    compared with this one from now on."""
    stale = np.ones(len(features.pixel), bool)
    for old in np.unique(features.keyframe):
        if old not in keyframes:
            continue
        rows = np.nonzero(features.keyframe == old)[0]
        there, found, _ = cv2.calcOpticalFlowPyrLK(
            keyframes[old], picture, features.template[rows], features.pixel[rows].copy(),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **{**_SETTINGS, "maxLevel": 0},
        )  # fmt: skip
        near = (found[:, 0] == 1) & (np.linalg.norm(there - features.pixel[rows], axis=1) < _CORRECTED_PX)
        features.pixel[rows[near]] = there[near]
        stale[rows[near]] = False
    stale |= features.keyframe <= keyframe - _TEMPLATE_KEYFRAMES + 1
    features.keyframe[stale] = keyframe
    features.template[stale] = features.pixel[stale]


def displacements_px(
    one: UInt8[np.ndarray, "height width"], two: UInt8[np.ndarray, "height width"]
) -> Float64[np.ndarray, "features"]:
    """How far the features of a picture have moved in another."""
    pixel = _corners(one, np.zeros((0, 2), np.float32))
    if not len(pixel):
        return np.zeros(0)
    there, kept = _moved(one, two, pixel)
    return np.linalg.norm(there - pixel, axis=1)[kept].astype(float)


def _moved(before: np.ndarray, after: np.ndarray, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where features went, and which of them are found again where they came from when time runs backwards."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, pixel, None, **_SETTINGS)  # pyright: ignore
    back, returned, _ = cv2.calcOpticalFlowPyrLK(after, before, there, None, **_SETTINGS)  # pyright: ignore
    height, width = after.shape
    inside = ((there > _BORDER_PX) & (there < [width - 1 - _BORDER_PX, height - 1 - _BORDER_PX])).all(axis=1)
    near = np.linalg.norm(back - pixel, axis=1) < _RETURNS_PX
    kept = inside & near & (found[:, 0] == 1) & (returned[:, 0] == 1)
    return there, kept & ~_crowded(there, kept, after.shape)


def _crowded(pixel: np.ndarray, kept: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Features that have come to the place of an older one."""
    cells = np.floor(pixel / (_APART_PX / 2)).astype(np.int64)
    cell = cells[:, 1] * (max(shape) + 1) + cells[:, 0]
    cell = np.where(kept, cell, -1 - np.arange(len(cell)))
    crowded = np.ones(len(pixel), bool)
    crowded[np.unique(cell, return_index=True)[1]] = False
    return crowded


def _corners(picture: np.ndarray, taken: np.ndarray) -> np.ndarray:
    """Corners away from the border and from features that there are."""
    free = np.zeros(picture.shape, np.uint8)
    free[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX] = 255
    for x, y in taken:
        cv2.circle(free, (round(float(x)), round(float(y))), _APART_PX, 0, -1)
    room = _MOST_FEATURES - len(taken)
    if room <= 0:
        return np.zeros((0, 2), np.float32)
    corners = cv2.goodFeaturesToTrack(picture, room, _QUALITY, _APART_PX, mask=free, blockSize=5)
    return np.zeros((0, 2), np.float32) if corners is None else corners.reshape(-1, 2)
