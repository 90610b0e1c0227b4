from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ebarf_ns.errors import SimulationError
from ebarf_ns.evaluation.frames import read_frame
from ebarf_ns.evaluation.trajectory_error import trajectory_error
from ebarf_ns.events.pairs import index_pairs
from ebarf_ns.events.recording import read_recording
from ebarf_ns.geometry.so3 import quat_wxyz_to_matrix
from ebarf_ns.geometry.trajectory import interpolate
from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.scene import read_scene
from ebarf_ns.simulation.motion import HandheldMotion, perturb, sample_trajectory
from ebarf_ns.simulation.room import Room
from ebarf_ns.simulation.simulate import Simulation, simulate


def test_scene_is_whole_and_its_pictures_show_something(tiny_scene: Path):
    scene = read_scene(tiny_scene)
    recording = read_recording(scene.events, scene.camera.width, scene.camera.height)
    assert len(recording) > 5000 and 0.4 < (recording.polarity > 0).mean() < 0.6
    assert len(scene.frames) == 3 and scene.groundtruth is not None and scene.bounds is not None
    for frame in scene.frames:
        image = read_frame(frame)
        assert image.std() > 0.1 * image.mean() > 0


def test_events_agree_with_the_room_seen_from_the_true_poses(tiny_scene: Path):
    """The simulator against itself by another way: radiance along the true rays at the events' times."""
    scene = read_scene(tiny_scene)
    assert scene.groundtruth and scene.contrast_threshold
    recording = read_recording(scene.events, scene.camera.width, scene.camera.height)
    index = index_pairs(lambda: [recording], scene.camera.width, scene.camera.height)
    pairs = index.draw(np.full(2000, 3), np.random.default_rng(0))
    truth = read_tum(scene.groundtruth)
    corners = scene.camera.pixel_grid().flatten(0, 1)[pairs.pixel][:, None] + torch.tensor(
        [[-0.25, -0.25], [-0.25, 0.25], [0.25, -0.25], [0.25, 0.25]]
    )
    bearings = scene.camera.bearings(corners)

    def log_radiance(t_us: np.ndarray) -> np.ndarray:
        poses = interpolate(truth.t_us, truth.poses, torch.from_numpy(t_us), "cubic")
        directions = bearings @ quat_wxyz_to_matrix(poses.quat_wxyz).mT
        rays = zip(poses.position.numpy(), directions.numpy(), strict=True)
        return np.log([Room().cast(origin, four)[0].mean() for origin, four in rays])

    change = log_radiance(pairs.t1_us) - log_radiance(pairs.t0_us)
    reported = pairs.polarity_sum * scene.contrast_threshold.on
    error = np.abs(change - reported) / scene.contrast_threshold.on
    # At edges, a subpixel ray jumps between two renders, and the event falls anywhere between them.
    assert np.median(error) < 0.15 and np.corrcoef(change, reported)[0, 1] > 0.95


def test_initial_trajectory_has_the_noise_that_was_asked_for():
    motion = HandheldMotion()
    true = sample_trajectory(motion, np.arange(0, 10_000_000, 20_000))
    noisy = perturb(true, 0.03, 0.02, seed=1)
    error = trajectory_error(noisy, true, "se3")
    assert error.ate_m == pytest.approx(0.03 * np.sqrt(3), rel=0.1)
    assert error.rotation_deg == pytest.approx(np.degrees(0.02 * np.sqrt(3)), rel=0.1)
    assert torch.equal(perturb(true, 0.03, 0.02, seed=1).poses.position, noisy.poses.position)


def test_the_room_is_closed_and_solid():
    random = np.random.default_rng(0)
    direction = random.standard_normal((2000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = np.array([-1.0, 0.0, 0.4])
    radiance, distance = Room().cast(origin, direction)
    assert (radiance > 0.01).all() and (radiance < 4).all() and np.isfinite(distance).all()
    hits = origin + distance[:, None] * direction
    assert (hits > np.array(Room().lower) - 1e-9).all() and (hits < np.array(Room().upper) + 1e-9).all()
    ball = np.array(Room().balls[0])
    towards = (ball[:3] - origin) / np.linalg.norm(ball[:3] - origin)
    assert Room().cast(origin, towards[None])[1][0] == pytest.approx(np.linalg.norm(ball[:3] - origin) - ball[3])


@pytest.mark.parametrize("setting", ["duration_s", "threshold_on", "focal_px", "keyframe_rate_hz"])
def test_impossible_settings_are_named_and_leave_nothing(tmp_path: Path, setting: str):
    with pytest.raises(SimulationError, match=setting):
        simulate(replace(Simulation(), **{setting: 0.0}), tmp_path / "scene")
    assert not list(tmp_path.iterdir())
