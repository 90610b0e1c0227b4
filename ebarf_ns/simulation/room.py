"""An analytic scene: a textured room with a few boxes and balls, rendered by exact ray casting.

Surfaces are diffuse; their radiance is a smooth, band-limited function of position, which needs no texture files and
has no detail finer than a few centimetres.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numba import prange

from ebarf_ns.compiled import njit

_TINY = 1e-200


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
    """Lower, then upper corner of each."""
    balls: tuple[tuple[float, ...], ...] = ((1.0, -0.6, 0.15, 0.25), (0.8, 0.4, -0.25, 0.25), (1.5, -1.4, -0.6, 0.4))
    """Centre and radius of each."""
    wavelength: float = 0.55
    """Coarsest wavelength of the pattern; the finest is a quarter of it."""
    log_contrast: float = 1.1
    """Amplitude of the pattern in log radiance."""
    face_contrast: float = 0.35
    """Largest offset of a whole face in log radiance from the mean, so that edges between faces are visible."""
    window: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Lowest y and z, then highest, of a window in the wall of highest x; none if it has no area."""
    daylight: float = 1000.0
    """Radiance behind the window relative to indoors."""
    seed: int = 0

    def cast(
        self, origin: Float[np.ndarray, "rays 3"], direction: Float[np.ndarray, "rays 3"]
    ) -> tuple[Float[np.ndarray, "rays"], Float[np.ndarray, "rays"]]:
        """Radiance (indoors about 0.05 to 1.5) and distance [m] along unit directions."""
        walls = np.array([*self.lower, *self.upper])
        boxes = np.array(self.boxes, float).reshape(-1, 6)
        balls = np.array(self.balls, float).reshape(-1, 4)
        window = np.array([*self.window, np.log(self.daylight)])
        look = (self.wavelength, self.log_contrast, self.face_contrast, self.seed)
        return _cast(origin, direction, walls, boxes, balls, window, *look)


@njit(cache=True, parallel=True)
def _cast(origin, direction, walls, boxes, balls, window, wavelength, log_contrast, face_contrast, seed):
    count = len(direction)
    radiance = np.empty(count)
    distance = np.empty(count)
    for i in prange(count):
        o = (origin[i, 0], origin[i, 1], origin[i, 2])
        d = (direction[i, 0], direction[i, 1], direction[i, 2])
        # Divided once per ray; rays parallel to a face divide by a tiny number instead of 0.
        slow = (1 / (d[0] or _TINY), 1 / (d[1] or _TINY), 1 / (d[2] or _TINY))
        nearest, normal_axis, surface = _leave_box(o, slow, walls)
        for b in range(len(boxes)):
            t, axis = _enter_box(o, slow, boxes, b)
            if t < nearest:
                nearest, normal_axis, surface = t, axis, 10 + b
        for b in range(len(balls)):
            t = _enter_ball(o, d, balls, b)
            if t < nearest:
                nearest, normal_axis, surface = t, 3, 100 + b
        x = o[0] + nearest * d[0]
        y = o[1] + nearest * d[1]
        z = o[2] + nearest * d[2]
        log_radiance = log_contrast * _pattern(x, y, z, normal_axis, surface + 1000 * seed, wavelength)
        log_radiance += face_contrast * _hash(surface, normal_axis, 7, seed)
        if surface == 1 and window[0] < y < window[2] and window[1] < z < window[3]:
            log_radiance += window[4]
        radiance[i] = 0.3 * np.exp(log_radiance)
        distance[i] = nearest
    return radiance, distance


@njit(cache=True)
def _leave_box(origin, slowness, box):
    nearest, normal_axis, surface = np.inf, 0, 0
    for axis in range(3):
        forwards = slowness[axis] > 0
        t = ((box[3 + axis] if forwards else box[axis]) - origin[axis]) * slowness[axis]
        if t < nearest:
            nearest, normal_axis, surface = t, axis, 2 * axis + (1 if forwards else 0)
    return nearest, normal_axis, surface


@njit(cache=True)
def _enter_box(origin, slowness, boxes, b):
    near, far, normal_axis = 0.0, np.inf, 0
    for axis in range(3):
        t0 = (boxes[b, axis] - origin[axis]) * slowness[axis]
        t1 = (boxes[b, 3 + axis] - origin[axis]) * slowness[axis]
        t0, t1 = min(t0, t1), max(t0, t1)
        if t0 > near:
            near, normal_axis = t0, axis
        far = min(far, t1)
    return (near, normal_axis) if near < far and near > 0 else (np.inf, 0)


@njit(cache=True)
def _enter_ball(origin, d, balls, b):
    along = 0.0
    square = -balls[b, 3] * balls[b, 3]
    for axis in range(3):
        offset = origin[axis] - balls[b, axis]
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
    value, scale, weight = 0.0, 1 / wavelength, 1.0
    for octave in range(3):
        value += weight * _value_noise(x * scale, y * scale, z * scale, seed + 31 * octave)
        scale, weight = 2 * scale, 0.7 * weight
    # tanh(1.6 value)
    return 1 - 2 / (np.exp(3.2 * value) + 1)


@njit(cache=True)
def _value_noise(x, y, z, seed):
    """Random values in [-1, 1] on the integer lattice, interpolated smoothly (quintic fade)."""
    cx, cy, cz = np.floor(x), np.floor(y), np.floor(z)
    fx, fy, fz = _fade(x - cx), _fade(y - cy), _fade(z - cz)
    ix, iy, iz = int(cx), int(cy), int(cz)
    value = 0.0
    # A coordinate on the lattice, as on every face, needs no second corner.
    for dx in range(2 if fx > 0 else 1):
        wx = fx if dx else 1 - fx
        for dy in range(2 if fy > 0 else 1):
            wxy = wx * (fy if dy else 1 - fy)
            value += wxy * (1 - fz) * _hash(ix + dx, iy + dy, iz, seed)
            if fz > 0:
                value += wxy * fz * _hash(ix + dx, iy + dy, iz + 1, seed)
    return value


@njit(cache=True)
def _fade(u):
    return u * u * u * (u * (6 * u - 15) + 10)


@njit(cache=True)
def _hash(x, y, z, seed):
    """Pseudorandom value in [-1, 1] from three integers and a seed."""
    h = np.uint32(x) * np.uint32(374761393) + np.uint32(y) * np.uint32(668265263)
    h = np.uint32(h) + np.uint32(z) * np.uint32(2147483647) + np.uint32(seed) * np.uint32(1274126177)
    h = np.uint32(h)
    h = np.uint32((h ^ (h >> np.uint32(13))) * np.uint32(1274126177))
    h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(2246822519))
    h = np.uint32(h ^ (h >> np.uint32(13)))
    return h / 2147483648.0 - 1.0
