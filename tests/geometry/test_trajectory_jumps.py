"""Discontinuous trajectories are reported; continuous ones are not, however they move."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ebarf_ns.geometry.trajectory import Poses, Trajectory
from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.geometry.trajectory_jumps import torn
from tests.conftest import DATA

T_US = 50_000 * np.arange(25)


def path(t_us: np.ndarray) -> np.ndarray:
    t = t_us[:, None] * 1e-6
    return np.hstack([0.5 * np.sin(2 * t), 0.4 * np.cos(3 * t), 0.3 * t])


def trajectory(t_us: np.ndarray, position: np.ndarray, turn: np.ndarray | None = None) -> Trajectory:
    turn = 0.3 * position if turn is None else turn
    quat_wxyz = Rotation.from_rotvec(turn).as_quat()[:, [3, 0, 1, 2]]
    return Trajectory(torch.from_numpy(t_us), Poses(torch.from_numpy(position), torch.from_numpy(quat_wxyz)))


@pytest.mark.parametrize("jump", [0.8, 2.7, 100.0])
@pytest.mark.parametrize("at", [1, 7, 12, 24])
def test_a_jump_is_named(jump: float, at: int):
    position = path(T_US)
    position[at:] += [jump, 0, 0]
    (said,) = torn(trajectory(T_US, position, np.zeros_like(position)))
    assert said.startswith(f"between keyframes {at - 1} and {at} (50 ms") and "times the median" in said


def test_a_jump_of_the_direction_is_named():
    turn = 0.2 * path(T_US)
    turn[12:] += [0, 0, 0.8]
    (said,) = torn(trajectory(T_US, path(T_US), turn))
    assert said.startswith("between keyframes 11 and 12") and "the camera turns 4" in said


@pytest.mark.parametrize("away", [3.0, 40.0])
def test_one_pose_far_away_is_named(away: float):
    position = path(T_US)
    position[6, 1] += away
    (said,) = torn(trajectory(T_US, position, np.zeros_like(position)))
    assert said.startswith("keyframe 6, at 0.300 s, is ") and "keyframes 5 and 7" in said


@pytest.mark.parametrize("step_us", [50_000, 33_000])
def test_two_sessions_in_one_are_named(step_us: int):
    other_us = 20_000 + step_us * np.arange(25)
    t_us = np.concatenate([T_US, other_us])
    position = np.concatenate([path(T_US), path(other_us) + [3, 0, 0]])
    t_us, kept = np.unique(t_us, return_index=True)
    (said,) = torn(trajectory(t_us, position[kept], np.zeros((len(t_us), 3))))
    assert "two sessions in one trajectory?" in said and "between keyframes 0 and 1" in said


def test_continuous_motion_is_not_suspected():
    rng = np.random.default_rng(0)
    t_us = 20_000 * np.arange(100)
    rest_then_run = path(t_us) / (1 + np.exp((1.0 - t_us[:, None] * 1e-6) * 10))
    noisy = path(t_us) + 0.01 * rng.standard_normal((100, 3))
    still = 1e-4 * rng.standard_normal((100, 3))
    gap = np.flatnonzero((t_us < 600_000) | (t_us > 1_200_000))
    assert not torn(trajectory(t_us, path(t_us)))
    assert not torn(trajectory(t_us, rest_then_run))
    assert not torn(trajectory(t_us, noisy))
    assert not torn(trajectory(t_us, still))
    assert not torn(trajectory(t_us[gap], path(t_us)[gap]))
    assert not torn(trajectory(t_us, np.zeros((100, 3))))


@pytest.mark.parametrize("name", ["mocap-1d-trans", "mocap-6dof", "mocap-desk2"])
def test_real_trajectories_are_not_suspected(name: str):
    folder = DATA / "trajectories"
    if not folder.is_dir():
        pytest.skip(f"no trajectories at {DATA}; set EBARF_TEST_DATA to their folder")
    for source in ("deio", "gt_esptam"):
        assert not torn(read_tum(folder / f"TUM-VIE_{name}_{source}.txt"))
