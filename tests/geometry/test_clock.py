import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from ebarf_ns.geometry.clock import clock_offset
from ebarf_ns.geometry.so3 import quat_wxyz_exp, quat_wxyz_multiply
from ebarf_ns.geometry.trajectory import Poses, Trajectory, interpolate

EVERY_US = 50_000


def smooth_noise(random: np.random.Generator, count: int, size: float, width: float) -> torch.Tensor:
    noise = gaussian_filter1d(random.standard_normal((count + 40, 3)), width, axis=0)[20:-20]
    return torch.from_numpy(noise * size / noise.std())


def hand_held(seed: int, count: int = 60) -> Trajectory:
    random = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(smooth_noise(random, count, 0.1, 4.0).numpy())
    quat = torch.from_numpy(turn.as_quat()[:, [3, 0, 1, 2]])
    return Trajectory(torch.arange(count) * EVERY_US, Poses(smooth_noise(random, count, 0.1, 4.0), quat))


def orbit(ahead_us: int = 0, count: int = 60) -> Trajectory:
    angle = (torch.arange(count).double() * EVERY_US + ahead_us) * 1e-6
    quat = quat_wxyz_exp(angle[:, None] * torch.tensor([0.0, 0, 1], dtype=torch.float64))
    return Trajectory(
        torch.arange(count) * EVERY_US, Poses(torch.stack([angle.cos(), angle.sin(), 0 * angle], dim=1), quat)
    )


def corrected(path: Trajectory, offset_us: int, error_rad: float, seed: int, width: float = 5.0) -> Trajectory:
    """Corrected keyframes for a clock offset, with smooth errors of the correction."""
    inside = interpolate(path.t_us, path.poses, path.t_us - offset_us, "cubic")
    random = np.random.default_rng(seed)
    turn = quat_wxyz_exp(smooth_noise(random, len(path.t_us), error_rad, width))
    shift = smooth_noise(random, len(path.t_us), error_rad / 5, width)
    return Trajectory(path.t_us, Poses(inside.position + shift, quat_wxyz_multiply(turn, inside.quat_wxyz)))


@pytest.mark.parametrize("offset_us", [-100_000, -20_000, 5_000, 150_000])
def test_an_offset_is_found_to_a_millisecond(offset_us: int):
    path = hand_held(1)
    found = clock_offset(path, corrected(path, offset_us, 1e-3, 2), kind="cubic")
    assert found.certain and abs(found.offset_us - offset_us) < max(1000, 3 * found.deviation_us)
    assert found.deviation_us < 2000


@pytest.mark.parametrize("error_rad, width", [(1e-9, 2.0), (1e-3, 0.1), (0.05, 2.0), (0.05, 10.0)])
def test_other_errors_are_not_mistaken_for_an_offset(error_rad: float, width: float):
    """None of 4 drifting handheld trajectories gets a clock offset."""
    wrong = []
    for seed in range(4):
        path = hand_held(seed)
        found = clock_offset(path, corrected(path, 0, error_rad, 100 + seed, width), kind="cubic")
        if found.certain and abs(found.offset_us) > 200:
            wrong.append(found)
    assert not wrong


def test_uniform_motion_gives_no_offset():
    path = orbit()
    found = clock_offset(path, corrected(orbit(30_000), 0, 1e-4, 0), kind="cubic")
    assert not found.certain or found.moved_rad < 3e-4


def test_a_static_camera_gives_no_offset():
    still = Trajectory(
        torch.arange(10) * EVERY_US,
        Poses(torch.zeros(10, 3, dtype=torch.float64), torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(10, 4)),
    )
    assert not clock_offset(still, still).certain


@pytest.mark.parametrize("count", [2, 3, 5])
def test_few_keyframes_give_no_offset(count: int):
    path = hand_held(3, count)
    assert not clock_offset(path, corrected(path, 0, 0.01, 4)).certain
