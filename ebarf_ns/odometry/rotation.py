"""Estimation of rotations alone, from which mapping starts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from jaxtyping import Float64, Int64

    from ebarf_ns.odometry.tracks import Tracks

_ROUNDS, _FEWEST_SHARED, _REWEIGHTINGS = 20, 6, 3
_ROBUST_RAD = 0.005


@dataclass(frozen=True)
class Turned:
    """Camera-from-world rotations of all keyframes, and the deviation of each track from its direction."""

    rotation: Float64[np.ndarray, "images 3 3"]
    track: Int64[np.ndarray, "tracks"]
    stray_rad: Float64[np.ndarray, "tracks"]
    """Root mean square deviation."""


def turned(tracks: Tracks) -> Turned | None:
    """Return the rotations that best align the bearings of each track; None if neighbours share too few tracks."""
    bearing = np.concatenate([tracks.plane, np.ones((len(tracks.plane), 1))], axis=1)
    bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
    number, track = np.unique(tracks.track, return_inverse=True)
    start_row = np.searchsorted(tracks.image, np.arange(int(tracks.image.max()) + 2))
    rows = [slice(*pair) for pair in zip(start_row[:-1], start_row[1:], strict=True)]
    direction, known = np.zeros((len(number), 3)), np.zeros(len(number), bool)
    poses: list[np.ndarray] = []
    for observed in rows:
        is_known = known[track[observed]]
        if poses and is_known.sum() < _FEWEST_SHARED:
            return None
        seen = track[observed]
        pose = _aligned(direction[seen[is_known]], bearing[observed][is_known], poses[-1]) if poses else np.eye(3)
        poses.append(pose)
        direction[seen[~is_known]] = bearing[observed][~is_known] @ pose
        known[seen] = True
    rotation = np.stack(poses)
    for _ in range(_ROUNDS):
        world = np.einsum("nji,nj->ni", rotation[tracks.image], bearing)
        weight = 1 / (1 + (np.linalg.norm(world - direction[track], axis=1) / _ROBUST_RAD) ** 2)
        direction = np.stack([np.bincount(track, weight * axis) for axis in world.T], axis=1)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        rotation = np.stack(
            [_aligned(direction[track[own]], bearing[own], pose) for own, pose in zip(rows, rotation, strict=True)]
        )
    world = np.einsum("nji,nj->ni", rotation[tracks.image], bearing)
    squared = ((world - direction[track]) ** 2).sum(axis=1)
    return Turned(rotation, number, np.sqrt(np.bincount(track, squared) / np.bincount(track)))


def _aligned(
    world: Float64[np.ndarray, "n 3"], camera: Float64[np.ndarray, "n 3"], start: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "3 3"]:
    """Return the camera-from-world rotation that best aligns directions, by iteratively reweighted least squares."""
    rotation = start
    for _ in range(_REWEIGHTINGS):
        error = np.linalg.norm(world @ rotation.T - camera, axis=1)
        scale = max(_ROBUST_RAD, 2 * float(np.median(error)))
        rotation = Rotation.align_vectors(camera, world, weights=1 / (1 + (error / scale) ** 2))[0].as_matrix()
    return rotation
