"""What can be chosen of an estimate; light, as every command imports it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class OdometrySettings:
    """How an initial trajectory is estimated."""

    keyframe_px: float = 5.0
    """How far things move between keyframes, usually."""
    memory_px: float = 4.5
    """How far they move in the time constant of the event images."""
