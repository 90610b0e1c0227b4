"""Time and trajectories: cases 10 to 15."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ebarf_ns.errors import EvaluationError, TrajectoryError
from ebarf_ns.evaluation.trajectory_error import reference_in_estimates_world
from ebarf_ns.geometry.trajectory import Poses, Trajectory, check_keyframes, corrected, interpolate, within_span
from ebarf_ns.geometry.trajectory_file import read_tum

F32, F64 = torch.float32, torch.float64
CLAMPED = {F32: 1e-6, F64: 1e-14}
WEIGHT_SUM = 1e-7
DTYPES = pytest.mark.parametrize("dtype", [F32, F64], ids=["float32", "float64"])
KINDS = pytest.mark.parametrize("kind", ["linear", "cubic"])
STILL = torch.tensor([[1.0, 0, 0, 0]])


def keyframes(count: int, dtype: torch.dtype = F64, seed: int = 0) -> tuple[torch.Tensor, Poses]:
    random = np.random.default_rng(seed)
    t_us = torch.from_numpy(np.cumsum(random.integers(1, 50_000, count)))
    quat = Rotation.random(count, random).as_quat()[:, [3, 0, 1, 2]]
    return t_us, Poses(torch.from_numpy(random.standard_normal((count, 3))).to(dtype), torch.from_numpy(quat).to(dtype))


@DTYPES
def test_case_10_time_is_exact_at_any_epoch_and_over_any_span(dtype: torch.dtype):
    line = Poses(torch.tensor([[0.0, 0, 0], [1, 0, 0]], dtype=dtype), STILL.to(dtype).expand(2, 4))
    late = torch.tensor([10**18, 10**18 + 10])
    assert interpolate(late, line, late[:1] + 5).position[0, 0] == 0.5
    apart = torch.tensor([600_000_000, 600_000_001])
    assert interpolate(apart, line, apart).position[:, 0].tolist() == [0.0, 1.0]
    widest = torch.tensor([-(2**62), 2**62 - 1])
    assert float(interpolate(widest, line, torch.tensor([0])).position[0, 0]) == pytest.approx(0.5, abs=1e-7)


@given(st.integers(-(10**17), 10**17))
def test_case_11_shifting_all_times_changes_no_bit(shift_us: int):
    t_us, poses = keyframes(5)
    t = torch.linspace(int(t_us[0]), int(t_us[-1]), 17).long()
    here, there = interpolate(t_us, poses, t), interpolate(t_us + shift_us, poses, t + shift_us)
    assert torch.equal(here.position, there.position) and torch.equal(here.quat_wxyz, there.quat_wxyz)


@DTYPES
@KINDS
def test_case_12_outside_the_span_is_the_nearer_end_and_says_so(dtype: torch.dtype, kind: str):
    t_us, poses = keyframes(6, dtype)
    outside = torch.tensor([int(t_us[0]) - 10**9, int(t_us[0]) - 1, int(t_us[-1]) + 1, int(t_us[-1]) + 10**9])
    assert not within_span(outside, t_us).any() and within_span(t_us, t_us).all()
    ends = interpolate(t_us, poses, outside, kind)  # pyright: ignore[reportArgumentType]
    assert torch.allclose(ends.position, poses.position[[0, 0, -1, -1]], atol=CLAMPED[dtype])
    correction = torch.zeros(6, 6, dtype=dtype, requires_grad=True)
    moved = interpolate(t_us, corrected(poses, correction), outside, kind)  # pyright: ignore[reportArgumentType]
    # What callers do with such rays: their weight is nothing, and so is their gradient.
    (moved.position * within_span(outside, t_us)[:, None]).sum().backward()
    assert correction.grad is not None and (correction.grad == 0).all()


def test_case_12_where_a_pose_outside_the_span_would_be_an_answer_it_is_an_error():
    t_us, poses = keyframes(6, torch.float64)
    truth = Trajectory(t_us, poses)
    with pytest.raises(EvaluationError, match=f"{int(t_us[-1]) + 1} us.*{int(t_us[0])} to {int(t_us[-1])} us"):
        reference_in_estimates_world(truth, truth, t_us[-1:] + 1)


@pytest.mark.parametrize("times", [[], [5], [5, 5], [5, 4], [1, 2, 2]])
def test_case_13_keyframe_times_that_do_not_increase_are_refused(times: list[int]):
    with pytest.raises(TrajectoryError):
        check_keyframes(torch.tensor(times, dtype=torch.int64))


@pytest.mark.parametrize(
    "line",
    ["0.1 nan 0 0 0 0 0 1", "0.1 0 0 inf 0 0 0 1", "0.1 0 0 0 0 0 0 0", "0.1 0 0 0 0 0 0 2", "nan 0 0 0 0 0 0 1"],
)
def test_case_13_poses_that_are_none_are_refused_with_their_line(tmp_path, line: str):
    path = tmp_path / "trajectory.txt"
    path.write_text(f"0.0 0 0 0 0 0 0 1\n{line}\n0.2 0 0 0 0 0 0 1\n")
    with pytest.raises(TrajectoryError, match="txt:2: "):
        read_tum(path)


@DTYPES
@KINDS
def test_case_13_keyframes_a_microsecond_apart_have_finite_gradients(dtype: torch.dtype, kind: str):
    t_us = torch.tensor([600_000_000, 600_000_001, 600_000_002])
    poses = Poses(torch.eye(3, dtype=dtype), torch.eye(4, dtype=dtype)[:3])
    correction = torch.zeros(3, 6, dtype=dtype, requires_grad=True)
    at = interpolate(t_us, corrected(poses, correction), t_us, kind)  # pyright: ignore[reportArgumentType]
    assert torch.allclose(at.position, poses.position, atol=CLAMPED[dtype])
    (at.position.sum() + at.quat_wxyz.sum()).backward()
    assert correction.grad is not None and torch.isfinite(correction.grad).all()


@DTYPES
def test_case_14_an_event_moves_the_keyframes_around_it_and_no_other(dtype: torch.dtype):
    t_us, poses = keyframes(6, dtype)
    middle = (t_us[2] + t_us[3]) // 2
    for at, expected in ((middle, [2, 3]), (t_us[2], [2])):
        correction = torch.zeros(6, 6, dtype=dtype, requires_grad=True)
        moved = interpolate(t_us, corrected(poses, correction), at[None])
        weights = torch.autograd.grad(moved.position[0, 0], correction, retain_graph=True)[0]
        (moved.position.sum() + moved.quat_wxyz.sum()).backward()
        assert correction.grad is not None
        touched = torch.nonzero(correction.grad.abs().sum(-1)).flatten().tolist()
        assert touched == expected and torch.isfinite(weights).all()
    shift = torch.ones(6, 3, dtype=dtype)
    moved = interpolate(t_us, Poses(poses.position + shift, poses.quat_wxyz), middle[None]).position
    assert (moved - interpolate(t_us, poses, middle[None]).position - 1).abs().max() <= 10 * WEIGHT_SUM


@DTYPES
def test_case_15_order_and_batch_size_change_no_bit(dtype: torch.dtype):
    t_us, poses = keyframes(5, dtype)
    t = torch.randint(int(t_us[0]), int(t_us[-1]), (64,), generator=torch.Generator().manual_seed(0))
    whole = interpolate(t_us, poses, t)
    order = torch.randperm(64, generator=torch.Generator().manual_seed(1))
    assert torch.equal(interpolate(t_us, poses, t[order]).position, whole.position[order])
    single = torch.cat([interpolate(t_us, poses, t[k : k + 1]).position for k in range(64)])
    assert torch.equal(single, whole.position)
    assert interpolate(t_us, poses, t[:0]).position.shape == (0, 3)
