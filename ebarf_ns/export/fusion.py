"""TSDF fusion of many views (Curless and Levoy 1996), and extraction of the surface at its zero crossing.

A view does not update voxels behind it, outside its image or occluded by a surface. A cell may contain surface only if
all eight of its corners were updated; otherwise, false walls appear along the edges of the view frustums.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit, prange

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int64

    from ebarf_ns.export.views import View

_TRUNCATION = 4
"""Truncation distance on each side of a surface, in voxels."""
_SMALLEST_SHARE = 0.002
"""Connected pieces with a smaller share of all faces are removed."""
_LEAST_VIEWS = 3
"""Least number of views that must have updated a voxel."""


class Mesh(NamedTuple):
    """Triangles, counter-clockwise as seen by the cameras, and the log brightness at their vertices."""

    vertex: Float[np.ndarray, "vertices 3"]
    face: Int64[np.ndarray, "faces 3"]
    brightness: Float[np.ndarray, "vertices"]


class Volume:
    """A grid of cubic voxels over a box in world coordinates, with truncated signed distances."""

    def __init__(self, lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"], voxel: float):
        self.lower, self.voxel = lower, voxel
        shape = tuple(np.maximum(np.ceil((upper - lower) / voxel).astype(int), 1) + 1)
        # Mean signed distance, and mean brightness near the surface, each with its number of views.
        self.distance, self.views, self.brightness, self.near_views = (np.zeros(shape, np.float32) for _ in range(4))

    def add(self, view: View) -> None:
        """Fuse the view of a pinhole camera."""
        camera, pose = view.camera, view.pose
        _add(
            self.distance, self.views, self.brightness, self.near_views,
            self.lower, self.voxel, _TRUNCATION * self.voxel,
            np.ascontiguousarray(pose[:, :3]), np.ascontiguousarray(pose[:, 3]),
            (camera.fx, camera.fy, camera.cx, camera.cy), view.distance, view.brightness,
        )  # fmt: skip

    def surface(self) -> Mesh:
        """Extract the surface in the known cells by marching cubes, without small pieces."""
        from scipy.ndimage import map_coordinates
        from skimage.measure import marching_cubes

        known = _known_cells(self.views >= min(_LEAST_VIEWS, self.views.max()))
        if not known.any() or not self.distance.min() < 0 < self.distance.max():
            return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros(0))
        position, face, _, _ = marching_cubes(self.distance, 0.0, allow_degenerate=False)
        # A face on the outermost grid plane belongs to the last cell.
        cell = np.minimum(np.floor(position[face].mean(axis=1)).astype(int), np.array(known.shape) - 1)
        face = _large_pieces(face[known[tuple(cell.T)]], len(position))
        used, face = np.unique(face, return_inverse=True)
        position = position[used]
        # Interpolate between near voxels only, because the others have no brightness.
        has_brightness = (self.near_views > 0).astype(np.float32)
        brightness, near = (map_coordinates(image, position.T, order=1) for image in (self.brightness, has_brightness))
        return Mesh(self.lower + self.voxel * position, face.reshape(-1, 3), brightness / np.maximum(near, 1e-6))


def _known_cells(known: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x-1 y-1 z-1"]:
    """Return which cells have eight known corners."""
    for axis in range(3):
        first, second = (np.take(known, range(k, known.shape[axis] - 1 + k), axis=axis) for k in (0, 1))
        known = first & second
    return known


def _large_pieces(face: Int64[np.ndarray, "faces 3"], vertices: int) -> Int64[np.ndarray, "kept 3"]:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    start, end = face[:, [0, 1]].ravel(), face[:, [1, 2]].ravel()
    graph = coo_array((np.ones(len(start), bool), (start, end)), shape=(vertices, vertices))
    _, piece = connected_components(graph, directed=False)
    face_piece = piece[face[:, 0]]
    return face[np.bincount(face_piece)[face_piece] >= _SMALLEST_SHARE * len(face)]


@njit(cache=True, parallel=True)
def _add(
    distance,
    views,
    brightness,
    near_views,
    lower,
    voxel,
    truncation,
    rotation,
    position,
    optics,
    ray_distance,
    view_brightness,
):
    fx, fy, cx, cy = optics
    height, width = ray_distance.shape
    for i in prange(distance.shape[0]):
        for j in range(distance.shape[1]):
            x0, y0, z0 = lower[0] + i * voxel - position[0], lower[1] + j * voxel - position[1], lower[2] - position[2]
            right = rotation[0, 0] * x0 + rotation[1, 0] * y0 + rotation[2, 0] * z0
            down = rotation[0, 1] * x0 + rotation[1, 1] * y0 + rotation[2, 1] * z0
            ahead = rotation[0, 2] * x0 + rotation[1, 2] * y0 + rotation[2, 2] * z0
            for k in range(distance.shape[2]):
                # Camera coordinates are linear along a row of voxels.
                step = k * voxel
                x, y, z = right + step * rotation[2, 0], down + step * rotation[2, 1], ahead + step * rotation[2, 2]
                if z <= 0:
                    continue
                column, row = int(np.floor(fx * x / z + cx + 0.5)), int(np.floor(fy * y / z + cy + 0.5))
                if column < 0 or row < 0 or column >= width or row >= height or ray_distance[row, column] <= 0:
                    continue
                signed = (ray_distance[row, column] - np.sqrt(x * x + y * y + z * z)) / truncation
                if signed < -1:
                    continue
                views[i, j, k] += 1
                distance[i, j, k] += (min(signed, 1.0) - distance[i, j, k]) / views[i, j, k]
                if signed < 1:
                    near_views[i, j, k] += 1
                    brightness[i, j, k] += (view_brightness[row, column] - brightness[i, j, k]) / near_views[i, j, k]
