"""Full views from the refined trajectory, and their grey levels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from ebarf_ns.geometry.cameras import Camera

if TYPE_CHECKING:
    from jaxtyping import Float, Int64, UInt8

    from ebarf_ns.export.subject import Subject

_TONE_VIEWS, _TONE_ROWS = 12, 60
_DARKEST_PERCENT, _BRIGHTEST_PERCENT = 0.1, 99.9
_LEAST_ACCUMULATION = 0.25


@dataclass(frozen=True)
class View:
    """A rendered view with distances in the trajectory's unit; images are float32."""

    camera: Camera
    pose: Float[np.ndarray, "3 4"]
    """Camera to world, OpenCV axes."""
    bearing: Float[np.ndarray, "height width 3"]
    """Unit directions of the pixels in the camera's frame."""
    brightness: Float[np.ndarray, "height width"]
    """Log brightness."""
    distance: Float[np.ndarray, "height width"]
    """Distance of the surface along the rays; 0 where the accumulation is below 0.25."""
    spread: Float[np.ndarray, "height width"]
    """Length of the ray interval that contains half of the compositing weight."""

    @property
    def depth(self) -> Float[np.ndarray, "height width"]:
        """Distance along the optical axis."""
        return (self.distance * self.bearing[..., 2]).astype(np.float32)


def look(subject: Subject, camera: Camera, t_us: int) -> View:
    """Render the view of a camera at the refined pose of a time."""
    pose = subject.poses_at(torch.tensor([t_us])).matrix()[0].double().numpy()
    bearing = bearings(camera)
    direction = bearing.reshape(-1, 3) @ pose[:, :3].T
    seen = subject.see(np.broadcast_to(pose[:, 3], direction.shape), direction)
    distance = np.where(seen.accumulation > _LEAST_ACCUMULATION, seen.distance, 0)
    columns = (seen.brightness, distance, seen.spread)
    images = (column.reshape(camera.height, camera.width).astype(np.float32) for column in columns)
    return View(camera, pose, bearing, *images)


@lru_cache(maxsize=4)
def bearings(camera: Camera) -> Float[np.ndarray, "height width 3"]:
    """Return the unit directions of all pixels, in the camera's frame."""
    return camera.bearings(camera.pixel_grid()).numpy()


def scaled(camera: Camera, height: int) -> Camera:
    """Return the same camera with another number of rows, and columns in proportion."""
    width = max(round(camera.width * height / camera.height), 1)
    across, down = width / camera.width, height / camera.height
    # Pixel centres are at integers, corners at half-integers.
    centre = {"cx": (camera.cx + 0.5) * across - 0.5, "cy": (camera.cy + 0.5) * down - 0.5}
    return replace(camera, width=width, height=height, fx=camera.fx * across, fy=camera.fy * down, **centre)


def evenly(t_us: Int64[np.ndarray, "times"], most: int) -> Int64[np.ndarray, "chosen"]:
    """Return at most ``most`` of the times, evenly spaced, including the first and the last."""
    return t_us[np.linspace(0, len(t_us) - 1, min(most, len(t_us))).round().astype(int)]


class Tone(NamedTuple):
    """The log brightness shown as black, and the one shown as white."""

    black: float
    white: float

    def grey(self, brightness: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
        """Return 8-bit grey, linear in log brightness."""
        share = (brightness - self.black) / max(self.white - self.black, 1e-6)
        return (np.clip(share, 0, 1) * 255).round().astype(np.uint8)


def tone_of(subject: Subject, start_us: int, end_us: int) -> Tone:
    """Return black and white levels for a time span, the 0.1st and 99.9th percentiles of log brightness."""
    rows = min(_TONE_ROWS, subject.camera.height)
    t_us = np.linspace(start_us, end_us, _TONE_VIEWS).round().astype(np.int64)
    brightness = [look(subject, scaled(subject.camera, rows), one).brightness for one in t_us.tolist()]
    return Tone(*np.percentile(brightness, (_DARKEST_PERCENT, _BRIGHTEST_PERCENT)).tolist())
