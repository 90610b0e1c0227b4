"""Settings of exports."""

from dataclasses import dataclass
from typing import Literal

PictureFormat = Literal["mp4", "png", "exr"]
TrajectoryFileFormat = Literal["tum", "kitti", "colmap", "transforms"]


@dataclass(frozen=True)
class Span:
    """A time span, on the clock of the events."""

    start_us: int | None = None
    """Start, in microseconds. Default: the start of the refined trajectory."""
    end_us: int | None = None
    """End, in microseconds. Default: the end of the refined trajectory."""


@dataclass(frozen=True)
class RenderSettings(Span):
    """Which pictures to render."""

    format: PictureFormat = "mp4"
    """mp4: a video. png: 8-bit pictures. exr: 32-bit linear intensity, up to a common factor, and depth."""
    fps: float = 25.0
    """Pictures per second of the video."""
    slow: float = 1.0
    """Slow-motion factor of the video: 25 fps at factor 40 render 1,000 pictures per second of the recording."""
    height: int | None = None
    """Rows of a picture, with columns in proportion. Default: the sensor's."""


@dataclass(frozen=True)
class SurfaceSettings:
    """Which surface to extract, and its resolution; lengths are in the trajectory's unit."""

    voxel: float | None = None
    """Voxel size. Default: 1/160 of the extent of the visible surfaces."""
    farthest: float | None = None
    """Leave out surfaces further from the camera than this."""
    blur: float = 0.08
    """Leave out rays where half of the compositing weight is spread over more than this share of the depth. Higher:
    fewer holes, less accurate surfaces."""
