"""Output of an estimate: the trajectory, the points, the quality figures, and the completed scene."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from ebarf_ns.events.recording import RecordingFile
from ebarf_ns.events.sensor_facts import identify_recording
from ebarf_ns.files import whole_file
from ebarf_ns.geometry.trajectory_file import write_tum
from ebarf_ns.json_file import read_json, write_json
from ebarf_ns.odometry.estimate import Estimate, estimated
from ebarf_ns.odometry.settings import OdometrySettings
from ebarf_ns.scene import Scene, read_scene

_OUTSIDE, _MARGIN = 0.02, 0.1
"""Share of the points that are outside the bounds at each end of an axis, and margin around the others."""
_FEWEST_FOR_BOUNDS, _MOST_DISTANT, _DEEPEST = 50, 0.15, 8.0
"""Number of points below which, and share of distant tracks and ratio of distances above which, bounds are not
estimated."""


def complete_scene(folder: Path, say: Callable[[str], None]) -> None:
    """Write an estimated trajectory, and bounds around its points, to a scene folder without trajectory.txt.

    Raises :class:`~ebarf_ns.errors.OdometryError` if there is no reliable one; the folder is then left unchanged.
    """
    scene = read_scene(folder, trajectory_to_come=True)
    if scene.trajectory.is_file():
        return
    say(f"{scene.trajectory} does not exist, estimating it from the events")
    estimate = of_scene(scene, OdometrySettings())
    write_estimate(estimate, scene.trajectory, scene)
    for sentence in sentences(estimate, scene):
        say(sentence)


def of_scene(scene: Scene, settings: OdometrySettings, progress: Callable[[str], None] = lambda step: None) -> Estimate:
    """Estimate the trajectory of a scene, with the threshold ratio from the scene or else from its events."""
    file = RecordingFile(scene.events, scene.camera.width, scene.camera.height)
    threshold = scene.contrast_threshold
    if threshold is not None:
        ratio = threshold.on / threshold.off
    else:
        ratio = identify_recording(file, file.span()[1:], scene.refractory_us).threshold_ratio.value
    return estimated(file, scene.camera, settings, ratio, progress)


def write_estimate(estimate: Estimate, path: Path, completed: Scene | None = None) -> None:
    """Write the trajectory as TUM text, with points.ply and odometry.json beside it.

    A ``completed`` scene gets estimated bounds; its own were in another frame and unit.
    """
    quality = estimate.quality
    comments = [
        f"estimated from events alone: {quality.kind}, in an arbitrary unit",
        f"{quality.tracks} tracks, reprojection error {quality.reprojection_px:.2f} px, "
        f"{quality.span_share:.1%} of the recording's time",
    ]
    facts = {
        **asdict(quality),
        "t_us": estimate.trajectory.t_us.tolist(),
        "position_std": [None if np.isnan(value) else value for value in estimate.position_std.tolist()],
        "rotation_std_rad": estimate.rotation_std_rad.tolist(),
    }
    if len(estimate.points):
        with whole_file(path.with_name("points.ply")) as temporary:
            temporary.write_text(_ply(estimate.points), encoding="ascii")
    with whole_file(path.with_name("odometry.json")) as temporary:
        temporary.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    if completed is not None:
        # Writing the whole scene would lose the entries of missing frames.
        scene_json = completed.folder / "scene.json"
        write_json(scene_json, {**read_json(scene_json), "bounds": estimated_bounds(estimate)})
    write_tum(path, estimate.trajectory, comments)


def sentences(estimate: Estimate, completed: Scene | None = None) -> list[str]:
    """Return the verdict and the quality of an estimate as lines for the terminal.

    ``completed`` is the scene as it was before the estimate.
    """
    quality, t_us = estimate.quality, estimate.trajectory.t_us
    span = f"{int(t_us[0]) * 1e-6:.3f} to {int(t_us[-1]) * 1e-6:.3f} s, {quality.span_share:.1%} of the recording"
    first = {
        "six degrees of freedom": "verdict: positions and rotations, in an arbitrary unit",
        "rotation only": "verdict: rotation only (no parallax); all positions are zero",
    }[quality.kind]
    found = [
        first,
        f"{quality.keyframes} keyframes from {span}",
        f"{quality.tracks} tracks over {quality.view_share:.0%} of the view, {quality.inlier_share:.0%} of their "
        f"observations are inliers, reprojection error {quality.reprojection_px:.2f} px",
    ]
    if completed is not None and completed.bounds is not None:
        found.append("bounds replaced: those of scene.json were not in the frame and unit of the estimate")
    rotation_deg = np.degrees(estimate.rotation_std_rad)
    rotations = f"{np.median(rotation_deg):.2f} (at most {rotation_deg.max():.2f}) degrees"
    if quality.disagreement is not None:
        extent = np.ptp(estimate.trajectory.poses.position.numpy(), axis=0)
        share = estimate.position_std / max(float(np.linalg.norm(extent)), 1e-12)
        return [
            *found,
            f"keyframe uncertainty, from the two halves of the tracks: {np.median(share):.1%} (at most "
            f"{share.max():.1%}) of the path's extent, {rotations}",
        ]
    return [
        *found,
        f"keyframe uncertainty: {rotations}; rotation alone leaves {quality.parallax_px:.1f} px unexplained",
    ]


def estimated_bounds(estimate: Estimate) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    """Return the corners of a box around the cameras and nearly all points.

    None if the scene may extend further, or is so deep that contracted space shows what is near in more detail.
    """
    if len(estimate.points) < _FEWEST_FOR_BOUNDS or estimate.quality.distant_share > _MOST_DISTANT:
        return None
    cameras = estimate.trajectory.poses.position.numpy()
    some = cameras[:: max(1, len(cameras) // 50)]
    distance = np.linalg.norm(estimate.points[:, None] - some, axis=-1)
    if np.quantile(np.median(distance, axis=1), 1 - _OUTSIDE) > _DEEPEST * np.quantile(distance.min(axis=1), 0.1):
        return None
    lower, upper = np.quantile(estimate.points, [_OUTSIDE, 1 - _OUTSIDE], axis=0)
    lower, upper = np.minimum(lower, cameras.min(axis=0)), np.maximum(upper, cameras.max(axis=0))
    margin = _MARGIN * float((upper - lower).max())
    return tuple((lower - margin).tolist()), tuple((upper + margin).tolist())


def _ply(points: np.ndarray) -> str:
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    return header + "".join(f"{x:.6g} {y:.6g} {z:.6g}\n" for x, y, z in points.tolist())
