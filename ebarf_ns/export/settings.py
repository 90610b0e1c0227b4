"""What can be asked of an export."""

from dataclasses import dataclass
from typing import Literal

PictureFormat = Literal["mp4", "png", "exr"]
TrajectoryFileFormat = Literal["tum", "kitti", "colmap", "transforms"]


@dataclass(frozen=True)
class Span:
    """A stretch of time, on the clock of the events."""

    start_us: int | None = None
    """First moment; where not given, that of the refined trajectory."""
    end_us: int | None = None
    """Last moment; where not given, that of the refined trajectory."""


@dataclass(frozen=True)
class RenderSettings(Span):
    """Which pictures."""

    format: PictureFormat = "mp4"
    """mp4: a video. png: 8-bit pictures. exr: 32-bit linear intensity, up to one factor, and depth."""
    fps: float = 25.0
    """Pictures per second of the video."""
    slow: float = 1.0
    """How many times slower than it was the video shows it: 25 fps 40 times slower are 1,000 pictures a second."""
    height: int | None = None
    """Rows of a picture, columns in proportion; where not given, the sensor's."""


@dataclass(frozen=True)
class SurfaceSettings:
    """Which surface, and how fine; lengths in the trajectory's unit."""

    voxel: float | None = None
    """Size of a cell; where not given, a 160th of what is seen."""
    farthest: float | None = None
    """Leave out what is further from the camera than this."""
    blur: float = 0.08
    """Leave out rays where half of the compositing weight is spread over more than this share of the depth. Higher:
    fewer holes, less exact surfaces."""
