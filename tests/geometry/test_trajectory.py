import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BarycentricInterpolator, make_interp_spline
from scipy.spatial.transform import Rotation, Slerp

from ebarf_ns.geometry.so3 import quat_wxyz_to_matrix
from ebarf_ns.geometry.trajectory import (
    Interpolation,
    Poses,
    Trajectory,
    corrected,
    densified,
    interpolate,
    within_span,
)


def keyframes(count: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, Poses]:
    random = np.random.default_rng(seed)
    t_us = torch.from_numpy(np.cumsum(random.integers(1, 50_000, count)))
    quat = Rotation.random(count, np.random.default_rng(seed)).as_quat()[:, [3, 0, 1, 2]]
    return t_us, Poses(torch.from_numpy(random.standard_normal((count, 3))).to(dtype), torch.from_numpy(quat).to(dtype))


def parabolic_at_the_ends(knots: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """A cubic spline whose second derivative is constant in the first and the last interval."""
    if len(knots) < 4:
        # Two points define a line, three a parabola.
        return BarycentricInterpolator(knots, values)(at)
    flat = [(3, np.zeros(values.shape[1]))]
    return make_interp_spline(knots, values, k=3, bc_type=(flat, flat))(at)


@given(st.integers(0, 50), st.integers(2, 9), st.sampled_from(["linear", "cubic"]))
def test_agrees_with_scipy(seed: int, count: int, kind: str):
    t_us, poses = keyframes(count, seed)
    t = np.random.default_rng(seed).integers(int(t_us[0]), int(t_us[-1]) + 1, 20)
    found = interpolate(t_us, poses, torch.from_numpy(t), kind)  # pyright: ignore[reportArgumentType]
    if kind == "cubic":
        expected = parabolic_at_the_ends(t_us.numpy() * 1e-6, poses.position.numpy(), t * 1e-6)
    else:
        expected = np.stack([np.interp(t, t_us.numpy(), axis) for axis in poses.position.numpy().T], axis=1)
    assert np.allclose(found.position.numpy(), expected, atol=1e-9)
    if kind == "cubic":
        return
    turned = Slerp(t_us.numpy(), Rotation.from_quat(poses.quat_wxyz.numpy()[:, [1, 2, 3, 0]]))(t)
    assert np.allclose(quat_wxyz_to_matrix(found.quat_wxyz).numpy(), turned.as_matrix(), atol=1e-7)


def errors_between_keyframes(kind: str, keyframes_per_s: int) -> tuple[float, float]:
    """Largest error [m, rad] for a rotating, oscillating motion that is under way at both ends."""

    def motion(t_us: np.ndarray) -> tuple[np.ndarray, Rotation]:
        t = t_us[:, None] * 1e-6
        swing = np.sin(t * np.array([5.0, 7.0, 6.0]) + np.array([0.3, 1.0, 2.0]))
        return swing, Rotation.from_rotvec(0.4 * swing) * Rotation.from_rotvec(t * np.array([0.0, 2.0, 0.0]))

    t_us = np.arange(0, 2_000_001, 1_000_000 // keyframes_per_s)
    position, rotation = motion(t_us)
    poses = Poses(torch.from_numpy(position), torch.from_numpy(rotation.as_quat()[:, [3, 0, 1, 2]]))
    between = np.random.default_rng(0).integers(0, 2_000_000, 1000)
    found = interpolate(torch.from_numpy(t_us), poses, torch.from_numpy(between), kind)  # pyright: ignore[reportArgumentType]
    true_position, true_rotation = motion(between)
    turned = Rotation.from_quat(found.quat_wxyz.numpy()[:, [1, 2, 3, 0]])
    off_rad = (true_rotation.inv() * turned).magnitude()
    return float(np.abs(found.position.numpy() - true_position).max()), float(off_rad.max())


def test_a_spline_follows_smooth_motion_better_than_lines():
    lines, splines, finer = (
        np.array(errors_between_keyframes(*what)) for what in (("linear", 20), ("cubic", 20), ("cubic", 40))
    )
    assert (splines < 0.1 * lines).all()
    # At the ends, and for rotations, whose frames rotate, the error is cubic in the spacing.
    assert (splines / finer > 6).all()


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


@pytest.mark.parametrize("kind", ["linear", "cubic"])
def test_a_delay_is_an_earlier_time_and_has_its_gradient(kind: Interpolation):
    t_us, poses = keyframes(6)
    at_us = torch.linspace(float(t_us[1]), float(t_us[-1]), 40).long()
    delay_us = torch.linspace(0, 3000, 40, dtype=torch.float64)
    earlier = interpolate(t_us, poses, at_us - delay_us.round().long(), kind)
    delayed = interpolate(t_us, poses, at_us, kind, delay_us.round())
    assert torch.equal(earlier.position, delayed.position)

    def place(delay_us: torch.Tensor) -> torch.Tensor:
        found = interpolate(t_us, poses, at_us, kind, delay_us)
        return torch.cat([found.position, quat_wxyz_to_matrix(found.quat_wxyz).flatten(1)], dim=1)

    weights = torch.rand(12, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    asked = (delay_us + 0.25).requires_grad_()
    (slope,) = torch.autograd.grad((place(asked) @ weights).sum(), asked)
    numerical = (place(asked.detach() + 2) - place(asked.detach() - 2)) @ weights / 4
    assert torch.isfinite(slope).all()
    away = (at_us - delay_us - t_us[:, None]).abs().amin(dim=0) > 3
    assert torch.allclose(slope[away], numerical[away], rtol=1e-3, atol=1e-9)


@given(st.integers(0, 50), st.integers(2, 9), st.integers(1, 100_000), st.sampled_from(["linear", "cubic"]))
def test_poses_are_inserted_on_the_path_and_given_ones_stay(seed: int, count: int, gap_us: int, kind: Interpolation):
    t_us, poses = keyframes(count, seed)
    dense, given_at = densified(Trajectory(t_us, poses), gap_us + 500, kind)
    assert int(dense.t_us.diff().min()) > 0 and int(dense.t_us.diff().max()) <= gap_us + 501
    assert torch.equal(dense.t_us[given_at], t_us)
    assert torch.equal(dense.poses.position[given_at], poses.position)
    assert torch.equal(dense.poses.quat_wxyz[given_at], poses.quat_wxyz)
    between = interpolate(t_us, poses, dense.t_us, kind)
    assert torch.allclose(dense.poses.position, between.position, atol=1e-12)


def test_no_pose_is_inserted_by_default():
    t_us, poses = keyframes(5)
    for gap_us in (0, 10**9):
        dense, given_at = densified(Trajectory(t_us, poses), gap_us, "linear")
        assert torch.equal(dense.t_us, t_us) and given_at.tolist() == [0, 1, 2, 3, 4]
