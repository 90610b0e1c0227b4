"""Bundle adjustment of poses and points, whose inverse depth stays finite for distant points.

pycolmap was tried first: its points are Cartesian, and few of them survive the small parallax of half a second.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from jaxtyping import Bool, Float64, Int64

_DEPTH_SPREAD = 3.0
_FIRST_DAMPING, _MOST_DAMPING = 1e-3, 1e6
_LEAST_DECREASE = 1e-4


@dataclass
class Bundle:
    """Camera poses and points.

    A world point x is ``rotation (x - centre)`` in the camera's frame. A track's point is at ``anchor + axes (u, v, 1)
    / inverse depth``. Anchor and axes are the pose of the camera that first observed it, and stay fixed afterwards.
    """

    rotation: Float64[np.ndarray, "images 3 3"]
    centre: Float64[np.ndarray, "images 3"]
    anchor: Float64[np.ndarray, "points 3"]
    axes: Float64[np.ndarray, "points 3 3"]
    point: Float64[np.ndarray, "points 3"]
    """u, v and the inverse depth."""

    def projected(self, image: Int64[np.ndarray, "n"], point: Int64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 2"]:
        """Project points into images, onto the plane z = 1; infinite behind a camera."""
        u, v, inverse = self.point[point].T
        ray = np.einsum("nij,nj->ni", self.axes[point], np.stack([u, v, np.ones_like(u)], axis=1))
        local = ray + inverse[:, None] * (self.anchor[point] - self.centre[image])
        local = np.einsum("nij,nj->ni", self.rotation[image], local)
        ahead = local[:, 2] > 1e-6
        return np.where(ahead[:, None], local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None], np.inf)

    def positions(self) -> Float64[np.ndarray, "points 3"]:
        """Return the positions of the points; a point at infinity gets a very distant position."""
        u, v, inverse = self.point.T
        ray = np.einsum("nij,nj->ni", self.axes, np.stack([u, v, np.ones_like(u)], axis=1))
        return self.anchor + ray / np.maximum(inverse, 1e-9)[:, None]


def adjust(
    bundle: Bundle,
    image: Int64[np.ndarray, "n"],
    point: Int64[np.ndarray, "n"],
    plane: Float64[np.ndarray, "n 2"],
    free: Bool[np.ndarray, "images"],
    focal_px: float,
    robust_px: float,
    rounds: int,
    points_too: bool = True,
) -> None:
    """Optimize the free cameras and, with ``points_too``, the observed points, in place.

    The method is Levenberg-Marquardt on the reprojection errors with a Cauchy loss. Observations may be in any order.
    """
    order = np.lexsort([image, point])
    image, point, plane = image[order], point[order], plane[order]
    free_index = np.where(free, np.cumsum(free) - 1, -1)[image]
    observed, row = np.unique(point, return_inverse=True)
    first = np.searchsorted(row, np.arange(len(observed) + 1))
    usual_inverse = float(np.median(bundle.point[observed, 2])) or 1.0
    # A weak prior keeps points of unobservable depth near the depth of the others.
    prior = 1 / (_DEPTH_SPREAD * usual_inverse) ** 2
    damping, cost = _FIRST_DAMPING, np.inf
    for _ in range(rounds):
        cost, camera, camera_gradient, points, gradient, coupling = _normal_equations(
            image, free_index, point, row, plane, bundle.rotation, bundle.centre, bundle.anchor, bundle.axes,
            bundle.point, int(free.sum()), len(observed), focal_px, robust_px,
        )  # fmt: skip
        points[:, 2, 2] += prior
        gradient[:, 2] += prior * (bundle.point[observed, 2] - usual_inverse)
        cost += 0.5 * prior * float(((bundle.point[observed, 2] - usual_inverse) ** 2).sum())
        before = bundle.rotation.copy(), bundle.centre.copy(), bundle.point.copy()
        better = False
        while not better and damping < _MOST_DAMPING:
            step, point_step = _step(
                camera, camera_gradient, points, gradient, coupling, free_index, row, first, damping, points_too
            )
            _apply_step(bundle, free, observed, step, point_step)
            after = _cost(
                image, point, plane, bundle.rotation, bundle.centre, bundle.anchor, bundle.axes, bundle.point, focal_px,
                robust_px,
            ) + 0.5 * prior * float(((bundle.point[observed, 2] - usual_inverse) ** 2).sum())  # fmt: skip
            better = after < cost
            damping = max(damping / 5, 1e-9) if better else damping * 8
            if not better:
                bundle.rotation[:], bundle.centre[:], bundle.point[:] = before
        if not better or cost - after < _LEAST_DECREASE * cost:
            return


def _step(
    camera: np.ndarray, camera_gradient: np.ndarray, points: np.ndarray, gradient: np.ndarray, coupling: np.ndarray,
    free_index: np.ndarray, row: np.ndarray, first: np.ndarray, damping: float, points_too: bool,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the steps of the cameras, solved by the points' Schur complement, and of the points."""
    count = len(camera)
    damped = camera.copy()
    diagonal = np.arange(6)
    damped[:, diagonal, diagonal] += damping * camera[:, diagonal, diagonal] + 1e-9
    normal = np.zeros((6 * count, 6 * count))
    for k in range(count):
        normal[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = damped[k]
    rhs = -camera_gradient.reshape(-1).copy()
    if not points_too:
        return _cholesky_solve(normal, rhs).reshape(-1, 6), np.zeros_like(gradient)
    point_damped = points.copy()
    diagonal = np.arange(3)
    point_damped[:, diagonal, diagonal] += damping * points[:, diagonal, diagonal] + 1e-9
    inverse = np.linalg.inv(point_damped)
    _eliminate(normal, rhs, coupling, inverse, gradient, free_index, first)
    step = _cholesky_solve(normal, rhs).reshape(-1, 6)
    known = free_index >= 0
    point_gradient = gradient.copy()
    np.add.at(point_gradient, row[known], np.einsum("nij,ni->nj", coupling[known], step[free_index[known]]))
    return step, -np.einsum("nij,nj->ni", inverse, point_gradient)


def _cholesky_solve(matrix: np.ndarray, rhs: np.ndarray) -> np.ndarray:
    if not len(rhs):
        return rhs
    try:
        return cho_solve(cho_factor(matrix, check_finite=False), rhs, check_finite=False)
    except np.linalg.LinAlgError:
        return np.zeros_like(rhs)


def _apply_step(
    bundle: Bundle, free: np.ndarray, observed: np.ndarray, step: np.ndarray, point_step: np.ndarray
) -> None:
    bundle.rotation[free] = Rotation.from_rotvec(step[:, :3]).as_matrix() @ bundle.rotation[free]
    bundle.centre[free] += step[:, 3:]
    moved = bundle.point[observed] + point_step
    moved[:, 2] = moved[:, 2].clip(0)
    bundle.point[observed] = moved


@njit(cache=True)
def _in_camera(rotation, centre, anchor, axes, point):
    """Return a point in a camera's frame times its inverse depth, and its derivatives by that and by (u, v, 1)."""
    baseline = anchor - centre
    ray = axes[:, 0] * point[0] + axes[:, 1] * point[1] + axes[:, 2]
    return rotation @ (ray + point[2] * baseline), rotation @ baseline, rotation @ axes


@njit(cache=True)
def _cost(image, point, plane, rotation, centre, anchor, axes, points, focal_px, robust_px):
    total = 0.0
    for n in range(len(image)):
        k, p = image[n], point[n]
        y, _, _ = _in_camera(rotation[k], centre[k], anchor[p], axes[p], points[p])
        if y[2] < 1e-6:
            total += 50.0
            continue
        dx, dy = focal_px * (y[0] / y[2] - plane[n, 0]), focal_px * (y[1] / y[2] - plane[n, 1])
        total += 0.5 * robust_px**2 * np.log1p((dx * dx + dy * dy) / robust_px**2)
    return total


@njit(cache=True)
def _normal_equations(
    image,
    free_index,
    point,
    row,
    plane,
    rotation,
    centre,
    anchor,
    axes,
    points,
    camera_count,
    point_count,
    focal_px,
    robust_px,
):
    """Return the cost and the normal equations: the blocks and gradients of cameras and points, and the coupling."""
    camera, camera_gradient = np.zeros((camera_count, 6, 6)), np.zeros((camera_count, 6))
    block, gradient = np.zeros((point_count, 3, 3)), np.zeros((point_count, 3))
    coupling = np.zeros((len(image), 6, 3))
    total = 0.0
    d_pose, d_point = np.zeros((2, 6)), np.zeros((2, 3))
    d_plane = np.zeros((2, 3))
    for n in range(len(image)):
        k, p, c, r = image[n], point[n], free_index[n], row[n]
        y, d_inverse, d_bearing = _in_camera(rotation[k], centre[k], anchor[p], axes[p], points[p])
        if y[2] < 1e-6:
            total += 50.0
            continue
        px, py = y[0] / y[2], y[1] / y[2]
        ex, ey = focal_px * (px - plane[n, 0]), focal_px * (py - plane[n, 1])
        squared = (ex * ex + ey * ey) / robust_px**2
        total += 0.5 * robust_px**2 * np.log1p(squared)
        weight = 1 / (1 + squared)
        d_plane[0, 0], d_plane[0, 2] = focal_px / y[2], -focal_px * px / y[2]
        d_plane[1, 1], d_plane[1, 2] = focal_px / y[2], -focal_px * py / y[2]
        for i in range(2):
            a, b, d = d_plane[i, 0], d_plane[i, 1], d_plane[i, 2]
            d_pose[i, 0] = d * y[1] - b * y[2]
            d_pose[i, 1] = a * y[2] - d * y[0]
            d_pose[i, 2] = b * y[0] - a * y[1]
            for j in range(3):
                along = a * rotation[k, 0, j] + b * rotation[k, 1, j] + d * rotation[k, 2, j]
                d_pose[i, 3 + j] = -points[p, 2] * along
            for j in range(2):
                d_point[i, j] = a * d_bearing[0, j] + b * d_bearing[1, j] + d * d_bearing[2, j]
            d_point[i, 2] = a * d_inverse[0] + b * d_inverse[1] + d * d_inverse[2]
        for i in range(3):
            gradient[r, i] += weight * (d_point[0, i] * ex + d_point[1, i] * ey)
            for j in range(3):
                block[r, i, j] += weight * (d_point[0, i] * d_point[0, j] + d_point[1, i] * d_point[1, j])
        if c < 0:
            continue
        for i in range(6):
            camera_gradient[c, i] += weight * (d_pose[0, i] * ex + d_pose[1, i] * ey)
            for j in range(6):
                camera[c, i, j] += weight * (d_pose[0, i] * d_pose[0, j] + d_pose[1, i] * d_pose[1, j])
            for j in range(3):
                coupling[n, i, j] = weight * (d_pose[0, i] * d_point[0, j] + d_pose[1, i] * d_point[1, j])
    return total, camera, camera_gradient, block, gradient, coupling


@njit(cache=True)
def _eliminate(normal, rhs, coupling, inverse, gradient, free_index, first) -> None:
    """Eliminate the points from the cameras' equations by the Schur complement, in place."""
    for p in range(len(first) - 1):
        for n in range(first[p], first[p + 1]):
            if free_index[n] < 0:
                continue
            weighted = coupling[n] @ inverse[p]
            a = 6 * free_index[n]
            for i in range(6):
                for j in range(3):
                    rhs[a + i] += weighted[i, j] * gradient[p, j]
            for m in range(first[p], first[p + 1]):
                if free_index[m] < 0:
                    continue
                b = 6 * free_index[m]
                for i in range(6):
                    for j in range(6):
                        product = 0.0
                        for q in range(3):
                            product += weighted[i, q] * coupling[m, j, q]
                        normal[a + i, b + j] -= product
