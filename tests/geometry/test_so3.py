"""Rotations, in both precisions, at the places where formulas divide by zero."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch.autograd import gradcheck

from ebarf_ns.geometry.so3 import (
    quat_wxyz_conjugate,
    quat_wxyz_exp,
    quat_wxyz_log,
    quat_wxyz_multiply,
    quat_wxyz_to_matrix,
    rotate,
    slerp_wxyz,
)

TOLERANCE = {torch.float32: 2e-6, torch.float64: 1e-14}
DTYPES = (torch.float32, torch.float64)
vectors = st.tuples(*[st.floats(-3, 3)] * 3)


def random_quat(count: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.from_numpy(Rotation.random(count, rng=np.random.default_rng(0)).as_quat()[:, [3, 0, 1, 2]]).to(dtype)


@given(vectors, vectors)
def test_agrees_with_scipy(a: tuple, b: tuple):
    turn = torch.tensor(a, dtype=torch.float64)
    truth = Rotation.from_rotvec(a)
    quat = quat_wxyz_exp(turn)
    assert torch.allclose(quat_wxyz_to_matrix(quat), torch.from_numpy(truth.as_matrix()), atol=1e-12)
    vector = torch.tensor(b, dtype=torch.float64)
    assert torch.allclose(rotate(quat, vector), torch.from_numpy(truth.apply(b)), atol=1e-12)
    both = quat_wxyz_multiply(quat, quat_wxyz_exp(vector))
    assert torch.allclose(
        quat_wxyz_to_matrix(both), torch.from_numpy((truth * Rotation.from_rotvec(b)).as_matrix()), atol=1e-12
    )


@pytest.mark.parametrize("dtype", DTYPES)
def test_exp_at_zero_is_the_identity_with_half_the_unit_gradient(dtype: torch.dtype):
    zero = torch.zeros(3, dtype=dtype)
    assert torch.equal(quat_wxyz_exp(zero), torch.tensor([1.0, 0, 0, 0], dtype=dtype))
    jacobian = torch.autograd.functional.jacobian(quat_wxyz_exp, zero)
    assert isinstance(jacobian, torch.Tensor)
    assert torch.equal(jacobian[1:], torch.eye(3, dtype=dtype) / 2) and torch.equal(jacobian[0], zero)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("angle_rad", [1e-38, 1e-16, 1e-8, 1e-4, 1e-2, 0.0199, 0.0201, 1.0, 3.0])
def test_exp_and_log_keep_every_angle(dtype: torch.dtype, angle_rad: float):
    axis = torch.tensor([0.48, -0.6, 0.64], dtype=dtype)
    turn = (angle_rad * axis).requires_grad_()
    quat = quat_wxyz_exp(turn)
    assert abs(float(quat[0]) - math.cos(angle_rad / 2)) <= TOLERANCE[dtype]
    back = quat_wxyz_log(quat)
    assert torch.allclose(back, turn, rtol=10 * TOLERANCE[dtype], atol=1e-44)
    jacobian = torch.autograd.functional.jacobian(lambda v: quat_wxyz_log(quat_wxyz_exp(v)), turn.detach())
    assert isinstance(jacobian, torch.Tensor)
    assert torch.allclose(jacobian, torch.eye(3, dtype=dtype), atol=100 * TOLERANCE[dtype])


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-3), (torch.float64, 1e-8)])
@pytest.mark.parametrize("short_of_pi", [1e-2, 1e-4, 1e-7, 1e-10, 0.0])
def test_log_near_half_a_turn(dtype: torch.dtype, tolerance: float, short_of_pi: float):
    turn = (math.pi - short_of_pi) * torch.tensor([0.0, 0.6, 0.8], dtype=dtype)
    turn.requires_grad_()
    back = quat_wxyz_log(quat_wxyz_exp(turn))
    close = min(float((back - turn).detach().norm()), float((back + turn).detach().norm()) if short_of_pi < 1e-6 else 9)
    assert close < tolerance
    (gradient,) = torch.autograd.grad(back.sum(), turn)
    assert torch.isfinite(gradient).all() and gradient.norm() > 0


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("angle_rad", [1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6])
def test_relative_angles_do_not_vanish(dtype: torch.dtype, angle_rad: float):
    a = random_quat(1, dtype)[0]
    b = quat_wxyz_multiply(a, quat_wxyz_exp(torch.tensor([0.0, angle_rad, 0.0], dtype=dtype)))
    angle = quat_wxyz_log(quat_wxyz_multiply(quat_wxyz_conjugate(a), b)).norm()
    # The inputs themselves are rounded: an absolute part remains.
    assert abs(float(angle) - angle_rad) <= 1e-6 * angle_rad + 4 * torch.finfo(dtype).eps


@pytest.mark.parametrize("dtype", DTYPES)
def test_slerp_ends_unit_length_and_constant_velocity(dtype: torch.dtype):
    a, b = random_quat(8, dtype)[:4], random_quat(8, dtype)[4:]
    tolerance = 10 * TOLERANCE[dtype]
    for u, end in ((0.0, a), (1.0, b)):
        at = slerp_wxyz(a, b, torch.full((4,), u, dtype=dtype))
        sign = torch.sign((at * end).sum(-1, keepdim=True))
        assert torch.allclose(sign * at, end, atol=tolerance)
    steps = [slerp_wxyz(a, b, torch.full((4,), k / 10, dtype=dtype)) for k in range(11)]
    angles = torch.stack(
        [quat_wxyz_log(quat_wxyz_multiply(quat_wxyz_conjugate(p), q)).norm(dim=-1) for p, q in zip(steps, steps[1:])]  # noqa: B905
    )
    assert torch.allclose(angles, angles[:1].expand_as(angles), rtol=100 * tolerance, atol=tolerance)
    assert all(torch.allclose(q.norm(dim=-1), torch.ones(4, dtype=dtype), atol=tolerance) for q in steps)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("dot", [1.0, 1 - 1e-8, 0.9995, 1e-8, 0.0, -1e-8, -1.0])
def test_slerp_is_regular_for_any_angle_between_the_ends(dtype: torch.dtype, dot: float):
    a = torch.tensor([1.0, 0, 0, 0], dtype=dtype, requires_grad=True)
    b = torch.tensor([dot, math.sqrt(max(0.0, 1 - dot * dot)), 0, 0], dtype=dtype, requires_grad=True)
    middle = slerp_wxyz(a, b, torch.tensor(0.5, dtype=dtype))
    to_a, to_b = (quat_wxyz_log(quat_wxyz_multiply(quat_wxyz_conjugate(middle), end)).norm() for end in (a, b))
    assert torch.allclose(to_a, to_b, atol=1e-3 if dtype is torch.float32 else 1e-7)
    gradients = torch.autograd.grad((middle * torch.tensor([1.0, 2, 3, 4], dtype=dtype)).sum(), [a, b])
    assert all(torch.isfinite(gradient).all() for gradient in gradients)


def test_antipodal_quaternions_are_the_same_rotation():
    a, b = random_quat(2)
    u = torch.tensor(0.3, dtype=torch.float64)
    expected = quat_wxyz_to_matrix(slerp_wxyz(a, b, u))
    for p, q in ((a, -b), (-a, b), (-a, -b)):
        assert torch.allclose(quat_wxyz_to_matrix(slerp_wxyz(p, q, u)), expected, atol=1e-14)


@pytest.mark.parametrize("equal", [False, True])
def test_gradcheck_of_slerp(equal: bool):
    a, b = random_quat(2)
    b = a.clone() if equal else b
    u = torch.tensor(0.3, dtype=torch.float64)

    def interpolated(v: torch.Tensor, w: torch.Tensor) -> torch.Tensor:
        return slerp_wxyz(quat_wxyz_multiply(a, quat_wxyz_exp(v)), quat_wxyz_multiply(b, quat_wxyz_exp(w)), u)

    zeros = [torch.zeros(3, dtype=torch.float64, requires_grad=True) for _ in range(2)]
    assert gradcheck(interpolated, zeros, eps=1e-6, atol=1e-6, rtol=1e-4)


def test_adam_from_zero_needs_no_noise():
    turn = torch.zeros(3, requires_grad=True)
    goal = quat_wxyz_exp(torch.tensor([0.5, -1.0, 2.0]))
    optimizer = torch.optim.Adam([turn], lr=0.01)
    for _ in range(1000):
        optimizer.zero_grad()
        (quat_wxyz_to_matrix(quat_wxyz_exp(turn)) - quat_wxyz_to_matrix(goal)).square().sum().backward()
        optimizer.step()
    assert torch.isfinite(turn).all()
    assert quat_wxyz_log(quat_wxyz_multiply(quat_wxyz_conjugate(quat_wxyz_exp(turn)), goal)).norm() < 1e-2
