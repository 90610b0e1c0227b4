"""Smooth noisy keyframe poses by a smoothing spline."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.interpolate import make_smoothing_spline

from ebarf_ns.geometry.trajectory import Poses, Trajectory

if TYPE_CHECKING:
    from jaxtyping import Float

_FEWEST = 5  # a cubic smoothing spline needs five knots
_MOST = 400
_ROBUSTNESS = 0.5


def smoothed(trajectory: Trajectory) -> Trajectory:
    """The keyframes moved onto smoothing splines, one for positions and one for rotations, with stiffness chosen by
    generalised cross-validation.

    Independent keyframe errors shrink with the number of keyframes per movement; keyframes on a smooth path stay in
    place, since cross-validation then chooses no smoothing (Craven & Wahba 1978).
    """
    if len(trajectory.t_us) < _FEWEST:
        return trajectory
    t = (trajectory.t_us - trajectory.t_us[0]).numpy() / float(trajectory.t_us.diff().double().mean())
    quat_wxyz = trajectory.poses.quat_wxyz.double().numpy()
    # Keep neighbours in the same hemisphere of the double cover, so that components are continuous.
    flips = np.sign((quat_wxyz[1:] * quat_wxyz[:-1]).sum(axis=1))
    quat_wxyz = quat_wxyz * np.r_[1, np.cumprod(np.where(flips == 0, 1, flips))][:, None]
    position = _smooth(t, trajectory.poses.position.double().numpy())
    turned = _smooth(t, quat_wxyz)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    moved = Poses(torch.from_numpy(position), torch.from_numpy(turned))
    return Trajectory(trajectory.t_us, Poses(*(new.to(old) for new, old in zip(moved, trajectory.poses, strict=True))))


def _smooth(t: Float[np.ndarray, "keyframes"], columns: Float[np.ndarray, "keyframes dim"]) -> np.ndarray:
    spread = np.ptp(columns, axis=0).max()
    # Cross-validation divides by the residual, which must not be rounding error.
    if spread <= 1e-9 * max(1.0, float(np.abs(columns).max())):
        return columns
    unit = (columns - columns[0]) / spread
    # Long trajectories are subsampled; the best stiffness grows with the fifth root of the number of keyframes.
    every = -(-len(t) // _MOST)
    stiffness = _stiffness(t[::every], unit[::every]) * every**0.2
    # Before SciPy 1.16, only one column at a time is supported.
    smooth = [make_smoothing_spline(t, column, lam=stiffness)(t) for column in unit.T]
    return np.stack(smooth, axis=1) * spread + columns[0]


def _stiffness(t: Float[np.ndarray, "keyframes"], columns: Float[np.ndarray, "keyframes dim"]) -> float:
    """The smoothing parameter that minimises the robust score of generalised cross-validation.

    With the bending energy f' K f, K = Q R⁻¹ Q' (Green & Silverman 1994, 2.1), a fit is A y, A = (1 + weight K)⁻¹; in
    the eigenbasis of K all weights are evaluated at once. Columns have equal noise and share one weight. With few
    keyframes the plain score sometimes overfits; it is therefore multiplied by a factor from 1/2 to 1 that grows with
    tr(A²) (Lukas 2006).
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
    power = np.square(direction.T @ columns).sum(axis=1)
    score = (left_out**2 * power).sum(axis=1) / left_out.sum(axis=1) ** 2
    robust_factor = _ROBUSTNESS + (1 - _ROBUSTNESS) * np.square(1 - left_out).mean(axis=1)
    return float(weights[(score * robust_factor).argmin()])
