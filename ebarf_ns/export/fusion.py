"""Truncated signed distances from many views (Curless and Levoy 1996), and the surface where they change sign.

Only what views have seen counts: a voxel behind a camera, outside its picture or hidden behind a surface is unknown,
and a cell of the surface needs eight corners that are known. Without that, walls stand along the views' cones.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit, prange

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jaxtyping import Float, Int64

    from ebarf_ns.export.views import View


class Mesh(NamedTuple):
    """Triangles with a brightness at each vertex."""

    vertex: Float[np.ndarray, "vertices 3"]
    face: Int64[np.ndarray, "faces 3"]
    brightness: Float[np.ndarray, "vertices"]


class Volume:
    """Voxels of one size over a box."""

    def __init__(self, lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"], voxel: float, truncation: float):
        self.lower, self.voxel, self.truncation = lower, voxel, truncation
        shape = tuple(np.maximum(np.ceil((upper - lower) / voxel).astype(int), 1) + 1)
        self.distance, self.weight, self.brightness, self.coloured = (np.zeros(shape, np.float32) for _ in range(4))

    def add(self, view: View) -> None:
        """Take in what a pinhole camera sees."""
        camera, pose = view.camera, view.pose
        along = np.where(view.solid, view.distance, 0).astype(np.float32)
        optics = (camera.fx, camera.fy, camera.cx, camera.cy)
        _add(
            self.distance, self.weight, self.brightness, self.coloured, self.lower, self.voxel, self.truncation,
            pose[:, :3].copy(), pose[:, 3].copy(), optics, along, view.brightness, view.certain,
        )  # fmt: skip


@njit(cache=True, parallel=True)
def _add(distance, weight, brightness, coloured, lower, voxel, truncation, rotation, position, optics, along, seen, certain):
    fx, fy, cx, cy = optics
    height, width = along.shape
    for i in prange(distance.shape[0]):
        for j in range(distance.shape[1]):
            # Along a row of voxels, what the camera sees of them changes evenly.
            x0, y0, z0 = lower[0] + i * voxel - position[0], lower[1] + j * voxel - position[1], lower[2] - position[2]
            right = rotation[0, 0] * x0 + rotation[1, 0] * y0 + rotation[2, 0] * z0
            down = rotation[0, 1] * x0 + rotation[1, 1] * y0 + rotation[2, 1] * z0
            ahead = rotation[0, 2] * x0 + rotation[1, 2] * y0 + rotation[2, 2] * z0
            for k in range(distance.shape[2]):
                u, v, w = right + k * voxel * rotation[2, 0], down + k * voxel * rotation[2, 1], ahead + k * voxel * rotation[2, 2]
                if w <= 0:
                    continue
                column, row = int(np.floor(fx * u / w + cx + 0.5)), int(np.floor(fy * v / w + cy + 0.5))
                if column < 0 or row < 0 or column >= width or row >= height or along[row, column] <= 0:
                    continue
                here = np.sqrt(u * u + v * v + w * w)
                signed = (along[row, column] - here) / truncation
                if signed < -1:
                    continue
                # What is further away is known less well.
                share = certain[row, column]
                total = weight[i, j, k] + share
                distance[i, j, k] += share / total * (min(signed, 1.0) - distance[i, j, k])
                weight[i, j, k] = total
                if signed < 1:
                    total = coloured[i, j, k] + share
                    brightness[i, j, k] += share / total * (seen[row, column] - brightness[i, j, k])
                    coloured[i, j, k] = total
