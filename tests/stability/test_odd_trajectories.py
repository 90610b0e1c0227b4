"""Trajectories that are next to useless: training ends with finite numbers, and says what it made of them."""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ebarf_ns.geometry.trajectory_file import read_tum
from tests.nerf.test_training import config, trainer

Rows = np.ndarray
"""timestamp tx ty tz qx qy qz qw, one keyframe a row."""


def turned(rows: Rows, degrees: np.ndarray) -> Rows:
    """Each keyframe turned about an axis of its own."""
    axis = np.array([0.0, 1.0, 0.0])
    rotation = Rotation.from_rotvec(np.radians(degrees)[:, None] * axis) * Rotation.from_quat(rows[:, 4:])
    return np.concatenate([rows[:, :4], rotation.as_quat()], axis=1)


def two(rows: Rows) -> Rows:
    return rows[[0, -1]]


def all_alike(rows: Rows) -> Rows:
    return np.concatenate([rows[:, :1], rows[:1, 1:].repeat(len(rows), axis=0)], axis=1)


def drift_of_20_degrees(rows: Rows) -> Rows:
    return turned(rows, 20 * np.sin(np.linspace(0, 5, len(rows))))


def an_error_in_one_stretch(rows: Rows) -> Rows:
    return turned(rows, np.where(np.arange(len(rows)) % 10 < 3, 8.0, 0.0))


def a_clock_off_by_half_the_recording(rows: Rows) -> Rows:
    return np.concatenate([rows[:, :1] + 0.25, rows[:, 1:]], axis=1)


def uneven(rows: Rows) -> Rows:
    return rows[[0, 1, 2, -2, -1]]


def sparse(rows: Rows) -> Rows:
    return rows[::3]


def thousands(rows: Rows) -> Rows:
    t = np.linspace(rows[0, 0], rows[-1, 0], 3000)
    position = np.stack([np.interp(t, rows[:, 0], rows[:, k]) for k in (1, 2, 3)], axis=1)
    return np.concatenate([t[:, None], position, rows[:1, 4:].repeat(3000, axis=0)], axis=1)


def changed(scene: Path, into: Path, change: Callable[[Rows], Rows]) -> Path:
    shutil.copytree(scene, into)
    rows = change(np.loadtxt(scene / "trajectory.txt"))
    np.savetxt(into / "trajectory.txt", rows, fmt="%.9f")
    return into


@pytest.mark.parametrize(
    "change",
    [
        sparse,
        *(
            pytest.param(one, marks=pytest.mark.slow)
            for one in (
                two,
                all_alike,
                drift_of_20_degrees,
                an_error_in_one_stretch,
                a_clock_off_by_half_the_recording,
                uneven,
                thousands,
            )
        ),
    ],
)
def test_training_ends_with_finite_numbers(tiny_scene: Path, tmp_path: Path, change: Callable[[Rows], Rows]):
    scene = changed(tiny_scene, tmp_path / "scene", change)
    chosen = config(scene, tmp_path / "run", steps=30)
    chosen.pipeline.model.camera_optimizer.align_steps = 10  # pyright: ignore[reportAttributeAccessIssue]
    ready = trainer(chosen)
    ready.train()
    assert ready.alignment and math.isfinite(ready.alignment.moved_px)
    refined = read_tum(ready.base_dir / "trajectory_refined.txt")
    assert bool(refined.poses.position.isfinite().all()) and bool(refined.poses.quat_wxyz.isfinite().all())
    initial, given = read_tum(ready.base_dir / "trajectory_initial.txt"), read_tum(scene / "trajectory.txt")
    assert torch.equal(initial.t_us, given.t_us)
    assert torch.allclose(initial.poses.position, given.poses.position, atol=1e-5)
    last = json.loads((ready.base_dir / "metrics.jsonl").read_text().splitlines()[-1])
    assert last["support"]["verdict"] in ("better", "alike", "worse")
    inserted = len(refined.t_us) - len(given.t_us)
    assert last["keyframes_inserted"] == inserted and (inserted > 0 or change is not sparse)
    first_line = (ready.base_dir / "trajectory_refined.txt").read_text().splitlines()[0]
    assert (first_line == f"# inserted keyframes: {inserted}") == (inserted > 0)
    assert last["heldout_event_loss"] is None or 0 <= last["heldout_event_loss"] <= 1


def test_a_clock_off_by_more_than_the_recording_is_an_error_in_one_line(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture
):
    scene = changed(
        tiny_scene, tmp_path / "scene", lambda rows: np.concatenate([rows[:, :1] + 30, rows[:, 1:]], axis=1)
    )
    with pytest.raises(SystemExit) as stopped:
        trainer(config(scene, tmp_path / "run"))
    assert stopped.value.code == 2
    assert "none of the events" in capsys.readouterr().err
