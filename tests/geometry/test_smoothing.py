import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ebarf_ns.geometry.smoothing import smoothed
from ebarf_ns.geometry.so3 import quat_wxyz_to_matrix
from ebarf_ns.geometry.trajectory import Poses, Trajectory


def handheld(count: int, noise: float, seed: int) -> Trajectory:
    t = np.linspace(0, 2, count)
    random = np.random.default_rng(seed)
    position = np.stack([np.sin(2 * t), 0.5 * np.cos(3 * t), 0.2 * t], axis=1)
    turn = Rotation.from_rotvec(np.stack([0.3 * np.sin(t), 4 * t, 0.2 * np.cos(2 * t)], axis=1))
    turn = turn * Rotation.from_rotvec(noise * random.standard_normal((count, 3)))
    quat = turn.as_quat()[:, [3, 0, 1, 2]] * random.choice([-1, 1], (count, 1))
    position = position + noise * random.standard_normal((count, 3))
    t_us = torch.from_numpy((t * 1e6).round().astype(np.int64))
    return Trajectory(t_us, Poses(torch.from_numpy(position), torch.from_numpy(quat)))


def errors(a: Trajectory, b: Trajectory) -> tuple[float, float]:
    turned = quat_wxyz_to_matrix(a.poses.quat_wxyz).mT @ quat_wxyz_to_matrix(b.poses.quat_wxyz)
    angle = Rotation.from_matrix(turned.numpy()).magnitude()
    return float((a.poses.position - b.poses.position).square().sum(-1).mean().sqrt()), float(
        np.sqrt((angle**2).mean())
    )


@pytest.mark.parametrize("seed", range(5))
def test_noise_is_more_than_halved_whatever_the_signs_of_quaternions(seed: int):
    true, noisy = handheld(60, 0, seed), handheld(60, 0.03, seed)
    before, after = errors(noisy, true), errors(smoothed(noisy), true)
    assert after[0] < 0.6 * before[0] and after[1] < 0.6 * before[1]


def test_true_poses_stay_where_they_are():
    true = handheld(60, 0, 0)
    position, angle = errors(smoothed(true), true)
    assert position < 1e-3 and angle < 1e-3


def test_few_keyframes_are_rarely_overfitted():
    t_us = torch.arange(17) * 10_000
    still = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).repeat(17, 1)
    line = Trajectory(t_us, Poses(torch.linspace(0, 0.05, 17, dtype=torch.float64)[:, None] * torch.eye(3)[0], still))
    left = []
    for seed in range(40):
        noise = 0.01 * torch.from_numpy(np.random.default_rng(seed).standard_normal((17, 3)))
        noisy = Trajectory(t_us, Poses(line.poses.position + noise, still))
        left.append(errors(smoothed(noisy), line)[0] / errors(noisy, line)[0])
    # A fitted straight line would leave sqrt(2 / 17) = 0.34.
    assert np.median(left) < 0.4 and np.quantile(left, 0.9) < 0.55


@pytest.mark.parametrize("count", [2, 4])
def test_few_keyframes_are_left_alone(count: int):
    few = handheld(count, 0.03, 0)
    assert smoothed(few) is few


def test_standing_still_stays_finite():
    still = Trajectory(torch.arange(10) * 1000, Poses(torch.ones(10, 3), torch.tensor([[1.0, 0, 0, 0]]).repeat(10, 1)))
    assert torch.equal(smoothed(still).poses.position, still.poses.position)


def test_many_keyframes_are_smoothed_as_well_and_at_once():
    true, noisy = handheld(5000, 0, 0), handheld(5000, 0.03, 0)
    after = smoothed(noisy)
    assert max(errors(after, true)) < 0.15 * min(errors(noisy, true))
    position, angle = errors(smoothed(true), true)
    assert position < 1e-4 and angle < 1e-4


@pytest.mark.parametrize("count", [119, 121, 399, 401, 801])
def test_more_keyframes_are_never_smoothed_worse(count: int):
    fewer, more = (
        [errors(smoothed(handheld(n, 0.03, seed)), handheld(n, 0, seed)) for seed in range(4)] for n in (60, count)
    )
    assert (np.median(more, axis=0) < np.median(fewer, axis=0)).all()
