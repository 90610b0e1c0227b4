"""Radiance at the pixels of a moving camera: surroundings, motion and optics combined."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float, Int64
from numba import prange
from scipy.spatial.transform import Rotation

from ebarf_ns.compiled import njit
from ebarf_ns.geometry.cameras import Camera
from ebarf_ns.simulation.motion import Motion

_PROBE_US = 250.0
_KNOTS_EVERY_US = 50.0
# The rays of this many pixels fit in cache.
_PIXELS_AT_ONCE = 16384


def _subpixels(across: int) -> list[tuple[float, float]]:
    """A rotated grid of rays over a pixel; no two share a column or row, so edges cross them one by one."""
    turned = [(j * across + across - 1 - i, i * across + j) for i in range(across) for j in range(across)]
    return [((column + 0.5) / across**2 - 0.5, (row + 0.5) / across**2 - 0.5) for column, row in turned]


_SUBPIXELS = {across * across: _subpixels(across) for across in (1, 2, 4)}


class Surroundings(Protocol):
    """A scene that rays can be cast into."""

    def cast(
        self, origin: Float[np.ndarray, "rays 3"], direction: Float[np.ndarray, "rays 3"]
    ) -> tuple[Float[np.ndarray, "rays"], Float[np.ndarray, "rays"]]:
        """Radiance (above 0) and distance [m] along unit directions."""
        ...


@dataclass(frozen=True)
class View:
    """A camera moving through surroundings."""

    surroundings: Surroundings
    motion: Motion
    camera: Camera
    rays_per_pixel: int = 16
    """Number of rays averaged per pixel: 1, 4 or 16."""

    def see(
        self, pixel: Int64[np.ndarray, "pixels"], t_us: Float[np.ndarray, "pixels"]
    ) -> tuple[Float[np.ndarray, "pixels"], Float[np.ndarray, "pixels"]]:
        """Mean radiance and nearest distance [m] of pixels (row-major index), each at its own time."""
        # Over such short intervals, motion is linear to within a billionth.
        first_us, last_us = (t_us.min(), t_us.max()) if len(t_us) else (0.0, 0.0)
        knots_us = first_us + _KNOTS_EVERY_US * np.arange(2 + int((last_us - first_us) / _KNOTS_EVERY_US))
        rotation, position = self.motion.rotation(knots_us), self.motion.position(knots_us)
        place = (t_us - first_us) / _KNOTS_EVERY_US
        radiance, distance = np.empty(len(pixel)), np.empty(len(pixel))
        for start in range(0, len(pixel), _PIXELS_AT_ONCE):
            some = slice(start, start + _PIXELS_AT_ONCE)
            seen, away = self.surroundings.cast(*_rays(self.bearings, pixel[some], place[some], rotation, position))
            radiance[some] = seen.reshape(self.rays_per_pixel, -1).mean(axis=0)
            distance[some] = away.reshape(self.rays_per_pixel, -1).min(axis=0)
        return radiance, distance

    def images(
        self, t_us: Float[np.ndarray, "times"]
    ) -> tuple[Float[np.ndarray, "times pixels"], Float[np.ndarray, "times pixels"]]:
        """Mean radiance and nearest distance [m] of all pixels at the given times."""
        count = self.camera.width * self.camera.height
        pixel = np.tile(np.arange(count), len(t_us))
        radiance, distance = self.see(pixel, np.repeat(t_us, count))
        return radiance.reshape(-1, count), distance.reshape(-1, count)

    def velocities(
        self, t_us: Float[np.ndarray, "times"]
    ) -> tuple[Float[np.ndarray, "times 3"], Float[np.ndarray, "times 3"]]:
        """Linear [m/s] and angular [rad/s] velocity in the camera frame."""
        seconds = 2e-6 * _PROBE_US
        earlier, later = t_us - _PROBE_US, t_us + _PROBE_US
        moved = self.motion.position(later) - self.motion.position(earlier)
        turned = self.motion.rotation(earlier).transpose(0, 2, 1) @ self.motion.rotation(later)
        moved = np.einsum("nji,nj->ni", self.motion.rotation(t_us), moved)
        return moved / seconds, Rotation.from_matrix(turned).as_rotvec() / seconds

    def fastest(
        self, distance: Float[np.ndarray, "pixels"], velocity: Float[np.ndarray, "3"], turn: Float[np.ndarray, "3"]
    ) -> float:
        """Largest image speed of any pixel [pixels/s]."""
        return float(_fastest(self._middles, self.pixels_per_rad, distance, velocity, turn).max())

    @cached_property
    def bearings(self) -> Float[np.ndarray, "pixels rays 3"]:
        """Unit directions of the rays of each pixel in the camera frame."""
        centres = self.camera.pixel_grid().reshape(-1, 1, 2)
        return self.camera.bearings(centres + torch.tensor(_SUBPIXELS[self.rays_per_pixel])).numpy()

    @cached_property
    def _middles(self) -> Float[np.ndarray, "pixels 3"]:
        middle = self.bearings.mean(axis=1)
        return middle / np.linalg.norm(middle, axis=1, keepdims=True)

    @cached_property
    def pixels_per_rad(self) -> Float[np.ndarray, "pixels"]:
        """Largest number of pixels per radian at each pixel."""
        centres = self.camera.pixel_grid().reshape(-1, 1, 2)
        corners = self.camera.bearings(centres + torch.tensor([(-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5)])).numpy()
        sides = np.linalg.norm(corners[:, 1:] - corners[:, :1], axis=-1)
        return 1 / sides.min(axis=1)


@njit(cache=True, parallel=True)
def _fastest(bearings, pixels_per_rad, distance, velocity, turn):
    """Image speed of each pixel: bearings change by (v - (v·b) b) / d + turn x b as the camera moves."""
    speed = np.empty(len(bearings))
    for i in prange(len(bearings)):
        x, y, z = bearings[i]
        along = velocity[0] * x + velocity[1] * y + velocity[2] * z
        dx = (velocity[0] - along * x) / distance[i] + turn[1] * z - turn[2] * y
        dy = (velocity[1] - along * y) / distance[i] + turn[2] * x - turn[0] * z
        dz = (velocity[2] - along * z) / distance[i] + turn[0] * y - turn[1] * x
        speed[i] = pixels_per_rad[i] * np.sqrt(dx * dx + dy * dy + dz * dz)
    return speed


@njit(cache=True, parallel=True)
def _rays(bearings, pixel, place, rotation, position):
    """Ray origins and directions in the world frame: the first ray of each pixel, then the second of each.

    ``place`` is the index of the pose before each pixel's time plus the fraction of the way to the next.
    """
    per_pixel = bearings.shape[1]
    origin = np.empty((len(pixel) * per_pixel, 3))
    direction = np.empty((len(pixel) * per_pixel, 3))
    for i in prange(len(pixel)):
        knot = int(place[i])
        share = place[i] - knot
        for row in range(3):
            before, after = rotation[knot, row], rotation[knot + 1, row]
            x = before[0] + share * (after[0] - before[0])
            y = before[1] + share * (after[1] - before[1])
            z = before[2] + share * (after[2] - before[2])
            at = position[knot, row] + share * (position[knot + 1, row] - position[knot, row])
            for k in range(per_pixel):
                bearing, ray = bearings[pixel[i], k], k * len(pixel) + i
                origin[ray, row] = at
                direction[ray, row] = x * bearing[0] + y * bearing[1] + z * bearing[2]
    return origin, direction
