"""Timestamped keyframe poses, their corrections, and the pose of any moment between them.

Poses are camera-to-world, OpenCV axes (x right, y down, z forward). Times are int64 microseconds up to the one
subtraction that makes them a fraction of a keyframe interval.
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
    """Raise :class:`TrajectoryError` unless there are two keyframes or more, in strictly increasing time."""
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
    """The trajectory with poses inserted, evenly, wherever two are further apart than that; and where those given are.

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
    """Whether each time lies between the first and the last keyframe, both included."""
    return (t_us >= keyframe_t_us[0]) & (t_us <= keyframe_t_us[-1])


def intervals(
    keyframe_t_us: Int64[Tensor, "keyframes"], t_us: Int64[Tensor, "*batch"]
) -> tuple[Int64[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Between which keyframes each time lies: the left one's number, and the fraction of the way to the next, float64.

    Times outside the span count as the nearer end.
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
    """The poses at ``t_us``: SLERP of the rotations and LERP of the positions (Eq. 3), or both with velocities that
    run on through the keyframes, as cubic splines have them.

    SLERP from a to b is a · exp(u · log(a⁻¹ b)): regular where a = ±b; at exactly half a turn one of two arcs is taken.
    Times outside the span of the keyframes get the pose of the nearer end; callers drop them by :func:`within_span`.
    With ``delay_us``, poses are those so much earlier, and have a gradient to it.
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
    # Looked up together: every table that is looked up costs a pass over the gradients of all times.
    columns = torch.cat([position[:-1], quat_wxyz[:-1], change, *bends], dim=-1)
    start, frame, change, *bends = columns[left].split([3, 4, 6, *(6 for _ in bends)], dim=-1)
    moved = u * change
    if bends:
        moved = moved + ((1 - u) ** 3 - (1 - u)) * bends[0] + (u**3 - u) * bends[1]
    return Poses(start + moved[..., 3:], quat_wxyz_multiply(frame, quat_wxyz_exp(moved[..., :3])))


def _bends(
    keyframe_t_us: Int64[Tensor, "keyframes"], change: Float[Tensor, "intervals 6"]
) -> tuple[Float[Tensor, "intervals 6"], Float[Tensor, "intervals 6"]]:
    """Second derivatives at either end of each interval, over 6 and per interval squared, that make splines of lines.

    The rotations' spline is that of the body's angular velocity. It takes the frames of neighbouring keyframes for
    the same, which matters as little as the second derivative turns from one to the next. In the first and the last
    interval the second derivative is constant: zero at the ends, as of a natural spline, it would bend a motion that
    is under way when the recording begins, and the end keyframes with it.
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
    """x of A x = b for the symmetric tridiagonal A of the spline; linear in the number of keyframes."""

    @staticmethod
    def forward(ctx, interval_s: Tensor, right: Tensor) -> Tensor:
        ctx.interval_s = interval_s
        return _solve_spline_system(interval_s, right)

    @staticmethod
    def backward(ctx, *gradients: Tensor) -> tuple[None, Tensor]:
        return None, _solve_spline_system(ctx.interval_s, gradients[0])


def _solve_spline_system(interval_s: Tensor, right: Tensor) -> Tensor:
    """Second derivatives at all keyframes but the first and the last, which have those of their neighbours."""
    from scipy.linalg import solveh_banded

    interval = interval_s[:, 0].cpu().numpy()
    # The rows of those two stand for themselves.
    upper_bands = np.zeros((2, len(interval) + 1))
    upper_bands[0, 2:-1] = interval[1:-1]
    upper_bands[1] = 1.0
    upper_bands[1, 1:-1] = 2 * (interval[1:] + interval[:-1])
    upper_bands[1, 1] += interval[0]
    upper_bands[1, -2] += interval[-1]
    # A gradient that is not finite goes on its way to where such steps are skipped.
    solution = solveh_banded(upper_bands, right.detach().cpu().numpy(), check_finite=False)
    return torch.from_numpy(solution).to(right)
