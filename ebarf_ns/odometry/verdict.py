"""What an estimate is worth: told by how much of the tracks it explains, and by two that know nothing of each other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from jaxtyping import Bool, Float64, Int64

    from ebarf_ns.geometry.cameras import Camera
    from ebarf_ns.odometry.mapping import Map
    from ebarf_ns.odometry.tracks import Tracks

INLIER_PX = 2.0
_FEWEST_INLIERS, _LEAST_SHARE = 12, 0.5
_SHARES, _PLACES = (1.0, 0.8, 0.6, 0.4), 9
"""Lengths and numbers of places of the stretches on which the halves are compared, the longest first."""
_FEWEST_COMPARED = 6
_MOST_APART, _MOST_TURNED_RAD = 0.05, 0.06
_SMOOTHED = 2.0
_CELLS = (8, 6)


@dataclass(frozen=True)
class Quality:
    """What a user can judge an estimate by."""

    kind: Literal["six degrees of freedom", "rotation only"]
    span_share: float
    """Of the recording's time: what the trajectory covers."""
    keyframes: int
    tracks: int
    """That the trajectory rests on."""
    inlier_share: float
    """Of the observations: those within 2 px of where the estimate has them."""
    reprojection_px: float
    """Root mean square of those."""
    parallax_px: float
    """Median by track of what rotation alone leaves unexplained."""
    disagreement: float | None
    """Root mean square of half the difference between the trajectories by either half of the tracks, over the extent
    of the path; none of a rotation."""
    view_share: float
    """Of the picture, cut into 8 x 6 cells: those with a track, median of the keyframes."""


class Agreement(NamedTuple):
    """Where two estimates of the same keyframes agree, and how well."""

    image: Int64[np.ndarray, "images"]
    apart: float
    """Root mean square of half their difference, over the path's extent."""
    position_std: Float64[np.ndarray, "images"]
    """Half their difference in the world of the whole map, smoothed over neighbours."""
    rotation_std_rad: Float64[np.ndarray, "images"]


def explained(whole: Map, tracks: Tracks) -> Bool[np.ndarray, "images"]:
    """Keyframes of which most tracks that are seen are explained; ``tracks`` are those before any was split."""
    good = whole.residuals_px() < INLIER_PX
    count = len(whole.posed)
    inliers = np.bincount(tracks.image[good], minlength=count)
    seen = np.maximum(np.bincount(tracks.image, minlength=count), 1)
    return whole.posed & (inliers >= _FEWEST_INLIERS) & (inliers >= _LEAST_SHARE * seen)


def agreement(whole: Map, one: Map, two: Map, kept: Bool[np.ndarray, "images"]) -> Agreement | None:
    """The longest stretch of keyframes on which two maps agree; None where there is none worth having."""
    common = np.nonzero(kept & one.posed & two.posed)[0]
    if len(common) < _FEWEST_COMPARED:
        return None
    total = len(whole.posed)
    for share in _SHARES:
        length = max(round(share * total), _FEWEST_COMPARED)
        for first in np.unique(np.linspace(0, total - length, _PLACES).round().astype(int)):
            image = common[(common >= first) & (common < first + length)]
            if len(image) < max(_FEWEST_COMPARED, 0.8 * length):
                continue
            found = _compared(whole, one, two, image)
            if found.apart <= _MOST_APART and np.sqrt(np.mean(found.rotation_std_rad**2)) <= _MOST_TURNED_RAD:
                return found
    return None


def _compared(whole: Map, one: Map, two: Map, image: Int64[np.ndarray, "images"]) -> Agreement:
    (rotation, centre), (other, there) = (_aligned(half, whole, image) for half in (one, two))
    away = np.linalg.norm(centre - there, axis=1) / 2
    turned_rad = (Rotation.from_matrix(rotation).inv() * Rotation.from_matrix(other)).magnitude() / 2
    path = whole.bundle.centre[image]
    extent = max(float(np.linalg.norm(path.max(axis=0) - path.min(axis=0))), 1e-12)
    smooth = [np.sqrt(gaussian_filter1d(values**2, _SMOOTHED, mode="nearest")) for values in (away, turned_rad)]
    return Agreement(image, float(np.sqrt(np.mean(away**2))) / extent, *smooth)


def _aligned(half: Map, whole: Map, image: Int64[np.ndarray, "images"]) -> tuple[np.ndarray, np.ndarray]:
    """World from camera rotations and centres of one map in the world of another, aligned by orientation and scale,
    which is defined along a line too."""
    turn = (
        Rotation.from_matrix(whole.bundle.rotation[image]).inv() * Rotation.from_matrix(half.bundle.rotation[image])
    ).mean()
    rotation = turn.as_matrix() @ half.bundle.rotation[image].transpose(0, 2, 1)
    moved, goal = half.bundle.centre[image] @ turn.as_matrix().T, whole.bundle.centre[image]
    offset = moved - moved.mean(axis=0)
    scale = float((offset * (goal - goal.mean(axis=0))).sum() / max(float((offset**2).sum()), 1e-300))
    return rotation, goal.mean(axis=0) + scale * offset


def view_share(tracks: Tracks, camera: Camera) -> float:
    """Of the picture, cut into 8 x 6 cells: those with a track, median of the keyframes."""
    pixel = tracks.plane * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    cell = (pixel / [camera.width, camera.height] * _CELLS).clip(0, np.array(_CELLS) - 1).astype(np.int64)
    images = int(tracks.image.max()) + 1
    taken = np.zeros((images, *_CELLS), bool)
    taken[tracks.image, cell[:, 0], cell[:, 1]] = True
    return float(np.median(taken.mean(axis=(1, 2))))
