"""What is exported: a scene that was trained, in the input's world frame, scale and clock."""

from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Float, Int64
from torch import Tensor

from ebarf_ns.geometry.cameras import Camera
from ebarf_ns.geometry.trajectory import Poses, Trajectory
from ebarf_ns.scene import Scene
from ebarf_ns.simulation.sensor import SensorModel


class Seen(NamedTuple):
    """What rays see, float32."""

    brightness: Float[np.ndarray, "rays"]
    """Log brightness, up to an offset and, where thresholds are not known, a gain."""
    distance: Float[np.ndarray, "rays"]
    """Of the surface, along the ray, in the trajectory's unit."""
    spread: Float[np.ndarray, "rays"]
    """Distance between the quantiles that hold the half of the compositing weight around it, in the same unit."""
    accumulation: Float[np.ndarray, "rays"]
    """Opacity: share of the light that comes from the scene, not the background."""


class Subject(Protocol):
    """A trained scene."""

    scene: Scene
    camera: Camera
    """With the intrinsics that were learned, where any were."""
    trajectory: Trajectory
    """The refined keyframes, on the clock of the events."""
    sensor: SensorModel
    """What is known and what was learned of the sensor."""

    def poses_at(self, t_us: Int64[Tensor, "times"]) -> Poses:
        """Refined poses, float64; times outside the trajectory's span count as its nearer end."""
        ...

    def see(self, origin: Float[np.ndarray, "rays 3"], direction: Float[np.ndarray, "rays 3"]) -> Seen:
        """What rays with unit directions see."""
        ...
