"""Estimation of an initial trajectory from a recording and its camera, or the reason why there is none.

Features are tracked through event images and mapped. Each half of the tracks is also mapped independently of the other:
where the two maps disagree, the trajectory is rejected, however small the reprojection error is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ebarf_ns.errors import OdometryError
from ebarf_ns.geometry.trajectory import Poses, Trajectory
from ebarf_ns.odometry.event_images import event_images
from ebarf_ns.odometry.mapping import Map, halved, mapped
from ebarf_ns.odometry.pace import Pace, paced
from ebarf_ns.odometry.rotation import Turned, turned
from ebarf_ns.odometry.settings import OdometrySettings
from ebarf_ns.odometry.tracks import Tracks, displacements_px, followed
from ebarf_ns.odometry.verdict import INLIER_PX, Agreement, Quality, agreement, explained, view_share

if TYPE_CHECKING:
    from jaxtyping import Bool, Float64, Int64

    from ebarf_ns.events.recording import RecordingFile
    from ebarf_ns.geometry.cameras import Camera
    from ebarf_ns.odometry.bundle import Bundle

_SHORTEST_US, _FEWEST_KEYFRAMES, _IMAGES_PER_KEYFRAME = 50_000, 12, 4
_PILOTS, _PILOT_S, _USUAL_PX_S = 8, 0.01, 150.0
_TIME_CONSTANT_S, _KEYFRAME_S = (0.005, 0.3), (0.004, 0.1)
"""Bounds of the time constant of event images, and of the time between keyframes."""
_SHORTEST_TRACK, _FEWEST_TRACKS = 3, 20
_LEAST_VIEW, _FEWEST_MAPPED, _LEAST_SPAN = 0.45, 100, 0.5
_LEAST_MOTION_PX, _NO_PARALLAX_PX, _ROTATION_PX, _LITTLE_PARALLAX_PX = 4.0, 0.8, 1.0, 1.5
_LEAST_TRACK_SHARE = 0.3
"""Share of the keyframes that tracks must span on average to distinguish rotation from translation."""
_LEAST_INLIERS = 0.75
"""Recordings of one motion have 0.86 or more; two motions that share the features evenly have about 0.7."""
_LEAST_GAIN, _LEAST_POINT_PARALLAX_PX = 1.5, 3.0
"""Least ratio of the errors of a rotation to those of a map; and parallax below which the distance of a point is not
determined."""
_TRY_PARALLAX = "move the camera sideways by a tenth of the distance to the scene, or provide a trajectory"
_MOVING_OBJECTS = "the scene may have moving objects or too little texture"


@dataclass(frozen=True)
class Estimate:
    """An initial trajectory that passed all checks."""

    trajectory: Trajectory
    """In units of the median distance of the points."""
    points: Float64[np.ndarray, "points 3"]
    """Empty if only the rotation was estimated."""
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
    """Estimate the trajectory of a recording; raises :class:`OdometryError` with the reason and what to try."""
    count, first_us, last_us = file.span()
    if last_us - first_us < _SHORTEST_US:
        raise OdometryError(
            f"{file.path}: {count:,} events in {(last_us - first_us) / 1000:.1f} ms, too short for parallax; expected "
            f"{_SHORTEST_US // 1000} ms or more"
        )
    progress("counting events")
    pace, hot = paced(file)
    progress("tracking features")
    tracks, t_us = _tracks(file, camera, settings, pace, hot, threshold_ratio)
    per_keyframe = np.bincount(tracks.image, minlength=len(t_us))
    if np.median(per_keyframe) < _FEWEST_TRACKS:
        raise OdometryError(
            f"{file.path}: too few features, a median of {np.median(per_keyframe):.0f} per keyframe is tracked through "
            f"{_SHORTEST_TRACK} keyframes, expected {_FEWEST_TRACKS} or more; try more texture, or less noise"
        )
    focal_px = float(np.sqrt(camera.fx * camera.fy))
    view_covered = view_share(tracks, camera)
    if view_covered < _LEAST_VIEW:
        raise OdometryError(
            f"{file.path}: features cover only {view_covered:.0%} of the view, expected {_LEAST_VIEW:.0%} or more; "
            "an object may be moving instead of the camera"
        )
    progress("mapping")
    rotation = turned(tracks)
    if rotation is None:
        raise OdometryError(
            f"{file.path}: too few features, consecutive keyframes share hardly any; try more texture, or slower motion"
        )
    return _checked(file, tracks, t_us, rotation, focal_px, view_covered, progress)


def _checked(
    file: RecordingFile, tracks: Tracks, t_us: Int64[np.ndarray, "keyframes"], rotation: Turned, focal_px: float,
    view_covered: float, progress: Callable[[str], None],
) -> Estimate:  # fmt: skip
    """Return an estimate that passes all checks, rotation only if that explains the tracks; raises the reason."""
    parallax_px = focal_px * float(np.median(rotation.stray_rad))
    rotation_px = focal_px * float(Rotation.from_matrix(rotation.rotation @ rotation.rotation[0].T).magnitude().max())
    if parallax_px < _LITTLE_PARALLAX_PX and rotation_px < _LEAST_MOTION_PX:
        raise OdometryError(
            f"{file.path}: no motion, features stay within {max(parallax_px, rotation_px):.1f} px; expected a moving "
            "camera"
        )
    # With short tracks, a rotation can absorb a translation, and drifts.
    long_tracks = len(tracks.track) / len(rotation.track) >= _LEAST_TRACK_SHARE * len(t_us)
    if parallax_px < _NO_PARALLAX_PX and long_tracks:
        return _rotation_estimate(tracks, t_us, rotation, focal_px, view_covered)
    whole = mapped(tracks, focal_px, rotation)
    found, gain, reason = None, np.inf, f"no pair of keyframes can initialize the map; {_TRY_PARALLAX}"
    if whole is not None:
        kept = explained(whole, tracks)
        in_kept = kept[tracks.image]
        inliers = float((whole.residuals_px() < INLIER_PX)[in_kept].mean()) if in_kept.any() else 0.0
        reason = (
            f"camera motion explains {inliers:.0%} of the observations in {kept.sum()} of {len(t_us)} keyframes; "
            f"{_MOVING_OBJECTS}"
        )
        gain = parallax_px / max(_track_error_px(whole), 1e-9)
        if gain < _LEAST_GAIN:
            reason = f"no parallax, rotation alone leaves {parallax_px:.1f} px unexplained; {_TRY_PARALLAX}"
        elif inliers >= _LEAST_INLIERS:
            progress("checking")
            halves = [mapped(halved(tracks, which), focal_px, rotation) for which in (0, 1)]
            reason = f"the two halves of the features give different motions; {_TRY_PARALLAX}"
            if halves[0] is not None and halves[1] is not None:
                found = agreement(whole, halves[0], halves[1], kept)
    if whole is not None and found is not None:
        estimate = _map_estimate(whole, found, t_us, focal_px, parallax_px, view_covered)
        if estimate.quality.tracks >= _FEWEST_MAPPED and estimate.quality.span_share >= _LEAST_SPAN:
            return estimate
        reason = (
            f"{estimate.quality.tracks} features over {estimate.quality.span_share:.0%} of the time agree on one "
            f"motion, expected {_FEWEST_MAPPED} over {_LEAST_SPAN:.0%}; {_MOVING_OBJECTS}"
        )
    if parallax_px < _ROTATION_PX and (long_tracks or gain < _LEAST_GAIN):
        return _rotation_estimate(tracks, t_us, rotation, focal_px, view_covered)
    raise OdometryError(f"{file.path}: no reliable trajectory: {reason}")


def _track_error_px(whole: Map) -> float:
    """Return the median over tracks of the root mean square reprojection error."""
    residual = whole.residuals_px()
    known = np.isfinite(residual)
    track = whole.tracks.track[known]
    count = np.bincount(track)
    return float(np.median(np.sqrt(np.bincount(track, residual[known] ** 2)[count > 0] / count[count > 0])))


def _map_estimate(
    whole: Map,
    found: Agreement,
    t_us: Int64[np.ndarray, "keyframes"],
    focal_px: float,
    parallax_px: float,
    view_covered: float,
) -> Estimate:
    bundle, image = whole.bundle, found.image
    residual = whole.residuals_px()[np.isin(whole.tracks.image, image)]
    good = np.nonzero((whole.residuals_px() < INLIER_PX) & np.isin(whole.tracks.image, image))[0]
    track = np.unique(whole.tracks.track[good])
    distance = np.linalg.norm(bundle.positions()[track] - np.median(bundle.centre[image], axis=0), axis=1)
    near = focal_px * _baselines(bundle, whole.tracks, good)[track] > _LEAST_POINT_PARALLAX_PX * distance
    points, unit = bundle.positions()[track[near]], float(np.median(distance[near] if near.any() else distance))
    quat_xyzw = Rotation.from_matrix(bundle.rotation[image].transpose(0, 2, 1)).as_quat()
    quality = Quality(
        kind="six degrees of freedom",
        span_share=float((t_us[image[-1]] - t_us[image[0]]) / (t_us[-1] - t_us[0])),
        keyframes=len(image),
        tracks=len(track),
        distant_share=float(1 - near.mean()),
        inlier_share=float((residual < INLIER_PX).mean()),
        reprojection_px=float(np.sqrt(np.mean(residual[residual < INLIER_PX] ** 2))),
        parallax_px=parallax_px,
        disagreement=found.apart,
        view_share=view_covered,
    )
    trajectory = _trajectory(t_us[image], bundle.centre[image] / unit, quat_xyzw)
    return Estimate(trajectory, points / unit, found.position_std / unit, found.rotation_std_rad, quality)


def _baselines(
    bundle: Bundle, tracks: Tracks, good: Int64[np.ndarray, "observations"]
) -> Float64[np.ndarray, "tracks"]:
    """Return the extent of the cameras that observed each point, from these observations."""
    lower, upper = np.full((len(bundle.point), 3), np.inf), np.full((len(bundle.point), 3), -np.inf)
    np.minimum.at(lower, tracks.track[good], bundle.centre[tracks.image[good]])
    np.maximum.at(upper, tracks.track[good], bundle.centre[tracks.image[good]])
    return np.linalg.norm(np.maximum(upper - lower, 0), axis=1)


def _rotation_estimate(
    tracks: Tracks, t_us: Int64[np.ndarray, "keyframes"], rotation: Turned, focal_px: float, view_covered: float
) -> Estimate:
    """Return the estimate of a camera that only rotates; its residuals count as rotation uncertainty."""
    stray_px = focal_px * rotation.stray_rad
    good = stray_px < INLIER_PX
    quality = Quality(
        kind="rotation only",
        span_share=1.0,
        keyframes=len(t_us),
        tracks=int(good.sum()),
        distant_share=1.0,
        inlier_share=float(good[np.searchsorted(rotation.track, tracks.track)].mean()),
        reprojection_px=float(np.sqrt(np.mean(stray_px[good] ** 2))),
        parallax_px=float(np.median(stray_px)),
        disagreement=None,
        view_share=view_covered,
    )
    quat_xyzw = Rotation.from_matrix(rotation.rotation.transpose(0, 2, 1)).as_quat()
    std_rad = np.full(len(t_us), quality.parallax_px / focal_px)
    zeros = np.zeros((len(t_us), 3))
    return Estimate(_trajectory(t_us, zeros, quat_xyzw), zeros[:0], np.full(len(t_us), np.nan), std_rad, quality)


def _trajectory(t_us: np.ndarray, position: np.ndarray, quat_xyzw: np.ndarray) -> Trajectory:
    quat_wxyz = torch.from_numpy(quat_xyzw[:, [3, 0, 1, 2]].copy())
    return Trajectory(torch.from_numpy(t_us.copy()), Poses(torch.from_numpy(position.copy()), quat_wxyz))


def _tracks(
    file: RecordingFile, camera: Camera, settings: OdometrySettings, pace: Pace, hot: Bool[np.ndarray, "pixels"],
    threshold_ratio: float,
) -> tuple[Tracks, Int64[np.ndarray, "keyframes"]]:  # fmt: skip
    """Return tracks of three or more keyframes, and the keyframes' times, from the first event to the last."""
    speed_px_s = _USUAL_PX_S
    for _ in range(2):
        speed_px_s = _speed_px_s(file, pace, hot, threshold_ratio, settings.memory_px / speed_px_s) or speed_px_s
    length_s = float(pace.seconds[-1])
    time_constant_s = float(np.clip(settings.memory_px / speed_px_s, *_TIME_CONSTANT_S))
    keyframe_s = float(np.clip(settings.keyframe_px / speed_px_s, *_KEYFRAME_S))
    keyframes = max(round(length_s / keyframe_s), _FEWEST_KEYFRAMES)
    t_us = np.unique(pace.when_us(np.linspace(0, length_s, _IMAGES_PER_KEYFRAME * keyframes + 1)))
    images = event_images(file, pace, t_us, time_constant_s, threshold_ratio, hot)
    tracks = followed(images, camera, _IMAGES_PER_KEYFRAME)
    return tracks.select(tracks.lengths()[tracks.track] >= _SHORTEST_TRACK), t_us[::_IMAGES_PER_KEYFRAME]


def _speed_px_s(
    file: RecordingFile, pace: Pace, hot: Bool[np.ndarray, "pixels"], threshold_ratio: float, time_constant_s: float
) -> float | None:
    """Return the median image speed over a few pairs of event images, or None if no feature is tracked."""
    length_s = float(pace.seconds[-1])
    interval_s = min(_PILOT_S, length_s / 20)
    time_constant_s = float(np.clip(time_constant_s, *_TIME_CONSTANT_S))
    speeds = []
    for time_s in length_s * (np.arange(_PILOTS) + 0.5) / _PILOTS:
        t_us = np.unique(pace.when_us(np.array([max(time_s - 3 * time_constant_s, 0), time_s, time_s + interval_s])))
        *_, one, two = event_images(file, pace, t_us, time_constant_s, threshold_ratio, hot)
        moved_px = displacements_px(one, two)
        if len(moved_px):
            speeds.append(float(np.median(moved_px)) / interval_s)
    return max(float(np.median(speeds)), 1.0) if speeds else None
