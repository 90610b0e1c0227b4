"""From a recording and its camera to an initial trajectory, or to the reason why there is none.

Event images, tracks through them, a map of all tracks, and two more of either half of them, which know nothing of each
other: where these disagree, no reprojection error makes up for it.
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

_SHORTEST_US, _FEWEST_KEYFRAMES, _IMAGES_A_KEYFRAME = 50_000, 12, 4
_PILOTS, _PILOT_S, _USUAL_PX_S = 8, 0.01, 150.0
_MEMORY_S, _KEYFRAME_S = (0.005, 0.3), (0.004, 0.1)
"""Shortest and longest time constant of event images, and time between keyframes."""
_SHORTEST_TRACK, _FEWEST_TRACKS = 3, 20
_LEAST_VIEW, _FEWEST_MAPPED, _LEAST_SPAN = 0.45, 100, 0.5
_STILL_PX, _NO_PARALLAX_PX, _LITTLE_PARALLAX_PX = 4.0, 0.8, 1.5
_LEAST_INLIERS = 0.6
_LEAST_GAIN, _FAR = 1.5, 0.05
"""By how much a map must explain tracks better than a rotation does; and inverse depth over the usual one below which
a point is as good as infinitely far."""
_TRY_PARALLAX = "move the camera sideways by a tenth of the distance of what it sees, or give a trajectory"


@dataclass(frozen=True)
class Estimate:
    """An initial trajectory that the method vouches for."""

    trajectory: Trajectory
    """In units of the usual distance of what is seen."""
    points: Float64[np.ndarray, "points 3"]
    """None of a rotation alone."""
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
            f"{file.path}: {count:,} events over {(last_us - first_us) / 1000:.1f} ms, too short a time for parallax; "
            f"expected {_SHORTEST_US // 1000} ms or more"
        )
    progress("counting events")
    pace, hot = paced(file)
    progress("following features")
    tracks, t_us = _tracks(file, camera, settings, pace, hot, threshold_ratio)
    by_keyframe = np.bincount(tracks.image, minlength=len(t_us))
    if np.median(by_keyframe) < _FEWEST_TRACKS:
        raise OdometryError(
            f"{file.path}: too few features, {np.median(by_keyframe):.0f} in most keyframes are followed through "
            f"{_SHORTEST_TRACK}, expected {_FEWEST_TRACKS} or more; a scene with more texture, or less noise"
        )
    focal_px = float(np.sqrt(camera.fx * camera.fy))
    seen = view_share(tracks, camera)
    if seen < _LEAST_VIEW:
        raise OdometryError(
            f"{file.path}: features in {seen:.0%} of the view alone, expected {_LEAST_VIEW:.0%} or more; "
            "what moves may be an object rather than the camera"
        )
    progress("mapping")
    rotation = turned(tracks)
    if rotation is None:
        raise OdometryError(
            f"{file.path}: too few features, two keyframes one after the other share hardly any; a scene with more "
            "texture, or a slower motion"
        )
    return _judged(file, tracks, t_us, rotation, focal_px, seen, progress)


def _judged(
    file: RecordingFile, tracks: Tracks, t_us: Int64[np.ndarray, "keyframes"], rotation: Turned, focal_px: float,
    seen: float, progress: Callable[[str], None],
) -> Estimate:  # fmt: skip
    """The estimate that stands every test, a rotation where that explains the tracks; or the reason for none."""
    parallax_px = focal_px * float(np.median(rotation.stray_rad))
    turn_px = focal_px * float(Rotation.from_matrix(rotation.rotation @ rotation.rotation[0].T).magnitude().max())
    if parallax_px < _LITTLE_PARALLAX_PX and turn_px < _STILL_PX:
        raise OdometryError(
            f"{file.path}: no motion, features stay within {max(parallax_px, turn_px):.1f} px; expected a camera that "
            "moves"
        )
    if parallax_px < _NO_PARALLAX_PX:
        return _of_rotation(tracks, t_us, rotation, focal_px, seen)
    whole = mapped(tracks, focal_px, rotation)
    found, gain, why = None, np.inf, f"no two keyframes begin a map; {_TRY_PARALLAX}"
    if whole is not None:
        kept = explained(whole, tracks)
        inside = kept[tracks.image]
        inliers = float((whole.residuals_px() < INLIER_PX)[inside].mean()) if inside.any() else 0.0
        why = (
            f"one camera's motion explains {inliers:.0%} of the features' in {kept.sum()} of {len(t_us)} keyframes; "
            "objects that move by themselves, or too little texture?"
        )
        gain = parallax_px / max(_by_track_px(whole), 1e-9)
        if gain < _LEAST_GAIN:
            why = f"no parallax, a rotation leaves {parallax_px:.1f} px unexplained; {_TRY_PARALLAX}"
        elif inliers >= _LEAST_INLIERS:
            progress("checking")
            halves = [mapped(halved(tracks, which), focal_px, rotation) for which in (0, 1)]
            why = f"either half of the features tells another motion; {_TRY_PARALLAX}"
            if halves[0] is not None and halves[1] is not None:
                found = agreement(whole, halves[0], halves[1], kept)
    if whole is not None and found is not None:
        estimate = _of_map(whole, found, t_us, focal_px, parallax_px, seen)
        if estimate.quality.tracks >= _FEWEST_MAPPED and estimate.quality.span_share >= _LEAST_SPAN:
            return estimate
        why = (
            f"{estimate.quality.tracks} features over {estimate.quality.span_share:.0%} of the time tell of one "
            f"motion, expected {_FEWEST_MAPPED} over {_LEAST_SPAN:.0%}; objects that move by themselves, or too little "
            "texture?"
        )
    if parallax_px < _LITTLE_PARALLAX_PX:
        return _of_rotation(tracks, t_us, rotation, focal_px, seen)
    raise OdometryError(f"{file.path}: no trajectory to vouch for: {why}")


def _by_track_px(whole: Map) -> float:
    """Median by track of the root mean square residual."""
    residual = whole.residuals_px()
    known = np.isfinite(residual)
    track = whole.tracks.track[known]
    count = np.bincount(track)
    return float(np.median(np.sqrt(np.bincount(track, residual[known] ** 2)[count > 0] / count[count > 0])))


def _of_map(
    whole: Map, found: Agreement, t_us: Int64[np.ndarray, "keyframes"], focal_px: float, parallax_px: float, seen: float
) -> Estimate:
    bundle, image = whole.bundle, found.image
    residual = whole.residuals_px()[np.isin(whole.tracks.image, image)]
    good = np.nonzero((whole.residuals_px() < INLIER_PX) & np.isin(whole.tracks.image, image))[0]
    number = np.unique(whole.tracks.track[good])
    # The others are anywhere: nothing tells how far.
    number = number[bundle.point[number, 2] > _FAR * float(np.median(bundle.point[number, 2]))]
    points = bundle.positions()[number]
    usual = float(np.median(np.linalg.norm(points - np.median(bundle.centre[image], axis=0), axis=1)))
    quat_xyzw = Rotation.from_matrix(bundle.rotation[image].transpose(0, 2, 1)).as_quat()
    quality = Quality(
        kind="six degrees of freedom",
        span_share=float((t_us[image[-1]] - t_us[image[0]]) / (t_us[-1] - t_us[0])),
        keyframes=len(image),
        tracks=len(np.unique(whole.tracks.track[good])),
        inlier_share=float((residual < INLIER_PX).mean()),
        reprojection_px=float(np.sqrt(np.mean(residual[residual < INLIER_PX] ** 2))),
        parallax_px=parallax_px,
        disagreement=found.apart,
        view_share=seen,
    )
    trajectory = _trajectory(t_us[image], bundle.centre[image] / usual, quat_xyzw)
    return Estimate(trajectory, points / usual, found.position_std / usual, found.rotation_std_rad, quality)


def _of_rotation(
    tracks: Tracks, t_us: Int64[np.ndarray, "keyframes"], rotation: Turned, focal_px: float, seen: float
) -> Estimate:
    """A camera that turns where it is; what its tracks leave unexplained may be turns or shifts."""
    stray_px = focal_px * rotation.stray_rad
    good = stray_px < INLIER_PX
    quality = Quality(
        kind="rotation only",
        span_share=1.0,
        keyframes=len(t_us),
        tracks=int(good.sum()),
        inlier_share=float(good[np.searchsorted(rotation.track, tracks.track)].mean()),
        reprojection_px=float(np.sqrt(np.mean(stray_px[good] ** 2))),
        parallax_px=float(np.median(stray_px)),
        disagreement=None,
        view_share=seen,
    )
    quat_xyzw = Rotation.from_matrix(rotation.rotation.transpose(0, 2, 1)).as_quat()
    std_rad = np.full(len(t_us), quality.parallax_px / focal_px)
    nothing = np.zeros((len(t_us), 3))
    return Estimate(_trajectory(t_us, nothing, quat_xyzw), nothing[:0], np.full(len(t_us), np.nan), std_rad, quality)


def _trajectory(t_us: np.ndarray, position: np.ndarray, quat_xyzw: np.ndarray) -> Trajectory:
    quat_wxyz = torch.from_numpy(quat_xyzw[:, [3, 0, 1, 2]].copy())
    return Trajectory(torch.from_numpy(t_us.copy()), Poses(torch.from_numpy(position.copy()), quat_wxyz))


def _tracks(
    file: RecordingFile, camera: Camera, settings: OdometrySettings, pace: Pace, hot: Bool[np.ndarray, "pixels"],
    threshold_ratio: float,
) -> tuple[Tracks, Int64[np.ndarray, "keyframes"]]:  # fmt: skip
    """Tracks of three keyframes or more, and the keyframes' times, from the first event to the last."""
    speed_px_s = _USUAL_PX_S
    for _ in range(2):
        speed_px_s = _speed_px_s(file, pace, hot, threshold_ratio, settings.memory_px / speed_px_s) or speed_px_s
    length_s = float(pace.seconds[-1])
    memory_s = float(np.clip(settings.memory_px / speed_px_s, *_MEMORY_S))
    keyframe_s = float(np.clip(settings.keyframe_px / speed_px_s, *_KEYFRAME_S))
    keyframes = max(round(length_s / keyframe_s), _FEWEST_KEYFRAMES)
    t_us = np.unique(pace.when_us(np.linspace(0, length_s, _IMAGES_A_KEYFRAME * keyframes + 1)))
    images = event_images(file, pace, t_us, memory_s, threshold_ratio, hot)
    tracks = followed(images, camera, _IMAGES_A_KEYFRAME)
    return tracks.select(tracks.lengths()[tracks.track] >= _SHORTEST_TRACK), t_us[::_IMAGES_A_KEYFRAME]


def _speed_px_s(
    file: RecordingFile, pace: Pace, hot: Bool[np.ndarray, "pixels"], threshold_ratio: float, memory_s: float
) -> float | None:
    """How fast things usually move across the picture, by a few pairs of pictures; None where nothing is found."""
    length_s = float(pace.seconds[-1])
    apart_s = min(_PILOT_S, length_s / 20)
    memory_s = float(np.clip(memory_s, *_MEMORY_S))
    speeds = []
    for moment_s in length_s * (np.arange(_PILOTS) + 0.5) / _PILOTS:
        t_us = np.unique(pace.when_us(np.array([max(moment_s - 3 * memory_s, 0), moment_s, moment_s + apart_s])))
        *_, one, two = event_images(file, pace, t_us, memory_s, threshold_ratio, hot)
        moved_px = displacements_px(one, two)
        if len(moved_px):
            speeds.append(float(np.median(moved_px)) / apart_s)
    return max(float(np.median(speeds)), 1.0) if speeds else None
