"""The trained scene to export, in the input's world frame, scale and clock."""

from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Float, Int64
from torch import Tensor

from ebarf_ns.geometry.cameras import Camera
from ebarf_ns.geometry.trajectory import Poses, Trajectory
from ebarf_ns.scene import Scene
from ebarf_ns.simulation.sensor import SensorModel


class Seen(NamedTuple):
    """Results of rendered rays, float32."""

    brightness: Float[np.ndarray, "rays"]
    """Log brightness, up to an offset and, if the contrast thresholds are unknown, a gain."""
    distance: Float[np.ndarray, "rays"]
    """Distance of the surface along the ray, in the trajectory's unit."""
    spread: Float[np.ndarray, "rays"]
    """Distance between the quantiles that contain half of the compositing weight around it, in the same unit."""
    accumulation: Float[np.ndarray, "rays"]
    """Opacity: the share of light from the scene rather than the background."""


class Subject(Protocol):
    """A trained scene."""

    scene: Scene
    camera: Camera
    """The camera, with learned intrinsics if any."""
    trajectory: Trajectory
    """The refined keyframes, on the clock of the events."""
    sensor: SensorModel
    """The sensor model, with known and learned parameters."""

    def poses_at(self, t_us: Int64[Tensor, "times"]) -> Poses:
        """Return refined poses, float64; times outside the trajectory's span are clamped to it."""
        ...

    def see(self, origin: Float[np.ndarray, "rays 3"], direction: Float[np.ndarray, "rays 3"]) -> Seen:
        """Render rays with unit directions."""
        ...
