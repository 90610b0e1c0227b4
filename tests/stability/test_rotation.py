"""Rotations where formulas divide by zero or turn around: cases 1 to 9."""

import math

import mpmath
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.autograd import gradcheck

from ebarf_ns.geometry.so3 import (
    quat_wxyz_conjugate,
    quat_wxyz_exp,
    quat_wxyz_log,
    quat_wxyz_multiply,
    quat_wxyz_to_matrix,
)
from ebarf_ns.geometry.trajectory import Poses, interpolate

F32, F64 = torch.float32, torch.float64
VALUE = {F32: 2e-7, F64: 1e-15}
GRADIENT = {F32: 1e-6, F64: 1e-12}
SEAM_ULPS = 4
SEAM_SLOPE = {F32: 1e-5, F64: 1e-10}
NEAR_PI = {F32: 1e-3, F64: 1e-8}
SIGN_FREE_WITHIN = {F32: 1e-6, F64: 1e-9}
RELATIVE_ANGLE = {F32: 1e-6, F64: 1e-14}
SAME_ROTATION = {F32: 1e-6, F64: 1e-14}
ENDPOINT = {F32: 1e-6, F64: 1e-15}
UNIT_LENGTH = {F32: 5e-7, F64: 1e-15}
CONSTANT_VELOCITY = {F32: 1e-5, F64: 1e-12}
INVARIANCE = {F32: 1e-5, F64: 1e-10}
SINGLE_COSINE, SINGLE_RELATIVE = 0.9999, 1e-3
LONG_RUN_LENGTH = 1e-6
DTYPES = pytest.mark.parametrize("dtype", [F32, F64], ids=["float32", "float64"])
AXIS = torch.tensor([0.48, -0.6, 0.64], dtype=F64)


def some_quats(count: int, dtype: torch.dtype, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(Rotation.random(count, np.random.default_rng(seed)).as_quat()[:, [3, 0, 1, 2]]).to(dtype)


def angle_between(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return quat_wxyz_log(quat_wxyz_multiply(quat_wxyz_conjugate(a), b)).norm(dim=-1)


def interpolated(a: torch.Tensor, b: torch.Tensor, share: float) -> torch.Tensor:
    """What is ``share`` of the way from one keyframe's rotation to the next one's."""
    t_us = torch.tensor([0, 10**6])
    ends = torch.stack([a, b], dim=-2).reshape(-1, 2, 4)
    at = [interpolate(t_us, Poses(pair.new_zeros(2, 3), pair), torch.tensor(round(share * 10**6))) for pair in ends]
    return torch.stack([pose.quat_wxyz for pose in at]).view_as(a)


def jacobian(function, at: torch.Tensor) -> torch.Tensor:
    found = torch.autograd.functional.jacobian(function, at)
    assert isinstance(found, torch.Tensor)
    return found


def exact_exp(turn: torch.Tensor) -> list:
    """The quaternion to 50 digits."""
    with mpmath.workdps(50):
        vector = [mpmath.mpf(float(value)) for value in turn]
        angle = mpmath.sqrt(sum(value**2 for value in vector))
        share = mpmath.sin(angle / 2) / angle if angle else mpmath.mpf("0.5")
        return [mpmath.cos(angle / 2), *(share * value for value in vector)]


@DTYPES
@pytest.mark.parametrize("angle_rad", [0.0, 1e-38, 1e-16, 1e-8, 1e-4, 1e-2, 1.0, 3.0])
def test_case_01_exp_is_exact_from_zero_on(dtype: torch.dtype, angle_rad: float):
    turn = (angle_rad * AXIS).to(dtype)
    found = quat_wxyz_exp(turn)
    if angle_rad == 0:
        assert torch.equal(found, torch.tensor([1.0, 0, 0, 0], dtype=dtype))
    for value, truth in zip(found, exact_exp(turn), strict=True):
        # Small values to their own last digits, large ones to those of one.
        size = max(abs(truth), mpmath.mpf(1e-30)) if angle_rad < 1 else 1
        assert abs(mpmath.mpf(float(value)) - truth) <= VALUE[dtype] * size
    slope = jacobian(quat_wxyz_exp, turn)
    assert torch.isfinite(slope).all()
    if angle_rad <= 1e-8:
        assert torch.allclose(slope[1:], torch.eye(3, dtype=dtype) / 2, atol=GRADIENT[dtype], rtol=0)
    twice = jacobian(quat_wxyz_exp, (angle_rad * AXIS))
    assert torch.allclose(slope.double(), twice, atol=GRADIENT[F32] if dtype is F32 else GRADIENT[F64], rtol=0)


@DTYPES
@pytest.mark.parametrize("angle_rad", [0.02, 0.002])
def test_case_02_series_and_formula_meet_without_a_step(dtype: torch.dtype, angle_rad: float):
    step = torch.finfo(dtype).eps
    turns = [(angle_rad * (1 + k * step) * AXIS).to(dtype) for k in (-1, 1)]
    below, above = (quat_wxyz_exp(turn) for turn in turns)
    assert ((above - below).abs() <= SEAM_ULPS * step * below.abs().clamp_min(angle_rad)).all()
    slopes = [jacobian(quat_wxyz_exp, turn) for turn in turns]
    assert (slopes[0] - slopes[1]).abs().max() <= SEAM_SLOPE[dtype]
    logs = [quat_wxyz_log(quat) for quat in (below, above)]
    assert ((logs[0] - logs[1]).abs() <= 2 * SEAM_ULPS * step * angle_rad + 2 * step).all()
    slopes = [jacobian(quat_wxyz_log, quat) for quat in (below, above)]
    assert (slopes[0] - slopes[1]).abs().max() <= 10 * SEAM_SLOPE[dtype]


@DTYPES
@pytest.mark.parametrize(
    "turn_rad", [math.pi - gap for gap in (1e-2, 1e-4, 1e-7, 1e-10, 0.0)] + [4.0, 2 * math.pi - 1e-11]
)
def test_case_03_log_comes_back_from_half_a_turn_and_from_a_whole_one(dtype: torch.dtype, turn_rad: float):
    turn = (turn_rad * AXIS).to(dtype).requires_grad_()
    back = quat_wxyz_log(quat_wxyz_exp(turn))
    shortest = turn if turn_rad <= math.pi else turn.detach() * (1 - 2 * math.pi / turn_rad)
    misses = [float((back - sign * shortest).detach().norm()) for sign in (1, -1)]
    free = abs(turn_rad - math.pi) <= SIGN_FREE_WITHIN[dtype]
    assert min(misses if free else misses[:1]) <= NEAR_PI[dtype]
    assert float(back.detach().norm()) <= math.pi + NEAR_PI[dtype]
    (gradient,) = torch.autograd.grad((back * torch.tensor([1.0, 2, 3], dtype=dtype)).sum(), turn)
    assert torch.isfinite(gradient).all() and gradient.norm() > 0.1


@DTYPES
@pytest.mark.parametrize("angle_rad", [1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6])
def test_case_04_small_relative_angles_do_not_vanish(dtype: torch.dtype, angle_rad: float):
    identity = torch.tensor([1.0, 0, 0, 0], dtype=dtype)
    turned = quat_wxyz_exp((angle_rad * AXIS).to(dtype))
    truth = float((angle_rad * AXIS).to(dtype).double().norm())
    assert abs(float(angle_between(identity, turned)) - truth) <= RELATIVE_ANGLE[dtype] * truth


@DTYPES
@pytest.mark.parametrize("dot", [1.0, 1 - 1e-8, 0.9995, math.nextafter(0.9995, 1), 1e-8, 0.0, -1e-8, -1.0])
def test_case_05_either_sign_of_a_quaternion_is_the_same_pose_with_the_same_gradient(dtype: torch.dtype, dot: float):
    a = torch.tensor([1.0, 0, 0, 0], dtype=dtype)
    b = torch.tensor([dot, *(math.sqrt(max(0.0, 1 - dot * dot)) * AXIS)], dtype=dtype)
    poses, gradients = [], []
    for sign_a, sign_b in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        turn = torch.zeros(3, dtype=dtype, requires_grad=True)
        moved = quat_wxyz_multiply(sign_b * b, quat_wxyz_exp(turn))
        pose = quat_wxyz_to_matrix(interpolated(sign_a * a, moved, 0.3))
        poses.append(pose.detach())
        gradients.append(torch.autograd.grad((pose * torch.arange(9.0).view(3, 3).to(dtype)).sum(), turn)[0])
        assert torch.isfinite(gradients[-1]).all()
    between = [quat_wxyz_to_matrix(q) for q in (a, b)]
    assert all(torch.isfinite(pose).all() for pose in poses)
    if abs(dot) > 1e-6:
        for pose, gradient in zip(poses[1:], gradients[1:], strict=True):
            assert (pose - poses[0]).abs().max() <= SAME_ROTATION[dtype]
            assert (gradient - gradients[0]).abs().max() <= 10 * SAME_ROTATION[dtype]
    else:
        # At half a turn either of two arcs is right: each is 0.3 of the way.
        for pose in poses:
            way = [Rotation.from_matrix((pose.T @ end).double().numpy()).magnitude() for end in between]
            assert way == pytest.approx([0.3 * math.pi, 0.7 * math.pi], abs=1e-3)


@DTYPES
def test_case_06_slerp_meets_its_ends_at_unit_length_and_constant_velocity(dtype: torch.dtype):
    a, b, c = some_quats(24, dtype).chunk(3)
    for share, end in ((0.0, a), (1.0, b)):
        at = interpolated(a, b, share)
        assert (torch.sign((at * end).sum(-1, keepdim=True)) * at - end).abs().max() <= 4 * ENDPOINT[dtype]
    steps = torch.stack([interpolated(a, b, share / 10) for share in range(11)])
    assert (steps.norm(dim=-1) - 1).abs().max() <= 4 * UNIT_LENGTH[dtype]
    turned = angle_between(steps[:-1], steps[1:])
    assert (turned / turned[:1] - 1).abs().max() <= 10 * CONSTANT_VELOCITY[dtype]
    left = [interpolated(quat_wxyz_multiply(c, a), quat_wxyz_multiply(c, b), 0.3)]
    left.append(quat_wxyz_multiply(c, steps[3]))
    assert (quat_wxyz_to_matrix(left[0]) - quat_wxyz_to_matrix(left[1])).abs().max() <= INVARIANCE[dtype]


@pytest.mark.parametrize("equal", [False, True], ids=["apart", "equal"])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_case_07_gradients_are_those_of_finite_differences(equal: bool, share: float):
    a, b = some_quats(2, F64)
    b = a.clone() if equal else b

    def moved(v: torch.Tensor, w: torch.Tensor) -> torch.Tensor:
        start, end = (quat_wxyz_multiply(quat.to(v), quat_wxyz_exp(turn)) for quat, turn in ((a, v), (b, w)))
        return interpolated(start, end, share)

    zeros = [torch.zeros(3, dtype=F64, requires_grad=True) for _ in range(2)]
    assert gradcheck(moved, zeros, eps=1e-6, atol=1e-6, rtol=1e-4)
    exact = torch.cat([row.flatten() for row in torch.autograd.functional.jacobian(moved, tuple(zeros))])
    singles = tuple(zero.detach().float() for zero in zeros)
    single = torch.cat([row.flatten() for row in torch.autograd.functional.jacobian(moved, singles)]).double()
    assert torch.cosine_similarity(single, exact, dim=0) >= SINGLE_COSINE
    assert (single - exact).norm() / exact.norm() <= SINGLE_RELATIVE


@DTYPES
def test_case_08_ten_thousand_steps_keep_unit_length_and_need_no_noise(dtype: torch.dtype):
    start, goal = some_quats(2, dtype)
    turn = torch.zeros(3, dtype=dtype, requires_grad=True)
    optimizer = torch.optim.Adam([turn], lr=1e-2)
    for _ in range(10_000):
        optimizer.zero_grad()
        quat = quat_wxyz_multiply(start, quat_wxyz_exp(turn))
        (quat_wxyz_to_matrix(quat) - quat_wxyz_to_matrix(goal)).square().sum().backward()
        optimizer.step()
        assert torch.isfinite(turn).all()
    assert abs(float(quat_wxyz_multiply(start, quat_wxyz_exp(turn)).norm()) - 1) <= LONG_RUN_LENGTH


@DTYPES
@pytest.mark.parametrize("error_rad", [0.0, 1e-6, 1.0, math.pi - 1e-3, math.pi])
def test_case_09_poses_converge_from_any_rotation_error(dtype: torch.dtype, error_rad: float):
    goal = some_quats(1, dtype)[0]
    start = quat_wxyz_multiply(goal, quat_wxyz_exp((error_rad * AXIS).to(dtype)))
    turn = torch.zeros(3, dtype=dtype, requires_grad=True)
    optimizer = torch.optim.Adam([turn], lr=2e-2)
    points = torch.eye(3, dtype=dtype)
    for _ in range(1500):
        optimizer.zero_grad()
        turned = quat_wxyz_to_matrix(quat_wxyz_multiply(start, quat_wxyz_exp(turn))) @ points
        # As a renderer's loss does, this one sees where points go; half a turn is its saddle, left by the axis alone.
        target = quat_wxyz_to_matrix(goal) @ points
        (turned - target).square().sum().backward()
        if error_rad == math.pi and turn.grad is not None and turn.grad.norm() < 1e-3:
            turn.grad += 1e-2
        optimizer.step()
    reached = quat_wxyz_multiply(start, quat_wxyz_exp(turn.detach()))
    assert float(angle_between(goal, reached)) < 1e-2
