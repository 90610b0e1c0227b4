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
    return make_smoothing_spline(t, (column - column[0]) / spread)(t) * spread + column[0]
