"""Rotations as unit quaternions (w, x, y, z): exponential, product, interpolation, all finite with finite gradients.

No function divides by an angle or calls acos: small angles go through Taylor series selected by the double-where
idiom (the unused branch sees a harmless argument, so that its gradient is never NaN), larger ones through atan2.
"""

import torch
from jaxtyping import Float
from torch import Tensor

# Below this squared half-angle the series to second order are exact to float32 and float64 rounding respectively.
_SERIES_BELOW = {torch.float32: 1e-4, torch.float64: 1e-6}


def _series_below(values: Tensor) -> float:
    return _SERIES_BELOW.get(values.dtype, 1e-4)


def _sinc(angle_squared: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """sin(a)/a as a function of a squared, smooth at 0."""
    small = angle_squared < _series_below(angle_squared)
    angle = torch.where(small, torch.ones_like(angle_squared), angle_squared).sqrt()
    series = 1 - angle_squared / 6 * (1 - angle_squared / 20 * (1 - angle_squared / 42))
    return torch.where(small, series, angle.sin() / angle)


def _cos(angle_squared: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """cos(a) as a function of a squared, smooth at 0."""
    small = angle_squared < _series_below(angle_squared)
    angle = torch.where(small, torch.ones_like(angle_squared), angle_squared).sqrt()
    series = 1 - angle_squared / 2 * (1 - angle_squared / 12 * (1 - angle_squared / 30))
    return torch.where(small, series, angle.cos())


def quat_wxyz_exp(rotation_vector_rad: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """The unit quaternion that rotates by ``|v|`` about ``v``; the identity, with gradient I/2, at 0."""
    half = rotation_vector_rad / 2
    angle_squared = (half * half).sum(-1, keepdim=True)
    return torch.cat([_cos(angle_squared), half * _sinc(angle_squared)], dim=-1)


def quat_wxyz_log(quat_wxyz: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
    """The rotation vector, at most pi long, of a unit quaternion; q and -q give the same one."""
    quat_wxyz = torch.where(quat_wxyz[..., :1] < 0, -quat_wxyz, quat_wxyz)
    w, vector = quat_wxyz[..., :1], quat_wxyz[..., 1:]
    sine_squared = (vector * vector).sum(-1, keepdim=True)
    small = sine_squared < _series_below(quat_wxyz)
    sine = torch.where(small, torch.ones_like(sine_squared), sine_squared).sqrt()
    tangent_squared = sine_squared / torch.where(small, w, torch.ones_like(w)) ** 2
    # atan(x)/x = 1 - x^2/3 + x^4/5 - ...; dividing by w makes it exact for quaternions a rounding off unit length.
    series = 2 / torch.where(small, w, torch.ones_like(w)) * (1 - tangent_squared * (1 / 3 - tangent_squared / 5))
    return vector * torch.where(small, series, 2 * torch.atan2(sine, w) / sine)


def quat_wxyz_multiply(a: Float[Tensor, "*batch 4"], b: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Hamilton product: rotate by ``b`` first, then by ``a``."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


def quat_wxyz_conjugate(quat_wxyz: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """The inverse of a unit quaternion."""
    return torch.cat([quat_wxyz[..., :1], -quat_wxyz[..., 1:]], dim=-1)


def slerp_wxyz(
    a: Float[Tensor, "*batch 4"], b: Float[Tensor, "*batch 4"], fraction: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 4"]:
    """Constant-velocity rotation from ``a`` (fraction 0) to ``b`` (1) along the shorter arc.

    a · exp(fraction · log(a⁻¹ b)): regular where a = ±b; at exactly half a turn one of the two arcs is taken.
    """
    step = quat_wxyz_log(quat_wxyz_multiply(quat_wxyz_conjugate(a), b))
    return quat_wxyz_multiply(a, quat_wxyz_exp(fraction[..., None] * step))


def quat_wxyz_to_matrix(quat_wxyz: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """The rotation matrix of a unit quaternion."""
    w, x, y, z = quat_wxyz.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def rotate(quat_wxyz: Float[Tensor, "*batch 4"], vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Rotate vectors by unit quaternions: v + 2 q_v x (q_v x v + w v)."""
    w, axis = quat_wxyz[..., :1], quat_wxyz[..., 1:]
    axis, vector = torch.broadcast_tensors(axis, vector)
    return vector + 2 * torch.linalg.cross(axis, torch.linalg.cross(axis, vector) + w * vector)
