"""Bundle adjustment of poses and points, the latter by bearing and inverse depth, which far points keep finite.

pycolmap's was tried first: its points are Cartesian, and few of them outlast the small parallax of half a second.
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
_GOOD_ENOUGH = 1e-4


@dataclass
class Bundle:
    """Cameras at ``centre`` that see x as ``rotation (x - centre)``, and points.

    A point is at ``anchor + axes (u, v, 1) / inverse depth``; anchor and axes are those of the camera that saw it
    first, at that time, and stay when this camera is moved.
    """

    rotation: Float64[np.ndarray, "images 3 3"]
    centre: Float64[np.ndarray, "images 3"]
    anchor: Float64[np.ndarray, "points 3"]
    axes: Float64[np.ndarray, "points 3 3"]
    point: Float64[np.ndarray, "points 3"]
    """u, v and inverse depth."""

    def projected(self, image: Int64[np.ndarray, "n"], point: Int64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 2"]:
        """On the planes at 1; infinite behind a camera."""
        u, v, inverse = self.point[point].T
        ray = np.einsum("nij,nj->ni", self.axes[point], np.stack([u, v, np.ones_like(u)], axis=1))
        seen = ray + inverse[:, None] * (self.anchor[point] - self.centre[image])
        seen = np.einsum("nij,nj->ni", self.rotation[image], seen)
        ahead = seen[:, 2] > 1e-6
        return np.where(ahead[:, None], seen[:, :2] / np.where(ahead, seen[:, 2], 1.0)[:, None], np.inf)

    def positions(self) -> Float64[np.ndarray, "points 3"]:
        """Where the points are; those at infinity are very far."""
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
    """Move free cameras and, if asked to, the points that are observed, in place, by Levenberg and Marquardt's method
    on Cauchy's loss; observations are in any order."""
    order = np.lexsort([image, point])
    image, point, plane = image[order], point[order], plane[order]
    number = np.where(free, np.cumsum(free) - 1, -1)[image]
    seen, row = np.unique(point, return_inverse=True)
    first = np.searchsorted(row, np.arange(len(seen) + 1))
    usual = float(np.median(bundle.point[seen, 2])) or 1.0
    # A point whose depth nothing tells is left about where the others are.
    prior = 1 / (_DEPTH_SPREAD * usual) ** 2
    damping, cost = _FIRST_DAMPING, np.inf
    for _ in range(rounds):
        cost, camera, camera_gradient, points, gradient, mixed = _equations(
            image, number, point, row, plane, bundle.rotation, bundle.centre, bundle.anchor, bundle.axes, bundle.point,
            int(free.sum()), len(seen), focal_px, robust_px,
        )  # fmt: skip
        points[:, 2, 2] += prior
        gradient[:, 2] += prior * (bundle.point[seen, 2] - usual)
        cost += 0.5 * prior * float(((bundle.point[seen, 2] - usual) ** 2).sum())
        before = bundle.rotation.copy(), bundle.centre.copy(), bundle.point.copy()
        better = False
        while not better and damping < _MOST_DAMPING:
            step, point_step = _step(
                camera, camera_gradient, points, gradient, mixed, number, row, first, damping, points_too
            )
            _move(bundle, free, seen, step, point_step)
            after = _cost(
                image, point, plane, bundle.rotation, bundle.centre, bundle.anchor, bundle.axes, bundle.point, focal_px,
                robust_px,
            ) + 0.5 * prior * float(((bundle.point[seen, 2] - usual) ** 2).sum())  # fmt: skip
            better = after < cost
            damping = max(damping / 5, 1e-9) if better else damping * 8
            if not better:
                bundle.rotation[:], bundle.centre[:], bundle.point[:] = before
        if not better or cost - after < _GOOD_ENOUGH * cost:
            return


def _step(
    camera: np.ndarray, camera_gradient: np.ndarray, points: np.ndarray, gradient: np.ndarray, mixed: np.ndarray,
    number: np.ndarray, row: np.ndarray, first: np.ndarray, damping: float, points_too: bool,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Of the cameras, after the points are eliminated, and of the points."""
    count = len(camera)
    damped = camera.copy()
    diagonal = np.arange(6)
    damped[:, diagonal, diagonal] += damping * camera[:, diagonal, diagonal] + 1e-9
    whole = np.zeros((6 * count, 6 * count))
    for k in range(count):
        whole[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = damped[k]
    right = -camera_gradient.reshape(-1).copy()
    if not points_too:
        return _solved(whole, right).reshape(-1, 6), np.zeros_like(gradient)
    point_damped = points.copy()
    diagonal = np.arange(3)
    point_damped[:, diagonal, diagonal] += damping * points[:, diagonal, diagonal] + 1e-9
    inverse = np.linalg.inv(point_damped)
    _eliminate(whole, right, mixed, inverse, gradient, number, first)
    step = _solved(whole, right).reshape(-1, 6)
    known = number >= 0
    back = gradient.copy()
    np.add.at(back, row[known], np.einsum("nij,ni->nj", mixed[known], step[number[known]]))
    return step, -np.einsum("nij,nj->ni", inverse, back)


def _solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    if not len(right):
        return right
    try:
        return cho_solve(cho_factor(matrix, check_finite=False), right, check_finite=False)
    except np.linalg.LinAlgError:
        return np.zeros_like(right)


def _move(bundle: Bundle, free: np.ndarray, seen: np.ndarray, step: np.ndarray, point_step: np.ndarray) -> None:
    bundle.rotation[free] = Rotation.from_rotvec(step[:, :3]).as_matrix() @ bundle.rotation[free]
    bundle.centre[free] += step[:, 3:]
    moved = bundle.point[seen] + point_step
    moved[:, 2] = moved[:, 2].clip(0)
    bundle.point[seen] = moved


@njit(cache=True)
def _seen(rotation, centre, anchor, axes, point):
    """A point in a camera's frame, times its inverse depth; from its anchor, and along its axes."""
    away = anchor - centre
    ray = axes[:, 0] * point[0] + axes[:, 1] * point[1] + axes[:, 2]
    return rotation @ (ray + point[2] * away), rotation @ away, rotation @ axes


@njit(cache=True)
def _cost(image, point, plane, rotation, centre, anchor, axes, points, focal_px, robust_px):
    total = 0.0
    for n in range(len(image)):
        k, p = image[n], point[n]
        y, _, _ = _seen(rotation[k], centre[k], anchor[p], axes[p], points[p])
        if y[2] < 1e-6:
            total += 50.0
            continue
        dx, dy = focal_px * (y[0] / y[2] - plane[n, 0]), focal_px * (y[1] / y[2] - plane[n, 1])
        total += 0.5 * robust_px**2 * np.log1p((dx * dx + dy * dy) / robust_px**2)
    return total


@njit(cache=True)
def _equations(
    image, number, point, row, plane, rotation, centre, anchor, axes, points, cameras, seen, focal_px, robust_px
):
    """Cost, and the blocks of the normal equations: cameras, their gradients, points, theirs, and what couples them."""
    camera, camera_gradient = np.zeros((cameras, 6, 6)), np.zeros((cameras, 6))
    block, gradient = np.zeros((seen, 3, 3)), np.zeros((seen, 3))
    mixed = np.zeros((len(image), 6, 3))
    total = 0.0
    of_pose, of_point = np.zeros((2, 6)), np.zeros((2, 3))
    slope = np.zeros((2, 3))
    for n in range(len(image)):
        k, p, c, r = image[n], point[n], number[n], row[n]
        y, away, turned_axes = _seen(rotation[k], centre[k], anchor[p], axes[p], points[p])
        if y[2] < 1e-6:
            total += 50.0
            continue
        px, py = y[0] / y[2], y[1] / y[2]
        ex, ey = focal_px * (px - plane[n, 0]), focal_px * (py - plane[n, 1])
        squared = (ex * ex + ey * ey) / robust_px**2
        total += 0.5 * robust_px**2 * np.log1p(squared)
        weight = 1 / (1 + squared)
        slope[0, 0], slope[0, 2] = focal_px / y[2], -focal_px * px / y[2]
        slope[1, 1], slope[1, 2] = focal_px / y[2], -focal_px * py / y[2]
        for i in range(2):
            a, b, d = slope[i, 0], slope[i, 1], slope[i, 2]
            of_pose[i, 0] = d * y[1] - b * y[2]
            of_pose[i, 1] = a * y[2] - d * y[0]
            of_pose[i, 2] = b * y[0] - a * y[1]
            for j in range(3):
                along = a * rotation[k, 0, j] + b * rotation[k, 1, j] + d * rotation[k, 2, j]
                of_pose[i, 3 + j] = -points[p, 2] * along
            for j in range(2):
                of_point[i, j] = a * turned_axes[0, j] + b * turned_axes[1, j] + d * turned_axes[2, j]
            of_point[i, 2] = a * away[0] + b * away[1] + d * away[2]
        for i in range(3):
            gradient[r, i] += weight * (of_point[0, i] * ex + of_point[1, i] * ey)
            for j in range(3):
                block[r, i, j] += weight * (of_point[0, i] * of_point[0, j] + of_point[1, i] * of_point[1, j])
        if c < 0:
            continue
        for i in range(6):
            camera_gradient[c, i] += weight * (of_pose[0, i] * ex + of_pose[1, i] * ey)
            for j in range(6):
                camera[c, i, j] += weight * (of_pose[0, i] * of_pose[0, j] + of_pose[1, i] * of_pose[1, j])
            for j in range(3):
                mixed[n, i, j] = weight * (of_pose[0, i] * of_point[0, j] + of_pose[1, i] * of_point[1, j])
    return total, camera, camera_gradient, block, gradient, mixed


@njit(cache=True)
def _eliminate(whole, right, mixed, inverse, gradient, number, first) -> None:
    """Take from the cameras' equations what the points explain: their Schur complement, in place."""
    for p in range(len(first) - 1):
        for n in range(first[p], first[p + 1]):
            if number[n] < 0:
                continue
            through = mixed[n] @ inverse[p]
            a = 6 * number[n]
            for i in range(6):
                for j in range(3):
                    right[a + i] += through[i, j] * gradient[p, j]
            for m in range(first[p], first[p + 1]):
                if number[m] < 0:
                    continue
                b = 6 * number[m]
                for i in range(6):
                    for j in range(6):
                        taken = 0.0
                        for q in range(3):
                            taken += through[i, q] * mixed[m, j, q]
                        whole[a + i, b + j] -= taken
