"""Timestamped keyframe poses, their corrections, and interpolation between them.

Poses are camera-to-world, OpenCV axes (x right, y down, z forward). Times stay int64 microseconds until they are
subtracted to give the fraction of a keyframe interval.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ebarf_ns.errors import TrajectoryError
from ebarf_ns.geometry.so3 import quat_wxyz_exp, quat_wxyz_multiply, quat_wxyz_to_matrix, rotate, turn_between

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int64

Interpolation = Literal["linear", "cubic"]


class Poses(NamedTuple):
    """Camera-to-world poses."""

    position: Float[Tensor, "*batch 3"]
    quat_wxyz: Float[Tensor, "*batch 4"]

    def matrix(self) -> Float[Tensor, "*batch 3 4"]:
        """[R | t]."""
        return torch.cat([quat_wxyz_to_matrix(self.quat_wxyz), self.position[..., None]], dim=-1)

    def compose(self, local: Poses) -> Poses:
        """``self · local``: apply ``local`` in the frame of these poses."""
        return Poses(
            self.position + rotate(self.quat_wxyz, local.position),
            quat_wxyz_multiply(self.quat_wxyz, local.quat_wxyz),
        )


class Trajectory(NamedTuple):
    """Keyframe poses with strictly increasing times."""

    t_us: Int64[Tensor, "keyframes"]
    poses: Poses


def check_keyframes(t_us: Int64[Tensor, "keyframes"]) -> None:
    """Raise :class:`TrajectoryError` unless there are at least two keyframes with strictly increasing times."""
    if len(t_us) < 2:
        raise TrajectoryError(f"a trajectory needs at least 2 keyframes, got {len(t_us)}")
    late = torch.nonzero(t_us[1:] <= t_us[:-1])
    if len(late):
        k = int(late[0])
        raise TrajectoryError(
            f"keyframe {k + 1} is at {int(t_us[k + 1])} us, not after keyframe {k} at {int(t_us[k])} us"
        )


def densified(
    trajectory: Trajectory, longest_gap_us: int, kind: Interpolation
) -> tuple[Trajectory, Int64[Tensor, "given"]]:
    """Insert evenly spaced poses wherever two are further apart than ``longest_gap_us``; also returns the indices of
    the given poses.

    0 inserts none.
    """
    t_us = trajectory.t_us
    pieces = -(-t_us.diff() // longest_gap_us) if longest_gap_us else torch.ones_like(t_us[1:])
    given = torch.nn.functional.pad(pieces.cumsum(0), (1, 0))
    if int(given[-1]) == len(t_us) - 1:
        return trajectory, given
    left = torch.arange(len(pieces)).repeat_interleave(pieces)
    piece = torch.arange(len(left)) - given[left]
    inserted_t_us = torch.cat([t_us[left] + t_us.diff()[left] * piece // pieces[left], t_us[-1:]])
    poses = interpolate(t_us, trajectory.poses, inserted_t_us, kind)
    poses.position[given], poses.quat_wxyz[given] = trajectory.poses
    return Trajectory(inserted_t_us, poses), given


def corrected(keyframes: Poses, correction: Float[Tensor, "keyframes 6"]) -> Poses:
    """T · (exp(ω), υ): each keyframe moved in its own camera frame by ``correction = (ω [rad], υ [units])``."""
    return keyframes.compose(Poses(correction[..., 3:], quat_wxyz_exp(correction[..., :3])))


def within_span(t_us: Int64[Tensor, "*batch"], keyframe_t_us: Int64[Tensor, "keyframes"]) -> Bool[Tensor, "*batch"]:
    """Whether each time lies between the first and the last keyframe, inclusive."""
    return (t_us >= keyframe_t_us[0]) & (t_us <= keyframe_t_us[-1])


def intervals(
    keyframe_t_us: Int64[Tensor, "keyframes"], t_us: Int64[Tensor, "*batch"]
) -> tuple[Int64[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Index of the keyframe before each time, and the fraction of the way to the next one, float64.

    Times outside the span are clamped to it.
    """
    t_us = t_us.clamp(keyframe_t_us[0], keyframe_t_us[-1])
    left = (torch.searchsorted(keyframe_t_us, t_us, right=True) - 1).clamp(0, len(keyframe_t_us) - 2)
    interval_us = keyframe_t_us[left + 1] - keyframe_t_us[left]
    return left, (t_us - keyframe_t_us[left]).double() / interval_us.double()


def interpolate(
    keyframe_t_us: Int64[Tensor, "keyframes"],
    keyframes: Poses,
    t_us: Int64[Tensor, "*batch"],
    kind: Interpolation = "linear",
    delay_us: Float[Tensor, "*batch"] | None = None,
) -> Poses:
    """The poses at ``t_us``: SLERP of the rotations and LERP of the positions (Eq. 3), or cubic splines of both, with
    velocities continuous across keyframes.

    SLERP from a to b is a · exp(u · log(a⁻¹ b)): regular at a = ±b; at exactly half a turn, one of two arcs is taken.
    Times outside the span of the keyframes get the nearer end pose; callers drop them with :func:`within_span`.
    With ``delay_us``, the poses are those that much earlier, differentiable in the delay.
    """
    if delay_us is not None:
        whole_us = delay_us.detach().round()
        t_us = t_us - whole_us.to(t_us)
    left, exact_fraction = intervals(keyframe_t_us, t_us)
    u = exact_fraction.to(keyframes.position)[..., None]
    if delay_us is not None:
        u = u - ((delay_us - whole_us) / keyframe_t_us.diff()[left])[..., None].to(u)
    position, quat_wxyz = keyframes
    turn = turn_between(quat_wxyz[:-1], quat_wxyz[1:])
    change = torch.cat([turn, position[1:] - position[:-1]], dim=-1)
    bends = _bends(keyframe_t_us, change) if kind == "cubic" else ()
    # One lookup for all columns: each lookup costs a pass over the gradients of all times.
    columns = torch.cat([position[:-1], quat_wxyz[:-1], change, *bends], dim=-1)
    start, frame, change, *bends = columns[left].split([3, 4, 6, *(6 for _ in bends)], dim=-1)
    moved = u * change
    if bends:
        moved = moved + ((1 - u) ** 3 - (1 - u)) * bends[0] + (u**3 - u) * bends[1]
    return Poses(start + moved[..., 3:], quat_wxyz_multiply(frame, quat_wxyz_exp(moved[..., :3])))


def _bends(
    keyframe_t_us: Int64[Tensor, "keyframes"], change: Float[Tensor, "intervals 6"]
) -> tuple[Float[Tensor, "intervals 6"], Float[Tensor, "intervals 6"]]:
    """Second derivatives at the ends of each interval, divided by 6 and scaled by the squared interval, that turn the
    linear interpolation into splines.

    The rotation spline uses the body's angular velocity. It treats the frames of neighbouring keyframes as equal; the
    error is small, since the second derivative rotates little between keyframes. The second derivative is constant in
    the first and last interval: a natural spline, with zero at the ends, would distort a motion that is under way when
    the recording begins, and the end keyframes with it.
    """
    if len(change) < 2:
        return torch.zeros_like(change), torch.zeros_like(change)
    interval_s = (keyframe_t_us.diff().double() * 1e-6)[:, None]
    steps = torch.nn.functional.pad(6 * (change.double() / interval_s).diff(dim=0), (0, 0, 1, 1))
    solved: Tensor = _SolveTridiagonal.apply(interval_s, steps)  # pyright: ignore[reportAssignmentType]
    curvature = torch.cat([solved[1:2], solved[1:-1], solved[-2:-1]])
    first, last = ((interval_s**2 / 6 * end).to(change) for end in (curvature[:-1], curvature[1:]))
    return first, last


class _SolveTridiagonal(torch.autograd.Function):
    """Solves A x = b for the spline's symmetric tridiagonal A, in time linear in the number of keyframes."""

    @staticmethod
    def forward(ctx, interval_s: Tensor, right: Tensor) -> Tensor:
        ctx.interval_s = interval_s
        return _solve_spline_system(interval_s, right)

    @staticmethod
    def backward(ctx, *gradients: Tensor) -> tuple[None, Tensor]:
        return None, _solve_spline_system(ctx.interval_s, gradients[0])


def _solve_spline_system(interval_s: Tensor, right: Tensor) -> Tensor:
    """Second derivatives at all inner keyframes; the first and the last take those of their neighbours."""
    from scipy.linalg import solveh_banded

    interval = interval_s[:, 0].cpu().numpy()
    # The rows of these two are identities.
    upper_bands = np.zeros((2, len(interval) + 1))
    upper_bands[0, 2:-1] = interval[1:-1]
    upper_bands[1] = 1.0
    upper_bands[1, 1:-1] = 2 * (interval[1:] + interval[:-1])
    upper_bands[1, 1] += interval[0]
    upper_bands[1, -2] += interval[-1]
    # Non-finite gradients pass through; the trainer skips such steps.
    solution = solveh_banded(upper_bands, right.detach().cpu().numpy(), check_finite=False)
    return torch.from_numpy(solution).to(right)
