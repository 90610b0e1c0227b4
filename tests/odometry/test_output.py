"""A scene that is completed by an estimate: its trajectory, points and bounds."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.odometry.estimate import Estimate
from ebarf_ns.odometry.output import sentences, write_estimate
from ebarf_ns.odometry.verdict import Quality
from ebarf_ns.scene import Scene, read_scene

QUALITY = Quality(
    kind="six degrees of freedom", span_share=1.0, keyframes=9, tracks=300, distant_share=0.05, inlier_share=0.9,
    reprojection_px=0.7, parallax_px=3.0, disagreement=0.02, view_share=0.9,
)  # fmt: skip


def without_trajectory(tiny_scene: Path, folder: Path) -> Scene:
    shutil.copytree(tiny_scene, folder)
    (folder / "trajectory.txt").unlink()
    return read_scene(folder, trajectory_to_come=True)


def estimate_of(tiny_scene: Path, points: np.ndarray, quality: Quality = QUALITY) -> Estimate:
    trajectory = read_tum(tiny_scene / "trajectory.txt")
    std = np.full(len(trajectory.t_us), 0.01)
    return Estimate(trajectory, points, std, std, quality)


def test_bounds_hold_the_scene_and_not_the_outliers_of_its_points(tiny_scene: Path, tmp_path: Path):
    scene = without_trajectory(tiny_scene, tmp_path / "scene")
    rng = np.random.default_rng(0)
    room, wrong = rng.uniform(-1, 1, (490, 3)), rng.uniform(-1, 1, (10, 3)) * 30
    estimate = estimate_of(tiny_scene, np.concatenate([room, wrong]))
    assert scene.bounds is not None
    assert any("bounds replaced" in line for line in sentences(estimate, scene))
    write_estimate(estimate, scene.trajectory, scene)
    bounds = read_scene(scene.folder).bounds
    assert bounds is not None
    cameras = estimate.trajectory.poses.position.numpy()
    lower, upper = np.array(bounds)
    assert ((room > lower) & (room < upper)).all() and ((cameras > lower) & (cameras < upper)).all()
    assert (upper - lower).max() < 2 * max(2, np.ptp(cameras, axis=0).max())


def test_a_scene_that_may_extend_further_has_no_bounds(tiny_scene: Path, tmp_path: Path):
    scene = without_trajectory(tiny_scene, tmp_path / "scene")
    points = np.random.default_rng(0).uniform(-1, 1, (400, 3))
    write_estimate(estimate_of(tiny_scene, points, replace(QUALITY, distant_share=0.3)), scene.trajectory, scene)
    assert read_scene(scene.folder).bounds is None


def test_a_deep_scene_has_no_bounds(tiny_scene: Path, tmp_path: Path):
    scene = without_trajectory(tiny_scene, tmp_path / "scene")
    rng = np.random.default_rng(0)
    table, wall = rng.uniform(-1, 1, (300, 3)), rng.uniform(-8, 8, (100, 3)) + [0, 30, 0]
    write_estimate(estimate_of(tiny_scene, np.concatenate([table, wall])), scene.trajectory, scene)
    assert read_scene(scene.folder).bounds is None


def test_bounds_of_another_frame_do_not_stay(tiny_scene: Path, tmp_path: Path):
    scene = without_trajectory(tiny_scene, tmp_path / "scene")
    estimate = estimate_of(tiny_scene, np.zeros((0, 3)), replace(QUALITY, kind="rotation only", disagreement=None))
    write_estimate(estimate, scene.trajectory, scene)
    assert read_scene(scene.folder).bounds is None
    assert not any("bounds" in line for line in sentences(estimate, replace(scene, bounds=None)))


def test_entries_of_missing_frames_stay(tiny_scene: Path, tmp_path: Path):
    scene = without_trajectory(tiny_scene, tmp_path / "scene")
    listed = (scene.folder / "frames.json").read_bytes()
    scene.frames[0].path.unlink()
    scene = read_scene(scene.folder, trajectory_to_come=True)
    assert scene.missing
    write_estimate(estimate_of(tiny_scene, np.random.default_rng(0).uniform(-1, 1, (400, 3))), scene.trajectory, scene)
    assert (scene.folder / "frames.json").read_bytes() == listed
