"""Smooth camera motion with six degrees of freedom, exact at every microsecond."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int64
from scipy.spatial.transform import Rotation

from ebarf_ns.geometry.so3 import quat_wxyz_exp
from ebarf_ns.geometry.trajectory import Poses, Trajectory


@dataclass(frozen=True)
class HandheldMotion:
    """A camera swayed about a place by hand: a few sinusoids of random frequency and phase on each axis."""

    place: tuple[float, float, float] = (-1.0, 0.0, 0.4)
    look_at: tuple[float, float, float] = (1.5, 0.0, -0.1)
    sway_m: tuple[float, float, float] = (0.35, 0.6, 0.3)
    turn_rad: float = 0.18
    frequency_hz: tuple[float, float] = (0.2, 0.7)
    seed: int = 0
    tones: int = 3

    def position(self, t_us: Int64[np.ndarray, "times"]) -> Float[np.ndarray, "times 3"]:
        """Camera centres [m]."""
        return np.asarray(self.place) + np.asarray(self.sway_m) * self._tones(t_us, 0)

    def rotation(self, t_us: Int64[np.ndarray, "times"]) -> Rotation:
        """Camera-to-world rotations, OpenCV axes."""
        turn = Rotation.from_rotvec(self.turn_rad * self._tones(t_us, 3))
        return _looking(np.asarray(self.look_at) - np.asarray(self.place)) * turn

    def _tones(self, t_us: np.ndarray, first_axis: int) -> np.ndarray:
        random = np.random.default_rng([self.seed, first_axis])
        frequency = random.uniform(*self.frequency_hz, (self.tones, 3))
        phase = random.uniform(0, 2 * np.pi, (self.tones, 3))
        angle = 2 * np.pi * frequency * (np.asarray(t_us) * 1e-6)[:, None, None] + phase
        return np.sin(angle).sum(axis=1) / np.sqrt(self.tones)


def _looking(forward: np.ndarray) -> Rotation:
    """The level camera (x right, y down, world z up) that looks along ``forward``."""
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return Rotation.from_matrix(np.stack([right, np.cross(forward, right), forward], axis=1))


def sample_trajectory(motion: HandheldMotion, t_us: Int64[np.ndarray, "times"]) -> Trajectory:
    """The true poses at given times, float64."""
    quat_xyzw = torch.from_numpy(motion.rotation(t_us).as_quat())
    return Trajectory(
        torch.from_numpy(t_us), Poses(torch.from_numpy(motion.position(t_us)), quat_xyzw[:, [3, 0, 1, 2]])
    )


def perturb(trajectory: Trajectory, position_noise: float, rotation_noise_rad: float, seed: int) -> Trajectory:
    """Each keyframe moved by white noise of the given standard deviations per axis, in its own frame (the paper's)."""
    random = np.random.default_rng([seed, 99])
    noise = torch.from_numpy(random.standard_normal((len(trajectory.t_us), 6)))
    turn = quat_wxyz_exp(rotation_noise_rad * noise[:, :3])
    return Trajectory(trajectory.t_us, trajectory.poses.compose(Poses(position_noise * noise[:, 3:], turn)))
