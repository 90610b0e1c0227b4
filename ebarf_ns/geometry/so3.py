"""Rotations as unit quaternions (w, x, y, z): exponential, logarithm and product, all with finite gradients.

No function calls acos or divides by an angle that may be 0: small angles use Taylor series, selected by the
double-where idiom (the unused branch gets a safe argument, so that its gradient is never NaN), larger ones atan2.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

# Below this squared half-angle, the second-order series are exact to float32 and float64 rounding respectively.
_SERIES_BELOW = {torch.float32: 1e-4, torch.float64: 1e-6}


def _series_below(values: Tensor) -> float:
    return _SERIES_BELOW.get(values.dtype, 1e-4)


def _sinc(angle_squared: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """sin(a)/a as a function of a squared, smooth at 0."""
    small = angle_squared < _series_below(angle_squared)
    angle = torch.where(small, torch.ones_like(angle_squared), angle_squared).sqrt()
    series = 1 - angle_squared / 6 * (1 - angle_squared / 20)
    return torch.where(small, series, angle.sin() / angle)


def quat_wxyz_exp(rotation_vector_rad: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """The unit quaternion that rotates by ``|v|`` about ``v``; at 0 the identity, with gradient I/2."""
    half = rotation_vector_rad / 2
    angle_squared = (half * half).sum(-1, keepdim=True)
    sinc, sinc_of_half = _sinc(torch.cat([angle_squared, angle_squared / 4], dim=-1)).split(1, dim=-1)
    # cos(a) = 1 - 2 sin(a/2)^2
    return torch.cat([1 - angle_squared / 2 * sinc_of_half**2, half * sinc], dim=-1)


def quat_wxyz_log(quat_wxyz: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
    """The rotation vector of a unit quaternion, of length at most pi; q and -q give the same one."""
    quat_wxyz = torch.where(quat_wxyz[..., :1] < 0, -quat_wxyz, quat_wxyz)
    w, vector = quat_wxyz[..., :1], quat_wxyz[..., 1:]
    sine_squared = (vector * vector).sum(-1, keepdim=True)
    small = sine_squared < _series_below(quat_wxyz)
    sine = torch.where(small, torch.ones_like(sine_squared), sine_squared).sqrt()
    cosine = torch.where(small, w, torch.ones_like(w))
    tangent_squared = sine_squared / cosine**2
    # atan(x)/x = 1 - x^2/3 + x^4/5 - ...; dividing by w cancels rounding errors of the quaternion's length.
    series = 2 / cosine * (1 - tangent_squared * (1 / 3 - tangent_squared / 5))
    return vector * torch.where(small, series, 2 * torch.atan2(sine, w) / sine)


def quat_wxyz_multiply(a: Float[Tensor, "*batch 4"], b: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Hamilton product: rotate by ``b`` first, then by ``a``."""
    return _sums_of_products(a, b, _HAMILTON)


def quat_wxyz_conjugate(quat_wxyz: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """The inverse of a unit quaternion."""
    return torch.cat([quat_wxyz[..., :1], -quat_wxyz[..., 1:]], dim=-1)


def turn_between(start: Float[Tensor, "*batch 4"], end: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
    """The rotation vector, in the start frame, from one rotation to another; both are unit quaternions."""
    return quat_wxyz_log(quat_wxyz_multiply(quat_wxyz_conjugate(start), end))


def quat_wxyz_to_matrix(quat_wxyz: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """The rotation matrix of a unit quaternion."""
    identity = torch.eye(3, dtype=quat_wxyz.dtype, device=quat_wxyz.device)
    return identity + _sums_of_products(quat_wxyz, quat_wxyz, _ROTATION).unflatten(-1, (3, 3))


# Products of components (w x y z of each) that sum to each component of the Hamilton product a b ...
_HAMILTON = (
    "ww -xx -yy -zz",
    "wx xw yz -zy",
    "wy -xz yw zx",
    "wz xy -yx zw",
)
# ... and, each twice, to each entry of the rotation matrix minus the identity.
_ROTATION = (
    "-yy -yy -zz -zz", "xy xy -wz -wz", "xz xz wy wy",
    "xy xy wz wz", "-xx -xx -zz -zz", "yz yz -wx -wx",
    "xz xz -wy -wy", "yz yz wx wx", "-xx -xx -yy -yy",
)  # fmt: skip


def _sums_of_products(a: Tensor, b: Tensor, sums: tuple[str, ...]) -> Tensor:
    """One product with a constant matrix; explicit sums would take dozens of kernel launches."""
    products = (a[..., :, None] * b[..., None, :]).flatten(-2)
    # Autocast would run this matrix product in low precision, which poses cannot afford.
    with torch.autocast(a.device.type, enabled=False):
        return products @ _matrix_of(sums, products.dtype, a.device)


@lru_cache
def _matrix_of(sums: tuple[str, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    matrix = torch.zeros(16, len(sums), dtype=dtype, device=device)
    for column, terms in enumerate(sums):
        for term in terms.split():
            first, second = ("wxyz".index(letter) for letter in term[-2:])
            matrix[4 * first + second, column] += -1 if term[0] == "-" else 1
    return matrix


def rotate(quat_wxyz: Float[Tensor, "*batch 4"], vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Rotate vectors by unit quaternions: v + 2 q_v x (q_v x v + w v)."""
    w, axis = quat_wxyz[..., :1], quat_wxyz[..., 1:]
    axis, vector = torch.broadcast_tensors(axis, vector)
    return vector + 2 * torch.linalg.cross(axis, torch.linalg.cross(axis, vector) + w * vector)
