"""Smooth six-degree-of-freedom camera motions, defined at every time."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float, Int64
from scipy.spatial.transform import Rotation

from ebarf_ns.geometry.trajectory import Poses, Trajectory


class Motion(Protocol):
    """Camera pose as a function of time, in metres and microseconds."""

    def position(self, t_us: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times 3"]:
        """Camera centres [m]."""
        ...

    def rotation(self, t_us: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times 3 3"]:
        """Camera-to-world rotations, OpenCV axes."""
        ...


@dataclass(frozen=True)
class HandheldMotion:
    """A handheld camera swaying about a place: a few sinusoids of random frequency and phase on each axis."""

    place: tuple[float, float, float] = (-1.0, 0.0, 0.4)
    look_at: tuple[float, float, float] = (1.5, 0.0, -0.1)
    sway_m: tuple[float, float, float] = (0.35, 0.6, 0.3)
    turn_rad: float = 0.18
    frequency_hz: tuple[float, float] = (0.2, 0.7)
    seed: int = 0
    tones: int = 3

    def position(self, t_us: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times 3"]:
        """Camera centres [m]."""
        return np.asarray(self.place) + np.asarray(self.sway_m) * self._sway(t_us, 0)

    def rotation(self, t_us: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times 3 3"]:
        """Camera-to-world rotations, OpenCV axes."""
        turn = Rotation.from_rotvec(self.turn_rad * self._sway(t_us, 3)).as_matrix()
        return _looking(np.asarray(self.look_at) - np.asarray(self.place)) @ turn

    def _sway(self, t_us: np.ndarray, first_axis: int) -> np.ndarray:
        return _sway(t_us, self.seed, first_axis, self.frequency_hz, self.tones)


@dataclass(frozen=True)
class OrbitMotion:
    """A camera orbiting a centre that it keeps in view, with some hand sway."""

    centre: tuple[float, float, float] = (0.0, 0.0, -0.5)
    radius_m: float = 1.5
    height_m: float = 0.8
    """Above the centre."""
    rate_rad_s: float = 0.8
    sway_m: float = 0.06
    turn_rad: float = 0.05
    seed: int = 0

    def position(self, t_us: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times 3"]:
        """Camera centres [m]."""
        return self._carried(t_us) + self.sway_m * _sway(t_us, self.seed, 0)

    def rotation(self, t_us: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times 3 3"]:
        """Camera-to-world rotations, OpenCV axes."""
        turn = Rotation.from_rotvec(self.turn_rad * _sway(t_us, self.seed, 3)).as_matrix()
        return _looking(np.asarray(self.centre) - self._carried(t_us)) @ turn

    def _carried(self, t_us: np.ndarray) -> np.ndarray:
        start_rad = np.random.default_rng([self.seed, 6]).uniform(0, 2 * np.pi)
        angle_rad = start_rad + self.rate_rad_s * np.asarray(t_us) * 1e-6
        level = self.radius_m * np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=-1)
        return np.asarray(self.centre) + np.insert(level, 2, self.height_m, axis=-1)


@dataclass(frozen=True)
class Faster:
    """Another motion at a different speed."""

    motion: Motion
    speed: float

    def position(self, t_us: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times 3"]:
        """Camera centres [m]."""
        return self.motion.position(np.asarray(t_us) * self.speed)

    def rotation(self, t_us: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times 3 3"]:
        """Camera-to-world rotations, OpenCV axes."""
        return self.motion.rotation(np.asarray(t_us) * self.speed)


def _sway(
    t_us: np.ndarray, seed: int, first_axis: int, frequency_hz: tuple[float, float] = (0.2, 0.7), tones: int = 3
) -> np.ndarray:
    """Three smooth random functions of time with about unit variance."""
    random = np.random.default_rng([seed, first_axis])
    frequency = random.uniform(*frequency_hz, (tones, 3))
    phase = random.uniform(0, 2 * np.pi, (tones, 3))
    angle = 2 * np.pi * frequency * (np.asarray(t_us) * 1e-6)[:, None, None] + phase
    return np.sin(angle).sum(axis=1) / np.sqrt(tones)


def _looking(forward: np.ndarray) -> np.ndarray:
    """Rotations of level cameras (x right, y down, world z up) that look along one or many directions ``forward``."""
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=-1)


def sample_trajectory(motion: Motion, t_us: Int64[np.ndarray, "times"]) -> Trajectory:
    """True poses at given times, float64."""
    quat_xyzw = torch.from_numpy(Rotation.from_matrix(motion.rotation(t_us)).as_quat())
    return Trajectory(
        torch.from_numpy(t_us), Poses(torch.from_numpy(motion.position(t_us)), quat_xyzw[:, [3, 0, 1, 2]])
    )
