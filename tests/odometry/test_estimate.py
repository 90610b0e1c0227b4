"""From recordings to trajectories, and to one line where there is none; by the command that users type."""

import json
from pathlib import Path

import numpy as np
import pytest

from ebarf_ns.errors import OdometryError
from ebarf_ns.evaluation.trajectory_error import rotation_error_deg, trajectory_error
from ebarf_ns.events.recording import Recording
from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.odometry.estimate import estimated
from ebarf_ns.odometry.settings import OdometrySettings
from ebarf_ns.scene import read_scene
from tests.conftest import DATA, run_command, run_ok
from tests.odometry.worlds import CAMERA, moving_squares, noise, recorded


@pytest.mark.parametrize(
    ("recording", "why"),
    [
        (noise(150_000, 1_000_000), "no motion|too few features|no reliable trajectory"),
        (noise(5_000, 20_000), "20.0 ms, too short for parallax"),
        (noise(200, 1_000_000), "too few features|no motion"),
        (moving_squares([(40, 60, 60, 0, 18)]), "cover only"),
        (moving_squares([(30, 30, 60, 10, 18), (130, 90, -60, 0, 18)]), "cover only|no reliable trajectory"),
        (
            moving_squares([(30, 30, 60, 0, 22), (130, 90, -60, 0, 22), (120, 25, -10, 50, 20), (40, 95, 20, -50, 20)]),
            "cover only|no reliable trajectory",
        ),
    ],
    ids=["noise", "20 ms", "few events", "one object", "two objects", "four objects"],
)
def test_hopeless_recordings_are_refused(recording: Recording, why: str, tmp_path: Path):
    with pytest.raises(OdometryError, match=why):
        estimated(recorded(tmp_path / "events.h5", recording), CAMERA, OdometrySettings())


def test_the_command_says_in_one_line_why_there_is_none_and_writes_nothing(tmp_path: Path):
    recorded(tmp_path / "events.h5", noise(150_000, 1_000_000))
    calibration, scene = tmp_path / "calib.txt", tmp_path / "scene"
    calibration.write_text("140 140 79.5 59.5 0 0 0 0 0\n")
    made = ("--camera", calibration, "--sensor-size", 160, 120, "--output", scene)
    said = run_command("ebarf", "process", "auto", tmp_path / "events.h5", *made)
    assert said.code == 0 and "ebarf trajectory estimate" in said.errors
    before = sorted(path.name for path in scene.iterdir())
    assert "trajectory.txt" not in before
    told = run_command("ebarf", "inspect", scene)
    assert told.code == 0 and f"ebarf trajectory estimate {scene}" in told.output
    finished = run_command("ebarf", "trajectory", "estimate", scene)
    assert finished.code == 2
    assert len(finished.errors.strip().splitlines()) == 1 and "events.h5" in finished.errors
    assert sorted(path.name for path in scene.iterdir()) == before


def test_files_that_are_there_are_not_replaced(tiny_scene: Path):
    finished = run_command("ebarf", "trajectory", "estimate", tiny_scene)
    assert finished.code == 2 and "trajectory.txt: exists, expected --output" in finished.errors


@pytest.mark.slow
def test_a_recording_of_photographs_becomes_a_scene(tmp_path: Path):
    source = DATA / "photos_dim"
    if not source.is_dir():
        pytest.skip(f"no recordings at {DATA}; set EBARF_TEST_DATA to their folder")
    output = tmp_path / "found" / "trajectory.txt"
    run_ok("ebarf", "trajectory", "estimate", source, "--output", output)
    estimate, true = read_tum(output), read_tum(source / "groundtruth.txt")
    facts = json.loads((output.parent / "odometry.json").read_text())
    extent = np.linalg.norm(np.ptp(true.poses.position.numpy(), axis=0))
    assert facts["kind"] == "six degrees of freedom" and facts["span_share"] > 0.95
    error = trajectory_error(estimate, true, "sim3")
    assert error.ate_m < 0.04 * extent and error.rotation_deg < 2
    # What it says of its own error is of the size of the error.
    claimed = np.sqrt(np.mean(np.square(facts["position_std"]))) * error.scale
    assert error.ate_m / 4 < claimed < error.ate_m * 4
    assert (output.parent / "points.ply").read_text().startswith("ply\n")


@pytest.mark.slow
def test_a_slide_and_a_turn_are_told_apart(slider_depth: Path, tmp_path: Path):
    run_ok("ebarf", "process", "ecd", slider_depth, "--output", tmp_path / "slider")
    run_ok("ebarf", "trajectory", "estimate", tmp_path / "slider", "--output", tmp_path / "s" / "trajectory.txt")
    estimate = read_tum(tmp_path / "s" / "trajectory.txt")
    path = estimate.poses.position[-1] - estimate.poses.position[0]
    first = estimate.poses.matrix()[0, :, :3].T @ path
    assert first[0] / first.norm() > np.cos(np.radians(10))
    pan_tilt = DATA / "office_pan_tilt"
    run_ok("ebarf", "trajectory", "estimate", pan_tilt, "--output", tmp_path / "p" / "trajectory.txt")
    facts = json.loads((tmp_path / "p" / "odometry.json").read_text())
    turned = read_tum(tmp_path / "p" / "trajectory.txt")
    assert facts["kind"] == "rotation only" and not turned.poses.position.any()
    assert rotation_error_deg(turned, read_tum(read_scene(pan_tilt).groundtruth)) < 0.5  # pyright: ignore
