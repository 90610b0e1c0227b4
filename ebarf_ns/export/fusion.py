"""Truncated signed distances from many views (Curless and Levoy 1996), and the surface where they change sign.

A voxel behind a camera, outside its picture or hidden behind a surface is unknown, and a cell of the surface needs
eight corners that are known: without that, walls stand along the views' cones.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit, prange

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int64

    from ebarf_ns.export.views import View

_TRUNCATION = 4
"""Voxels to either side of a surface that it is told by."""
_SMALLEST_SHARE = 0.002
"""Of all faces: smaller pieces are left out."""
_LEAST_VIEWS = 3
"""That have to know a voxel."""


class Mesh(NamedTuple):
    """Triangles, counter-clockwise seen from where they were seen from, and the log brightness at their corners."""

    vertex: Float[np.ndarray, "vertices 3"]
    face: Int64[np.ndarray, "faces 3"]
    brightness: Float[np.ndarray, "vertices"]


class Volume:
    """Voxels of one size over a box, in world coordinates."""

    def __init__(self, lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"], voxel: float):
        self.lower, self.voxel = lower, voxel
        shape = tuple(np.maximum(np.ceil((upper - lower) / voxel).astype(int), 1) + 1)
        # Mean signed distance, and brightness near the surface, with the numbers of views that told them.
        self.distance, self.views, self.brightness, self.near_views = (np.zeros(shape, np.float32) for _ in range(4))

    def add(self, view: View) -> None:
        """Take in what a pinhole camera sees."""
        camera, pose = view.camera, view.pose
        _add(
            self.distance, self.views, self.brightness, self.near_views,
            self.lower, self.voxel, _TRUNCATION * self.voxel,
            np.ascontiguousarray(pose[:, :3]), np.ascontiguousarray(pose[:, 3]),
            (camera.fx, camera.fy, camera.cx, camera.cy), view.distance, view.brightness,
        )  # fmt: skip

    def surface(self) -> Mesh:
        """Marching cubes through the known cells, without small pieces."""
        from scipy.ndimage import map_coordinates
        from skimage.measure import marching_cubes

        known = _known_cells(self.views >= min(_LEAST_VIEWS, self.views.max()))
        if not known.any() or not self.distance.min() < 0 < self.distance.max():
            return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros(0))
        place, face, _, _ = marching_cubes(self.distance, 0.0, allow_degenerate=False)
        # A face on the last plane is of the last cells.
        cell = np.minimum(np.floor(place[face].mean(axis=1)).astype(int), np.array(known.shape) - 1)
        face = _large_pieces(face[known[tuple(cell.T)]], len(place))
        used, face = np.unique(face, return_inverse=True)
        place = place[used]
        # Means over the near voxels alone: others have no brightness.
        told = (self.near_views > 0).astype(np.float32)
        brightness, near = (map_coordinates(image, place.T, order=1) for image in (self.brightness, told))
        return Mesh(self.lower + self.voxel * place, face.reshape(-1, 3), brightness / np.maximum(near, 1e-6))


def _known_cells(known: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x-1 y-1 z-1"]:
    """Those with eight known corners."""
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
    of_face = piece[face[:, 0]]
    return face[np.bincount(of_face)[of_face] >= _SMALLEST_SHARE * len(face)]


@njit(cache=True, parallel=True)
def _add(distance, views, brightness, near_views, lower, voxel, truncation, rotation, position, optics, along, seen):
    fx, fy, cx, cy = optics
    height, width = along.shape
    for i in prange(distance.shape[0]):
        for j in range(distance.shape[1]):
            x0, y0, z0 = lower[0] + i * voxel - position[0], lower[1] + j * voxel - position[1], lower[2] - position[2]
            right = rotation[0, 0] * x0 + rotation[1, 0] * y0 + rotation[2, 0] * z0
            down = rotation[0, 1] * x0 + rotation[1, 1] * y0 + rotation[2, 1] * z0
            ahead = rotation[0, 2] * x0 + rotation[1, 2] * y0 + rotation[2, 2] * z0
            for k in range(distance.shape[2]):
                # Along a row of voxels, what the camera sees of them changes evenly.
                up = k * voxel
                x, y, z = right + up * rotation[2, 0], down + up * rotation[2, 1], ahead + up * rotation[2, 2]
                if z <= 0:
                    continue
                column, row = int(np.floor(fx * x / z + cx + 0.5)), int(np.floor(fy * y / z + cy + 0.5))
                if column < 0 or row < 0 or column >= width or row >= height or along[row, column] <= 0:
                    continue
                signed = (along[row, column] - np.sqrt(x * x + y * y + z * z)) / truncation
                if signed < -1:
                    continue
                views[i, j, k] += 1
                distance[i, j, k] += (min(signed, 1.0) - distance[i, j, k]) / views[i, j, k]
                if signed < 1:
                    near_views[i, j, k] += 1
                    brightness[i, j, k] += (seen[row, column] - brightness[i, j, k]) / near_views[i, j, k]
