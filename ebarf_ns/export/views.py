"""Whole views from the refined trajectory: what meshes, clouds and pictures are made of."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from ebarf_ns.geometry.cameras import Camera

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from jaxtyping import Bool, Float, Int64

    from ebarf_ns.export.subject import Seen, Subject

_MOST_VIEWS, _MOST_RAYS = 64, 1_000_000
_WIDEST = np.tan(np.radians(60))
_LEAST_LIGHT, _WIDEST_SPREAD = 0.5, 0.15


@dataclass(frozen=True)
class View:
    """One picture with its distances; images are height x width, float32."""

    camera: Camera
    pose: Float[np.ndarray, "3 4"]
    """Camera to world."""
    bearings: Float[np.ndarray, "height width 3"]
    """Unit directions of the pixels in the camera's frame."""
    brightness: Float[np.ndarray, "height width"]
    distance: Float[np.ndarray, "height width"]
    """Along the rays."""
    solid: Bool[np.ndarray, "height width"]
    """Where there is one surface to be seen, at that distance."""


def look(subject: Subject, camera: Camera, t_us: int) -> View:
    """What a camera sees from the refined pose of a moment."""
    pose = subject.poses_at(torch.tensor([t_us])).matrix()[0].double().numpy()
    bearings = camera.bearings(camera.pixel_grid()).numpy()
    direction = bearings.reshape(-1, 3) @ pose[:, :3].T
    seen = subject.see(np.broadcast_to(pose[:, 3], direction.shape), direction)
    solid = (seen.accumulation > _LEAST_LIGHT) & (seen.spread < _WIDEST_SPREAD)
    images = (column.reshape(camera.height, camera.width) for column in (seen.brightness, seen.distance, solid))
    return View(camera, pose, bearings, *images)


def scaled(camera: Camera, height: int) -> Camera:
    """The same camera with another number of rows, and columns in proportion."""
    factor = height / camera.height
    width = max(round(camera.width * factor), 1)
    across, down = width / camera.width, factor
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * across,
        fy=camera.fy * down,
        # Pixel centres are at integers, corners at halves.
        cx=(camera.cx + 0.5) * across - 0.5,
        cy=(camera.cy + 0.5) * down - 0.5,
    )
