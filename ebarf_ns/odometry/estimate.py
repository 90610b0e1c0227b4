"""From a recording and its camera to an initial trajectory, or to the reason why there is none.

Event images, tracks through them, a map of all tracks, and two more of either half of them, which know nothing of each
other: where these disagree, no reprojection error makes up for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ebarf_ns.errors import OdometryError
from ebarf_ns.events.pixels import hot_pixels
from ebarf_ns.geometry.trajectory import Poses, Trajectory
from ebarf_ns.odometry.agreement import agreement
from ebarf_ns.odometry.event_images import event_images
from ebarf_ns.odometry.rotation import turned
from ebarf_ns.odometry.structure import Map, mapped
from ebarf_ns.odometry.tracks import Tracks, followed

if TYPE_CHECKING:
    from jaxtyping import Bool, Float64, Int64

    from ebarf_ns.events.recording import RecordingFile
    from ebarf_ns.geometry.cameras import Camera

_SHORTEST_US, _FEWEST_KEYFRAMES = 50_000, 12
_IMAGES_A_KEYFRAME = 4
_FASTEST_PX, _MOST_HALVINGS = 14.0, 2
_FEWEST_TRACKS, _TRACK_IMAGES = 20, 3
_STILL_PX = 2.0
_INLIER_PX, _LEAST_INLIERS, _LEAST_SHARE = 2.0, 12, 0.5
_LONGEST_HOLE = 3
_LEAST_SPAN = 0.4
_LEAST_VIEW = 0.15
_MOST_DISAGREEMENT = 0.08
_LEAST_COMMON = 0.6
_PARALLAX_FACTOR, _PARALLAX_PX = 1.5, 0.5
_TURNED_PX, _TURNED_SHARE = 1.2, 0.7


@dataclass(frozen=True)
class OdometrySettings:
    """How an initial trajectory is estimated."""

    keyframe_ms: float = 40.0
    """Time between keyframes; shorter where the recording is short or the motion fast."""
    time_constant_ms: float = 100.0
    """Of the event images: how long an event is seen in them."""
    seed: int = 0
    """Of the random samples that geometry is tried on."""


@dataclass(frozen=True)
class Quality:
    """What a user can judge an estimate by."""

    kind: Literal["six degrees of freedom", "rotation only"]
    span_share: float
    """Of the recording's time that the trajectory covers."""
    keyframes: int
    tracks: int
    """That the trajectory rests on."""
    inlier_share: float
    """Of the observations: those within 2 px of where the map has them."""
    reprojection_px: float
    """Root mean square of those."""
    parallax_px: float
    """Median by track of what rotation alone leaves unexplained."""
    disagreement: float | None
    """Root mean square difference of a trajectory by half of the tracks from their mean, over the path's extent."""
    view_share: float
    """Of the picture that the tracks span, median of the keyframes."""
    missing_s: tuple[tuple[float, float], ...]
    """Stretches of time within the span without keyframes."""


@dataclass(frozen=True)
class Estimate:
    """An initial trajectory that the method vouches for."""

    trajectory: Trajectory
    """Its unit is the median distance of the points from the cameras that see them."""
    points: Float64[np.ndarray, "points 3"]
    """Empty of a rotation alone."""
    position_std: Float64[np.ndarray, "keyframes"]
    rotation_std_rad: Float64[np.ndarray, "keyframes"]
    quality: Quality


def estimated(
    file: RecordingFile,
    camera: Camera,
    settings: OdometrySettings,
    threshold_ratio: float = 1.0,
    progress: Callable[[str], None] = lambda step: None,
) -> Estimate:
    """The trajectory of a recording; raises :class:`OdometryError`, which says why not and what to try."""
    count, first_us, last_us = file.span()
    if last_us - first_us < _SHORTEST_US:
        raise OdometryError(
            f"{file.path}: {count:,} events over {(last_us - first_us) / 1000:.1f} ms, expected 50 ms or more; "
            "too little moves in so short a time: give a longer recording"
        )
    tracks, t_us = _tracks(file, camera, settings, threshold_ratio, progress)
    _check_features(tracks, file, camera)
    focal_px = float(np.sqrt(camera.fx * camera.fy))
    rotation = turned(tracks)
    aside = _by_track(rotation.residuals(tracks), tracks) * focal_px if rotation else np.array([np.inf])
    parallax_px = float(np.median(aside[np.isfinite(aside)])) if np.isfinite(aside).any() else float("inf")
    progress("mapping")
    maps = mapped(tracks, focal_px, settings.seed)
    ...
