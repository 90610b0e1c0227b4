"""Take out of a trajectory what no hand could have done."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.interpolate import make_smoothing_spline

from ebarf_ns.geometry.trajectory import Poses, Trajectory

if TYPE_CHECKING:
    from jaxtyping import Float

_FEWEST = 5  # a cubic smoothing spline needs five knots
_FEW, _MOST = 120, 400


def smoothed(trajectory: Trajectory) -> Trajectory:
    """The keyframes moved onto a smoothing spline whose stiffness generalised cross-validation chooses.

    Independent errors of the keyframes shrink by the number of keyframes per movement; keyframes that already lie on
    a smooth path are left where they are, since cross-validation then chooses no smoothing (Craven & Wahba 1978).
    """
    if len(trajectory.t_us) < _FEWEST:
        return trajectory
    t = (trajectory.t_us - trajectory.t_us[0]).numpy() / float(trajectory.t_us.diff().double().mean())
    quat_wxyz = trajectory.poses.quat_wxyz.double().numpy()
    # Neighbours on the same side of the double cover, so that components run smoothly.
    flips = np.sign((quat_wxyz[1:] * quat_wxyz[:-1]).sum(axis=1))
    quat_wxyz = quat_wxyz * np.r_[1, np.cumprod(np.where(flips == 0, 1, flips))][:, None]
    position = _smooth(t, trajectory.poses.position.double().numpy())
    turned = _smooth(t, quat_wxyz)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    moved = Poses(torch.from_numpy(position), torch.from_numpy(turned))
    return Trajectory(trajectory.t_us, Poses(*(new.to(old) for new, old in zip(moved, trajectory.poses, strict=True))))


def _smooth(t: Float[np.ndarray, "keyframes"], columns: Float[np.ndarray, "keyframes dim"]) -> np.ndarray:
    return np.stack([_smooth_column(t, column) for column in columns.T], axis=1)


def _smooth_column(t: Float[np.ndarray, "keyframes"], column: Float[np.ndarray, "keyframes"]) -> np.ndarray:
    spread = np.ptp(column)
    # Cross-validation divides by what is left to explain, which must not be rounding error.
    if spread <= 1e-9 * max(1.0, float(np.abs(column).max())):
        return column
    unit = (column - column[0]) / spread
    # scipy's own choice is the safer one among few keyframes, and among many falls short and takes minutes. Of very
    # many, every so-manieth tells; the best stiffness grows with the fifth root of their number.
    every = -(-len(t) // _MOST)
    stiffness = _stiffness(t[::every], unit[::every]) * every**0.2 if len(t) > _FEW else None
    return make_smoothing_spline(t, unit, lam=stiffness)(t) * spread + column[0]


def _stiffness(t: Float[np.ndarray, "keyframes"], column: Float[np.ndarray, "keyframes"]) -> float:
    """The weight of bending against distance that minimises the generalised cross-validation score.

    With the bending energy f' K f, K = Q R⁻¹ Q' (Green & Silverman 1994, 2.1), a fit is (1 + weight K)⁻¹ y; in the
    eigenvectors of K every weight is tried at once.
    """
    gap = np.diff(t)
    inner = np.arange(len(t) - 2)
    second = np.zeros((len(t), len(t) - 2))
    second[inner, inner], second[inner + 2, inner] = 1 / gap[:-1], 1 / gap[1:]
    second[inner + 1, inner] = -1 / gap[:-1] - 1 / gap[1:]
    mass = np.diag((gap[:-1] + gap[1:]) / 3) + np.diag(gap[1:-1] / 6, 1) + np.diag(gap[1:-1] / 6, -1)
    bending, direction = np.linalg.eigh(second @ np.linalg.solve(mass, second.T))
    weights = np.geomspace(1e-8, 1e12, 201)
    left_out = weights[:, None] * bending.clip(0) / (1 + weights[:, None] * bending.clip(0))
    score = (left_out**2 * (direction.T @ column) ** 2).sum(axis=1) / left_out.sum(axis=1) ** 2
    return float(weights[score.argmin()])
