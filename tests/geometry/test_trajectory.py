import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from ebarf_ns.errors import TrajectoryError
from ebarf_ns.geometry.so3 import quat_wxyz_to_matrix
from ebarf_ns.geometry.trajectory import Poses, check_keyframes, corrected, interpolate, within_span


def keyframes(count: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, Poses]:
    random = np.random.default_rng(seed)
    t_us = torch.from_numpy(np.cumsum(random.integers(1, 50_000, count)))
    quat = Rotation.random(count, rng=np.random.default_rng(seed)).as_quat()[:, [3, 0, 1, 2]]
    return t_us, Poses(torch.from_numpy(random.standard_normal((count, 3))).to(dtype), torch.from_numpy(quat).to(dtype))


@given(st.integers(0, 50), st.integers(2, 9), st.sampled_from(["linear", "cubic"]))
def test_agrees_with_scipy(seed: int, count: int, kind: str):
    t_us, poses = keyframes(count, seed)
    t = np.random.default_rng(seed).integers(int(t_us[0]), int(t_us[-1]) + 1, 20)
    found = interpolate(t_us, poses, torch.from_numpy(t), kind)  # pyright: ignore[reportArgumentType]
    if kind == "cubic":
        # A natural spline through two points is the line.
        expected = CubicSpline(t_us.numpy() * 1e-6, poses.position.numpy(), bc_type="natural")(t * 1e-6)
    else:
        expected = np.stack([np.interp(t, t_us.numpy(), axis) for axis in poses.position.numpy().T], axis=1)
    assert np.allclose(found.position.numpy(), expected, atol=1e-9)
    turned = Slerp(t_us.numpy(), Rotation.from_quat(poses.quat_wxyz.numpy()[:, [1, 2, 3, 0]]))(t)
    assert np.allclose(quat_wxyz_to_matrix(found.quat_wxyz).numpy(), turned.as_matrix(), atol=1e-7)


@pytest.mark.parametrize("kind", ["linear", "cubic"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_keyframes_are_met_and_ends_clamped(kind: str, dtype: torch.dtype):
    t_us, poses = keyframes(6, dtype=dtype)
    tolerance = 1e-6 if dtype is torch.float32 else 1e-14
    at = interpolate(t_us, poses, t_us, kind)  # pyright: ignore[reportArgumentType]
    assert torch.allclose(at.position, poses.position, atol=tolerance)
    matrices = quat_wxyz_to_matrix(at.quat_wxyz), quat_wxyz_to_matrix(poses.quat_wxyz)
    assert torch.allclose(*matrices, atol=10 * tolerance)
    outside = torch.tensor([int(t_us[0]) - 999, int(t_us[-1]) + 999])
    assert not within_span(outside, t_us).any() and within_span(t_us, t_us).all()
    ends = interpolate(t_us, poses, outside, kind).position  # pyright: ignore[reportArgumentType]
    assert torch.allclose(ends, poses.position[[0, -1]], atol=tolerance)


def test_time_is_exact_at_any_epoch():
    t_us = torch.tensor([10**18, 10**18 + 10])
    poses = Poses(torch.tensor([[0.0, 0, 0], [1, 0, 0]]), torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4))
    assert interpolate(t_us, poses, t_us[:1] + 5).position[0, 0] == 0.5


@given(st.integers(-(10**15), 10**15))
def test_shifting_all_times_changes_nothing(shift_us: int):
    t_us, poses = keyframes(5)
    t = torch.linspace(int(t_us[0]), int(t_us[-1]), 17).long()
    here, there = interpolate(t_us, poses, t), interpolate(t_us + shift_us, poses, t + shift_us)
    assert torch.equal(here.position, there.position) and torch.equal(here.quat_wxyz, there.quat_wxyz)


def test_batches_of_any_size_and_order_are_bitwise_the_same():
    t_us, poses = keyframes(5, dtype=torch.float32)
    t = torch.randint(int(t_us[0]), int(t_us[-1]), (64,), generator=torch.Generator().manual_seed(0))
    whole = interpolate(t_us, poses, t).position
    order = torch.randperm(64, generator=torch.Generator().manual_seed(1))
    assert torch.equal(interpolate(t_us, poses, t[order]).position, whole[order])
    single = torch.cat([interpolate(t_us, poses, t[k : k + 1]).position for k in range(64)])
    assert torch.equal(single, whole)
    assert interpolate(t_us, poses, t[:0]).position.shape == (0, 3)


def test_gradients_reach_the_two_neighbours_alone():
    t_us, poses = keyframes(6)
    correction = torch.zeros(6, 6, dtype=torch.float64, requires_grad=True)
    moved = interpolate(t_us, corrected(poses, correction), ((t_us[2] + t_us[3]) // 2)[None])
    (moved.position.sum() + moved.quat_wxyz.sum()).backward()
    assert correction.grad is not None
    touched = correction.grad.abs().sum(-1) > 0
    assert touched.tolist() == [False, False, True, True, False, False]


@pytest.mark.parametrize("kind", ["linear", "cubic"])
@pytest.mark.parametrize("same", [False, True])
def test_gradcheck_through_corrections(kind: str, same: bool):
    t_us, poses = keyframes(5)
    if same:
        poses = Poses(poses.position[:1].expand(5, 3), poses.quat_wxyz[:1].expand(5, 4))
    t = torch.stack([t_us[0], (t_us[1] + t_us[2]) // 2, t_us[2], t_us[4]])

    def moved(correction: torch.Tensor) -> torch.Tensor:
        return interpolate(t_us, corrected(poses, correction), t, kind).matrix()  # pyright: ignore[reportArgumentType]

    zero = torch.zeros(5, 6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(moved, [zero], eps=1e-6, atol=1e-6, rtol=1e-4)


def test_corrections_act_in_the_cameras_frame():
    quat = torch.from_numpy(Rotation.from_euler("z", 90, degrees=True).as_quat()[[3, 0, 1, 2]])[None]
    moved = corrected(Poses(torch.zeros(1, 3).double(), quat), torch.tensor([[0.0, 0, 0, 1, 0, 0]]).double())
    assert torch.allclose(moved.position, torch.tensor([[0.0, 1, 0]]).double(), atol=1e-12)


@pytest.mark.parametrize("times", [[], [5], [5, 5], [5, 4], [1, 2, 2]])
def test_keyframe_times_must_increase(times: list[int]):
    with pytest.raises(TrajectoryError):
        check_keyframes(torch.tensor(times, dtype=torch.int64))


def test_a_microsecond_between_keyframes_is_enough():
    t_us = torch.tensor([600_000_000, 600_000_001])
    poses = Poses(torch.tensor([[0.0, 0, 0], [1, 0, 0]]), torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0]]))
    correction = torch.zeros(2, 6, requires_grad=True)
    at = interpolate(t_us, corrected(poses, correction), t_us)
    assert torch.equal(at.position, poses.position)
    (at.position.sum() + at.quat_wxyz.sum()).backward()
    assert correction.grad is not None and torch.isfinite(correction.grad).all()
