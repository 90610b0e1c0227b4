"""Typical odometry errors of an initial trajectory."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from ebarf_ns.errors import SimulationError
from ebarf_ns.geometry.so3 import quat_wxyz_exp
from ebarf_ns.geometry.trajectory import Poses, Trajectory


@dataclass(frozen=True)
class TrajectoryErrors:
    """Errors of an initial trajectory; positions in its own unit, metres in simulations."""

    position_noise: float = 0.03
    """White noise per keyframe, as in the paper: standard deviation per axis."""
    rotation_noise_rad: float = 0.03
    position_drift: float = 0.0
    """Random walk: largest distance from the truth."""
    rotation_drift_rad: float = 0.0
    position_wander: float = 0.0
    """Low-pass noise, smooth over wander_s: standard deviation per axis."""
    rotation_wander_rad: float = 0.0
    wander_s: float = 0.2
    """Correlation time of the low-pass noise."""
    scale: float = 1.0
    """Factor on the positions."""
    clock_offset_us: int = 0
    """Offset added to the keyframe times."""
    dropped: float = 0.0
    """Share of missing keyframes; the first and the last are kept."""


NO_ERRORS = TrajectoryErrors(position_noise=0.0, rotation_noise_rad=0.0)
"""The true trajectory."""


def check_errors(errors: TrajectoryErrors) -> None:
    """Raise :class:`SimulationError` for errors that leave no trajectory."""
    for name, value in vars(errors).items():
        if not math.isfinite(value) or (value < 0 and name != "clock_offset_us"):
            raise SimulationError(f"{name} is {value}, expected 0 or more")
    if errors.dropped >= 1:
        raise SimulationError(f"dropped is {errors.dropped}, expected a share from 0 to below 1")
    if not errors.scale > 0:
        raise SimulationError(f"scale is {errors.scale}, expected a value above 0")


def perturb(trajectory: Trajectory, errors: TrajectoryErrors, seed: int) -> Trajectory:
    """Add errors to a trajectory; rotations and shifts are applied in each keyframe's local frame.

    Raises :class:`SimulationError` for errors that leave no trajectory.
    """
    check_errors(errors)
    count = len(trajectory.t_us)
    if count < 2 or seed < 0:
        raise SimulationError(f"{count} keyframes and seed {seed}, expected 2 keyframes or more, and a seed from 0 on")
    noise = torch.from_numpy(
        _random(seed, 99).standard_normal((count, 6)) * _sizes(errors.position_noise, errors.rotation_noise_rad)
        + _drift(count, seed) * _sizes(errors.position_drift, errors.rotation_drift_rad)
        + _wander(trajectory, errors.wander_s, seed) * _sizes(errors.position_wander, errors.rotation_wander_rad)
    )
    poses = trajectory.poses.compose(Poses(noise[:, 3:], quat_wxyz_exp(noise[:, :3])))
    kept = torch.from_numpy(_random(seed, 97).random(count) >= errors.dropped)
    kept[[0, -1]] = True
    return Trajectory(
        trajectory.t_us[kept] + errors.clock_offset_us,
        Poses(errors.scale * poses.position[kept], poses.quat_wxyz[kept]),
    )


def _random(seed: int, kind: int) -> np.random.Generator:
    return np.random.default_rng([seed, kind])


def _sizes(position: float, rotation_rad: float) -> Float[np.ndarray, "6"]:
    return np.repeat([rotation_rad, position], 3)


def _drift(count: int, seed: int) -> Float[np.ndarray, "keyframes 6"]:
    """Random walks of rotation and position, each with a maximum norm of 1."""
    walk = np.cumsum(_random(seed, 98).standard_normal((count, 2, 3)), axis=0)
    walk -= walk[0]
    return (walk / np.linalg.norm(walk, axis=-1, keepdims=True).max(axis=0)).reshape(count, 6)


def _wander(trajectory: Trajectory, smooth_s: float, seed: int) -> Float[np.ndarray, "keyframes 6"]:
    """Smooth noise of unit variance."""
    spacing_s = float(torch.diff(trajectory.t_us).double().mean()) * 1e-6
    rough = _random(seed, 96).standard_normal((len(trajectory.t_us), 6))
    smooth = gaussian_filter1d(rough, max(smooth_s / spacing_s, 1e-3), axis=0)
    return smooth / np.maximum(smooth.std(axis=0), 1e-12)
