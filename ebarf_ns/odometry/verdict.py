"""Quality of an estimate: its inliers, and the agreement of maps from two independent halves of the tracks."""

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
_STRETCH_SHARES, _STRETCH_STARTS = (1.0, 0.8, 0.6, 0.4), 9
"""Lengths of the stretches on which the halves are compared, longest first, and number of starts of each."""
_FEWEST_COMPARED = 6
_MOST_DISAGREEMENT, _MOST_ROTATION_RAD = 0.05, 0.06
_SMOOTHED_KEYFRAMES = 2.0
_CELLS = (8, 6)


@dataclass(frozen=True)
class Quality:
    """Quality figures of an estimate."""

    kind: Literal["six degrees of freedom", "rotation only"]
    span_share: float
    """Share of the recording's time that the trajectory covers."""
    keyframes: int
    tracks: int
    """Number of tracks with inliers."""
    distant_share: float
    """Share of these tracks whose parallax is too small for a distance."""
    inlier_share: float
    """Share of the observations with a reprojection error below 2 px."""
    reprojection_px: float
    """Root mean square reprojection error of the inliers."""
    parallax_px: float
    """Median over tracks of the error of a rotation-only estimate."""
    disagreement: float | None
    """Root mean square of half the difference between the trajectories of the two halves of the tracks, over the
    extent of the path; None for rotation only."""
    view_share: float
    """Share of 8 x 6 image cells with a track, median over keyframes."""


class Agreement(NamedTuple):
    """Keyframes on which two estimates agree, and their differences."""

    image: Int64[np.ndarray, "images"]
    apart: float
    """Root mean square of half the position difference, over the path's extent."""
    position_std: Float64[np.ndarray, "images"]
    """Half the position difference in the frame of the whole map, smoothed over neighbouring keyframes."""
    rotation_std_rad: Float64[np.ndarray, "images"]


def explained(whole: Map, tracks: Tracks) -> Bool[np.ndarray, "images"]:
    """Return which keyframes have mostly inliers; ``tracks`` are those before any was split."""
    good = whole.residuals_px() < INLIER_PX
    count = len(whole.posed)
    inliers = np.bincount(tracks.image[good], minlength=count)
    observed = np.maximum(np.bincount(tracks.image, minlength=count), 1)
    return whole.posed & (inliers >= _FEWEST_INLIERS) & (inliers >= _LEAST_SHARE * observed)


def agreement(whole: Map, one: Map, two: Map, kept: Bool[np.ndarray, "images"]) -> Agreement | None:
    """Return the longest stretch of keyframes on which two maps agree; None if they disagree on all."""
    common = np.nonzero(kept & one.posed & two.posed)[0]
    if len(common) < _FEWEST_COMPARED:
        return None
    total = len(whole.posed)
    for share in _STRETCH_SHARES:
        length = max(round(share * total), _FEWEST_COMPARED)
        for first in np.unique(np.linspace(0, total - length, _STRETCH_STARTS).round().astype(int)):
            image = common[(common >= first) & (common < first + length)]
            if len(image) < max(_FEWEST_COMPARED, 0.8 * length):
                continue
            found = _differences(whole, one, two, image)
            if found.apart <= _MOST_DISAGREEMENT and np.sqrt(np.mean(found.rotation_std_rad**2)) <= _MOST_ROTATION_RAD:
                return found
    return None


def _differences(whole: Map, one: Map, two: Map, image: Int64[np.ndarray, "images"]) -> Agreement:
    (rotation, centre), (other, other_centre) = (_aligned(half, whole, image) for half in (one, two))
    distance = np.linalg.norm(centre - other_centre, axis=1) / 2
    angle_rad = (Rotation.from_matrix(rotation).inv() * Rotation.from_matrix(other)).magnitude() / 2
    path = whole.bundle.centre[image]
    extent = max(float(np.linalg.norm(path.max(axis=0) - path.min(axis=0))), 1e-12)
    smooth = [
        np.sqrt(gaussian_filter1d(values**2, _SMOOTHED_KEYFRAMES, mode="nearest")) for values in (distance, angle_rad)
    ]
    return Agreement(image, float(np.sqrt(np.mean(distance**2))) / extent, *smooth)


def _aligned(half: Map, whole: Map, image: Int64[np.ndarray, "images"]) -> tuple[np.ndarray, np.ndarray]:
    """Return world-from-camera rotations and centres of one map in the frame of another.

    They are aligned by orientation and scale, which is also defined for a straight path.
    """
    turn = (
        Rotation.from_matrix(whole.bundle.rotation[image]).inv() * Rotation.from_matrix(half.bundle.rotation[image])
    ).mean()
    rotation = turn.as_matrix() @ half.bundle.rotation[image].transpose(0, 2, 1)
    rotated, goal = half.bundle.centre[image] @ turn.as_matrix().T, whole.bundle.centre[image]
    offset = rotated - rotated.mean(axis=0)
    scale = float((offset * (goal - goal.mean(axis=0))).sum() / max(float((offset**2).sum()), 1e-300))
    return rotation, goal.mean(axis=0) + scale * offset


def view_share(tracks: Tracks, camera: Camera) -> float:
    """Return the share of 8 x 6 image cells with a track, median over keyframes."""
    pixel = tracks.plane * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    cell = (pixel / [camera.width, camera.height] * _CELLS).clip(0, np.array(_CELLS) - 1).astype(np.int64)
    images = int(tracks.image.max()) + 1
    occupied = np.zeros((images, *_CELLS), bool)
    occupied[tracks.image, cell[:, 0], cell[:, 1]] = True
    return float(np.median(occupied.mean(axis=(1, 2))))
