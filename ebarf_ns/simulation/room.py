"""An analytic scene: a textured room with a few boxes and balls in it, seen by exact ray casting.

Surfaces are diffuse; their radiance is a smooth, band-limited pattern of position, so that it is defined everywhere
without texture files and has no detail finer than a few centimetres.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numba import njit, prange


@dataclass(frozen=True)
class Room:
    """Axis-aligned box seen from inside, with solid boxes and balls; lengths in metres."""

    lower: tuple[float, float, float] = (-2.0, -2.0, -1.0)
    upper: tuple[float, float, float] = (2.0, 2.0, 2.0)
    boxes: tuple[tuple[float, ...], ...] = (
        (0.7, -0.9, -1.0, 1.3, -0.3, -0.1),
        (1.2, 0.5, -1.0, 1.8, 1.2, 0.4),
        (0.6, 0.2, -1.0, 1.0, 0.6, -0.5),
    )
    """Lower then upper corner of each."""
    balls: tuple[tuple[float, ...], ...] = ((1.0, -0.6, 0.15, 0.25), (0.8, 0.4, -0.25, 0.25), (1.5, -1.4, -0.6, 0.4))
    """Centre and radius of each."""
    wavelength: float = 0.55
    """Coarsest detail of the pattern; the finest is a quarter of it."""
    log_contrast: float = 1.1
    """Amplitude of the pattern in log radiance."""
    seed: int = 0

    def cast(
        self, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "rays 3"]
    ) -> tuple[Float[np.ndarray, "rays"], Float[np.ndarray, "rays"]]:
        """Radiance (about 0.05 to 1.5) and distance [m] along unit directions from one point."""
        walls = np.array([*self.lower, *self.upper])
        boxes = np.array(self.boxes, float).reshape(-1, 6)
        balls = np.array(self.balls, float).reshape(-1, 4)
        return _cast(origin, direction, walls, boxes, balls, self.wavelength, self.log_contrast, self.seed)


@njit(cache=True, parallel=True)
def _cast(origin, direction, walls, boxes, balls, wavelength, log_contrast, seed):
    count = len(direction)
    radiance = np.empty(count)
    distance = np.empty(count)
    for i in prange(count):
        d = direction[i]
        nearest, normal_axis, surface = _leave_box(origin, d, walls)
        for b in range(len(boxes)):
            t, axis = _enter_box(origin, d, boxes[b])
            if t < nearest:
                nearest, normal_axis, surface = t, axis, 10 + b
        for b in range(len(balls)):
            t = _enter_ball(origin, d, balls[b])
            if t < nearest:
                nearest, normal_axis, surface = t, 3, 100 + b
        x = origin[0] + nearest * d[0]
        y = origin[1] + nearest * d[1]
        z = origin[2] + nearest * d[2]
        pattern = _pattern(x, y, z, normal_axis, surface + 1000 * seed, wavelength)
        # Each face has its own shade, so that edges show everywhere.
        shade = 0.35 * _hash(surface, normal_axis, 7, seed)
        radiance[i] = 0.3 * np.exp(log_contrast * pattern + shade)
        distance[i] = nearest
    return radiance, distance


@njit(cache=True)
def _leave_box(origin, d, box):
    nearest, normal_axis, surface = np.inf, 0, 0
    for axis in range(3):
        if d[axis] > 0:
            t = (box[3 + axis] - origin[axis]) / d[axis]
        elif d[axis] < 0:
            t = (box[axis] - origin[axis]) / d[axis]
        else:
            continue
        if t < nearest:
            nearest, normal_axis, surface = t, axis, 2 * axis + (1 if d[axis] > 0 else 0)
    return nearest, normal_axis, surface


@njit(cache=True)
def _enter_box(origin, d, box):
    near, far, normal_axis = 0.0, np.inf, 0
    for axis in range(3):
        if d[axis] == 0:
            if origin[axis] < box[axis] or origin[axis] > box[3 + axis]:
                return np.inf, 0
            continue
        t0 = (box[axis] - origin[axis]) / d[axis]
        t1 = (box[3 + axis] - origin[axis]) / d[axis]
        if t0 > t1:
            t0, t1 = t1, t0
        if t0 > near:
            near, normal_axis = t0, axis
        far = min(far, t1)
    return (near, normal_axis) if near < far and near > 0 else (np.inf, 0)


@njit(cache=True)
def _enter_ball(origin, d, ball):
    along = 0.0
    square = -ball[3] * ball[3]
    for axis in range(3):
        offset = origin[axis] - ball[axis]
        along += offset * d[axis]
        square += offset * offset
    discriminant = along * along - square
    if discriminant < 0:
        return np.inf
    t = -along - np.sqrt(discriminant)
    return t if t > 0 else np.inf


@njit(cache=True)
def _pattern(x, y, z, normal_axis, seed, wavelength):
    """Three octaves of value noise over the surface, sharpened into patches with soft edges; about -1 to 1."""
    if normal_axis == 0:
        x = 0.0
    elif normal_axis == 1:
        y = 0.0
    elif normal_axis == 2:
        z = 0.0
    value = 0.0
    for octave in range(3):
        scale = 2.0**octave / wavelength
        value += 0.7**octave * _value_noise(x * scale, y * scale, z * scale, seed + 31 * octave)
    return np.tanh(1.6 * value)


@njit(cache=True)
def _value_noise(x, y, z, seed):
    """Random values in [-1, 1] on the integer lattice, joined smoothly (quintic fade)."""
    cx, cy, cz = np.floor(x), np.floor(y), np.floor(z)
    fx, fy, fz = _fade(x - cx), _fade(y - cy), _fade(z - cz)
    ix, iy, iz = int(cx), int(cy), int(cz)
    value = 0.0
    for corner in range(8):
        dx, dy, dz = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (fx if dx else 1 - fx) * (fy if dy else 1 - fy) * (fz if dz else 1 - fz)
        value += weight * _hash(ix + dx, iy + dy, iz + dz, seed)
    return value


@njit(cache=True)
def _fade(u):
    return u * u * u * (u * (6 * u - 15) + 10)


@njit(cache=True)
def _hash(x, y, z, seed):
    """A value in [-1, 1] that looks random, from three integers and a seed."""
    h = np.uint32(x) * np.uint32(374761393) + np.uint32(y) * np.uint32(668265263)
    h = np.uint32(h) + np.uint32(z) * np.uint32(2147483647) + np.uint32(seed) * np.uint32(1274126177)
    h = np.uint32(h)
    h = np.uint32((h ^ (h >> np.uint32(13))) * np.uint32(1274126177))
    h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(2246822519))
    h = np.uint32(h ^ (h >> np.uint32(13)))
    return h / 2147483648.0 - 1.0
