from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ebarf_ns.errors import SimulationError
from ebarf_ns.evaluation.frames import read_frame
from ebarf_ns.events.indexing import index_pairs
from ebarf_ns.events.recording import read_recording
from ebarf_ns.geometry.cameras import Camera
from ebarf_ns.geometry.so3 import quat_wxyz_to_matrix
from ebarf_ns.geometry.trajectory import interpolate
from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.scene import read_scene
from ebarf_ns.simulation.catalogue import CATALOGUE, SceneName
from ebarf_ns.simulation.room import Room
from ebarf_ns.simulation.sensor import SensorModel
from ebarf_ns.simulation.simulate import Simulation, simulate
from ebarf_ns.simulation.view import View
from tests.simulation.test_mesh import COLOURED_SQUARE


def test_scene_is_complete_and_its_images_are_not_blank(tiny_scene: Path):
    scene = read_scene(tiny_scene)
    recording = read_recording(scene.events, scene.camera.width, scene.camera.height)
    assert len(recording) > 5000 and 0.4 < (recording.polarity > 0).mean() < 0.6
    assert len(scene.frames) == 3 and scene.groundtruth is not None and scene.bounds is not None
    for frame in scene.frames:
        image = read_frame(frame)
        assert image.std() > 0.1 * image.mean() > 0


def test_events_agree_with_the_room_seen_from_the_true_poses(tiny_scene: Path):
    """Check events independently: radiance along the true rays at the event times."""
    scene = read_scene(tiny_scene)
    assert scene.groundtruth and scene.contrast_threshold
    recording = read_recording(scene.events, scene.camera.width, scene.camera.height)
    index = index_pairs(lambda: [recording], scene.camera.width, scene.camera.height)
    pairs = index.draw(np.full(2000, 3), np.random.default_rng(0))
    truth = read_tum(scene.groundtruth)
    # The rays of a pixel are the simulator's; their poses are computed independently.
    rays = View(Room(), CATALOGUE["handheld-room"](0).motion, scene.camera)
    corners = torch.from_numpy(rays.bearings[pairs.pixel])

    def log_radiance(t_us: np.ndarray) -> np.ndarray:
        poses = interpolate(truth.t_us, truth.poses, torch.from_numpy(t_us), "cubic")
        directions = (corners @ quat_wxyz_to_matrix(poses.quat_wxyz).mT).flatten(0, 1).numpy()
        radiance, _ = Room().cast(poses.position.repeat_interleave(corners.shape[1], dim=0).numpy(), directions)
        return np.log(radiance.reshape(corners.shape[:2]).mean(axis=1))

    change = log_radiance(pairs.t1_us) - log_radiance(pairs.t0_us)
    reported = pairs.polarity_sum * scene.contrast_threshold.on
    error = np.abs(change - reported) / scene.contrast_threshold.on
    # Tolerance for interpolating 200 poses per second and for edges that pass within a microsecond.
    assert np.median(error) < 0.05 and np.corrcoef(change, reported)[0, 1] > 0.95


def test_the_room_is_closed_and_solid():
    random = np.random.default_rng(0)
    direction = random.standard_normal((2000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = np.array([-1.0, 0.0, 0.4])
    radiance, distance = Room().cast(np.tile(origin, (2000, 1)), direction)
    assert (radiance > 0.01).all() and (radiance < 4).all() and np.isfinite(distance).all()
    hits = origin + distance[:, None] * direction
    assert (hits > np.array(Room().lower) - 1e-9).all() and (hits < np.array(Room().upper) + 1e-9).all()
    ball = np.array(Room().balls[0])
    towards = (ball[:3] - origin) / np.linalg.norm(ball[:3] - origin)
    assert Room().cast(origin[None], towards[None])[1][0] == pytest.approx(np.linalg.norm(ball[:3] - origin) - ball[3])


SMALL = Simulation(width=32, height=24, focal_px=27.0, duration_s=0.2, frames=2)


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_scene_of_the_catalogue_can_be_simulated(tmp_path: Path, name: SceneName):
    scene = simulate(replace(SMALL, scene=name, duration_s=0.4), tmp_path / "scene")
    read = read_scene(tmp_path / "scene")
    recording = read_recording(read.events, 32, 24)
    assert len(recording) > 150 and scene.bounds
    truth = read_tum(tmp_path / "scene" / "groundtruth.txt")
    lower, upper = np.array(scene.bounds)
    assert (truth.poses.position.numpy() > lower).all() and (truth.poses.position.numpy() < upper).all()


def test_a_scene_may_omit_its_thresholds(tmp_path: Path):
    told, untold = (simulate(replace(SMALL, tell_thresholds=told), tmp_path / f"told {told}") for told in (True, False))
    assert told.contrast_threshold and untold.contrast_threshold is None
    assert told.events.read_bytes() == untold.events.read_bytes()


def test_a_slide_is_a_line_and_an_orbit_looks_at_its_middle(tmp_path: Path):
    t_us = np.linspace(0, 2e6, 50)
    slide, orbit = CATALOGUE["slide"](3), CATALOGUE["orbit"](3)
    assert np.linalg.matrix_rank(np.diff(slide.motion.position(t_us), axis=0), tol=1e-9) == 1
    assert slide.motion.rotation(t_us).std(axis=0).max() < 1e-12
    towards = np.array(orbit.middle) - orbit.motion.position(t_us)
    forward = orbit.motion.rotation(t_us)[:, :, 2]
    angle = np.arccos((towards * forward).sum(1) / np.linalg.norm(towards, axis=1))
    assert angle.max() < 0.25 and np.ptp(orbit.motion.position(t_us), axis=0)[:2].min() > 0.3


def test_a_window_is_a_thousand_times_brighter_than_the_room():
    view = View(
        CATALOGUE["hdr-window"](0).room,
        CATALOGUE["hdr-window"](0).motion,
        Camera("pinhole", 32, 24, 27.0, 27.0, 15.5, 11.5),
    )
    radiance, _ = view.images(np.linspace(0, 2e6, 5))
    assert radiance.max() > 100 * np.median(radiance) and radiance.min() < 1


def test_a_mesh_replaces_only_boxes_and_balls(tmp_path: Path):
    (tmp_path / "square.ply").write_text(COLOURED_SQUARE)
    settings = replace(SMALL, scene="hdr-window", mesh=tmp_path / "square.ply", duration_s=2.0, frames=5)
    scene = simulate(settings, tmp_path / "scene")
    # Daylight saturates the frames.
    assert max(float(read_frame(frame).max()) for frame in scene.frames) == 1


def test_speed_plays_the_same_motion_faster(tmp_path: Path):
    simulate(replace(SMALL, speed=2.0, duration_s=0.1), tmp_path / "fast")
    simulate(SMALL, tmp_path / "usual")
    fast, usual = (read_tum(tmp_path / name / "groundtruth.txt") for name in ("fast", "usual"))
    assert torch.allclose(fast.poses.position[-1], usual.poses.position[-1])
    counts = [len(read_recording(tmp_path / name / "events.h5", 32, 24)) for name in ("fast", "usual")]
    assert counts[0] == pytest.approx(counts[1], rel=0.02)


def test_depth_is_written_beside_the_frames_and_blur_when_asked_for(tmp_path: Path):
    scene = simulate(replace(SMALL, exposure_ms=100.0), tmp_path / "scene")
    frame = read_scene(tmp_path / "scene").frames[0]
    assert frame.depth and np.load(frame.depth).shape == (24, 32) and np.load(frame.depth).min() > 0.5
    sharp = read_frame(frame)
    blurred = read_frame(replace(frame, path=tmp_path / "scene" / "frames_blurred" / frame.path.name))
    gradients = [np.abs(np.diff(image, axis=1)).mean() for image in (sharp, blurred)]
    assert gradients[1] < 0.9 * gradients[0] and blurred.mean() == pytest.approx(sharp.mean(), rel=0.1)
    assert scene.frames[0].camera == frame.camera


def test_a_lens_bends_what_it_shows(tmp_path: Path):
    scene = simulate(replace(SMALL, lens="radtan", distortion=(-0.3, 0.1, 0.0, 0.0)), tmp_path / "scene")
    assert read_scene(tmp_path / "scene").camera.distortion == (-0.3, 0.1, 0.0, 0.0)
    straight = simulate(SMALL, tmp_path / "straight")
    bent, plain = (np.load(one.frames[0].depth or "") for one in (scene, straight))
    assert not np.allclose(bent[0, 0], plain[0, 0])


@pytest.mark.parametrize(
    "wrong",
    [
        {"duration_s": 0.0},
        {"focal_px": -1.0},
        {"keyframe_rate_hz": float("nan")},
        {"exposure_ms": -1.0},
        {"seed": -1},
        {"lens": "radtan"},
        {"sensor": SensorModel(threshold_on=0.0)},
        {"sensor": SensorModel(refractory_us=-5.0)},
        {"sensor": SensorModel(threshold_drift=3.0)},
        {"mesh": Path("nothing.obj")},
    ],
)
def test_impossible_settings_are_named_and_leave_nothing(tmp_path: Path, wrong: dict):
    ((name, value),) = wrong.items()
    changed = (
        next((key for key, now in vars(value).items() if now != getattr(SensorModel(), key)), "")
        if name == "sensor"
        else name
    )
    with pytest.raises(SimulationError, match={"lens": "distortion", "mesh": "nothing.obj"}.get(changed, changed)):
        simulate(replace(SMALL, **wrong), tmp_path / "scene")
    assert not list(tmp_path.iterdir())
