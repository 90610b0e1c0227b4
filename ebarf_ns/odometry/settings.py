"""Settings of the odometry; without heavy imports, because every command imports this module."""

from dataclasses import dataclass


@dataclass(frozen=True)
class OdometrySettings:
    """Settings of the estimation of an initial trajectory."""

    keyframe_px: float = 5.0
    """Typical image motion between keyframes, in pixels."""
    memory_px: float = 4.5
    """Typical image motion during the time constant of the event images, in pixels."""
