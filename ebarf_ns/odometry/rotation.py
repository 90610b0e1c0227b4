"""Rotation alone: the poses of a camera that only turns, as which every motion begins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from jaxtyping import Float64, Int64

    from ebarf_ns.odometry.tracks import Tracks

_ROUNDS, _FEWEST, _GUESSES = 20, 6, 3
_ROBUST_RAD = 0.005


@dataclass(frozen=True)
class Turned:
    """Rotations, camera from world, of all keyframes, and how far each track strays from its direction."""

    rotation: Float64[np.ndarray, "images 3 3"]
    track: Int64[np.ndarray, "tracks"]
    stray_rad: Float64[np.ndarray, "tracks"]
    """Root mean square."""


def turned(tracks: Tracks) -> Turned | None:
    """The rotations that bring the bearings of each track together best; None where neighbours share too few."""
    bearing = np.concatenate([tracks.plane, np.ones((len(tracks.plane), 1))], axis=1)
    bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
    number, track = np.unique(tracks.track, return_inverse=True)
    begin = np.searchsorted(tracks.image, np.arange(int(tracks.image.max()) + 2))
    rows = [slice(*pair) for pair in zip(begin[:-1], begin[1:], strict=True)]
    point, known = np.zeros((len(number), 3)), np.zeros(len(number), bool)
    poses: list[np.ndarray] = []
    for observed in rows:
        old = known[track[observed]]
        if poses and old.sum() < _FEWEST:
            return None
        seen = track[observed]
        pose = _rotation(point[seen[old]], bearing[observed][old], poses[-1]) if poses else np.eye(3)
        poses.append(pose)
        point[seen[~old]] = bearing[observed][~old] @ pose
        known[seen] = True
    rotation = np.stack(poses)
    for _ in range(_ROUNDS):
        world = np.einsum("nji,nj->ni", rotation[tracks.image], bearing)
        weight = 1 / (1 + (np.linalg.norm(world - point[track], axis=1) / _ROBUST_RAD) ** 2)
        point = np.stack([np.bincount(track, weight * axis) for axis in world.T], axis=1)
        point /= np.linalg.norm(point, axis=1, keepdims=True)
        rotation = np.stack(
            [_rotation(point[track[own]], bearing[own], pose) for own, pose in zip(rows, rotation, strict=True)]
        )
    world = np.einsum("nji,nj->ni", rotation[tracks.image], bearing)
    squared = ((world - point[track]) ** 2).sum(axis=1)
    return Turned(rotation, number, np.sqrt(np.bincount(track, squared) / np.bincount(track)))


def _rotation(
    world: Float64[np.ndarray, "n 3"], camera: Float64[np.ndarray, "n 3"], start: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "3 3"]:
    """The rotation, camera from world, that aligns directions best, each weighted by how well a guess aligns it."""
    rotation = start
    for _ in range(_GUESSES):
        away = np.linalg.norm(world @ rotation.T - camera, axis=1)
        scale = max(_ROBUST_RAD, 2 * float(np.median(away)))
        rotation = Rotation.align_vectors(camera, world, weights=1 / (1 + (away / scale) ** 2))[0].as_matrix()
    return rotation
