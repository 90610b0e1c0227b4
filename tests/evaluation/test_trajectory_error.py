import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from evo.core import metrics
from evo.core.trajectory import PosePath3D
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ebarf_ns.errors import EvaluationError
from ebarf_ns.evaluation.compare import compare_files
from ebarf_ns.evaluation.trajectory_error import (
    aligned_positions,
    reference_in_estimates_world,
    rotation_error_deg,
    trajectory_error,
)
from ebarf_ns.geometry.trajectory import Poses, Trajectory
from ebarf_ns.geometry.trajectory_file import write_tum


def make(position: np.ndarray, turn: Rotation, start_us: int = 0) -> Trajectory:
    t_us = torch.arange(len(position)) * 10_000 + start_us
    return Trajectory(t_us, Poses(torch.from_numpy(position), torch.from_numpy(turn.as_quat()[:, [3, 0, 1, 2]])))


def wander(count: int = 20, seed: int = 0) -> tuple[np.ndarray, Rotation]:
    random = np.random.default_rng(seed)
    return random.standard_normal((count, 3)), Rotation.random(count, np.random.default_rng(seed))


@settings(max_examples=25)
@given(st.integers(0, 100), st.floats(0.1, 10))
def test_a_similarity_is_no_error(seed: int, scale: float):
    position, turn = wander(seed=seed)
    world = Rotation.random(None, np.random.default_rng(seed + 1))
    moved = make(scale * world.apply(position) + [1, -2, 3], world * turn)
    error = trajectory_error(moved, make(position, turn), "sim3")
    assert error.ate_m < 1e-9 and error.rotation_deg < 1e-5 and error.scale == pytest.approx(1 / scale)
    assert trajectory_error(moved, make(position, turn), "orientation").ate_m < 1e-8


def test_se3_keeps_the_scale():
    position, turn = wander()
    position -= position.mean(axis=0)
    error = trajectory_error(make(1.1 * position, turn), make(position, turn), "se3")
    assert error.scale == 1 and error.ate_m == pytest.approx(0.1 * np.sqrt((position**2).sum(1).mean()), rel=1e-6)


def test_error_does_not_change_when_the_estimate_is_moved():
    position, turn = wander()
    random = np.random.default_rng(5)
    noisy_position = position + 0.05 * random.standard_normal(position.shape)
    noisy_turn = turn * Rotation.from_rotvec(0.02 * random.standard_normal(position.shape))
    world = Rotation.random(None, np.random.default_rng(9))
    here = trajectory_error(make(noisy_position, noisy_turn), make(position, turn), "sim3")
    there = trajectory_error(
        make(3 * world.apply(noisy_position) + 7, world * noisy_turn), make(position, turn), "sim3"
    )
    assert there.ate_m == pytest.approx(here.ate_m, rel=1e-9)
    assert there.rotation_deg == pytest.approx(here.rotation_deg, rel=1e-6)
    assert np.degrees(0.02 * np.sqrt(3)) == pytest.approx(here.rotation_deg, rel=0.3)


def test_another_body_on_the_rig_is_no_rotation_error():
    position, turn = wander()
    other, body = make(position, turn * Rotation.from_euler("y", 30, degrees=True)), make(position, turn)
    assert rotation_error_deg(other, body) > 5 and rotation_error_deg(other, body, with_body=True) < 1e-4


def test_reference_is_interpolated_and_poses_outside_left_out():
    position, turn = np.linspace([0, 0, 0], [1, 2, 3], 20), Rotation.identity(20)
    position[:, 1] **= 2
    error = trajectory_error(make(position, turn, start_us=100_000), make(position, turn), "se3")
    assert error.matched == 10


@pytest.mark.parametrize("alignment", ["se3", "sim3"])
@pytest.mark.parametrize("shape", ["line", "point", "two"])
def test_no_alignment_is_no_number(alignment: str, shape: str):
    position, turn = wander(2 if shape == "two" else 10)
    if shape == "line":
        # Not exactly on an axis, and rounded like a file: the turn about the line would be anything.
        noise = 1e-4 * np.random.default_rng(0).standard_normal((10, 3))
        position = (np.linspace(0, 1, 10)[:, None] * [[1.0, 2, 3]] + noise).round(9)
    if shape == "point":
        position = np.ones((10, 3))
    with pytest.raises(EvaluationError):
        trajectory_error(make(position, turn), make(position, turn), alignment)  # pyright: ignore[reportArgumentType]


def test_a_line_can_be_aligned_by_orientation():
    position, turn = np.linspace(0, 1, 10)[:, None] * [[1.0, 2, 3]], wander(10)[1]
    world = Rotation.random(None, np.random.default_rng(3))
    moved = make(2 * world.apply(position) + 5, world * turn)
    assert trajectory_error(moved, make(position, turn), "orientation").ate_m < 1e-8
    assert np.allclose(aligned_positions(moved, make(position, turn)), position, atol=1e-8)
    with pytest.raises(EvaluationError, match="does not move"):
        trajectory_error(make(np.ones((10, 3)), turn), make(position, turn), "orientation")


def test_files_are_compared_with_every_alignment(tmp_path):
    position, turn = wander()
    for name in ("a.txt", "b.txt"):
        write_tum(tmp_path / name, make(position, turn))
    comparison = compare_files(tmp_path / "a.txt", tmp_path / "b.txt")
    assert comparison["matched"] == 20 and comparison["sim3"]["ate_m"] < 1e-6 and len(comparison["notes"]) == 2


@pytest.mark.parametrize("directions", [(1, 1, 1), (1, 0, 0)], ids=["wandering", "along a line"])
def test_reference_poses_are_found_in_the_estimates_world(directions: tuple[int, int, int]):
    position, turn = wander()
    position = position * directions
    world = Rotation.random(None, np.random.default_rng(4))
    estimate = make(2 * world.apply(position) + 5, world * turn)
    reference = make(position, turn)
    placed = reference_in_estimates_world(estimate, reference, reference.t_us)
    assert torch.allclose(placed.position, estimate.poses.position, atol=1e-9)
    assert torch.allclose(placed.matrix(), estimate.poses.matrix(), atol=1e-9)


@pytest.mark.parametrize(("alignment", "flags"), [("se3", ["-a"]), ("sim3", ["-a", "-s"])])
def test_errors_are_those_of_evos_command_line(tmp_path: Path, alignment: str, flags: list[str]):
    position, turn = wander(40)
    random = np.random.default_rng(3)
    noisy = 1.3 * position + 0.05 * random.standard_normal(position.shape)
    write_tum(tmp_path / "truth.txt", make(position, turn))
    write_tum(
        tmp_path / "estimate.txt", make(noisy, turn * Rotation.from_rotvec(0.1 * random.standard_normal((40, 3))))
    )
    ours = compare_files(tmp_path / "estimate.txt", tmp_path / "truth.txt")[alignment]
    for relation, statistic, mine in (("trans_part", "rmse", ours["ate_m"]), ("full", "mean", ours["ape_full"])):
        words = ["tum", "truth.txt", "estimate.txt", *flags, "-r", relation, "--save_results", f"{relation}.zip"]
        command = [Path(sys.executable).parent / "evo_ape", *words]
        environment = {**os.environ, "HOME": str(tmp_path)}
        subprocess.run(command, check=True, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL)
        with zipfile.ZipFile(tmp_path / f"{relation}.zip") as results:
            assert mine == pytest.approx(json.loads(results.read("stats.json"))[statistic], abs=1e-9)


@pytest.mark.parametrize(("alignment", "with_scale"), [("se3", False), ("sim3", True)])
def test_errors_are_those_of_evo(alignment: str, with_scale: bool):
    position, turn = wander()
    random = np.random.default_rng(5)
    noisy = (
        position + 0.05 * random.standard_normal(position.shape),
        turn * Rotation.from_rotvec(0.02 * random.standard_normal(position.shape)),
    )
    ours = trajectory_error(make(*noisy), make(position, turn), alignment)  # pyright: ignore[reportArgumentType]
    estimate, true = (PosePath3D(x, q.as_quat()[:, [3, 0, 1, 2]]) for x, q in (noisy, (position, turn)))
    estimate.align(true, correct_scale=with_scale)
    theirs = []
    for relation in (metrics.PoseRelation.translation_part, metrics.PoseRelation.full_transformation):
        error = metrics.APE(relation)
        error.process_data((true, estimate))
        theirs.append(error)
    assert ours.ate_m == pytest.approx(theirs[0].get_statistic(metrics.StatisticsType.rmse), rel=1e-9)
    assert ours.ape_full == pytest.approx(theirs[1].get_statistic(metrics.StatisticsType.mean), rel=1e-9)
