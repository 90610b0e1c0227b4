"""Rotations against scipy; singularities are tested in tests/stability."""

import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ebarf_ns.geometry.so3 import quat_wxyz_exp, quat_wxyz_multiply, quat_wxyz_to_matrix, rotate

vectors = st.tuples(*[st.floats(-3, 3)] * 3)


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
