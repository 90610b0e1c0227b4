"""Clock offset of a trajectory, estimated from its corrections or from the event rate."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, pi
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from scipy.stats import f as f_distribution

from ebarf_ns.geometry.so3 import quat_wxyz_conjugate, quat_wxyz_exp, quat_wxyz_multiply, rotate, turn_between
from ebarf_ns.geometry.trajectory import Interpolation, Poses, Trajectory, interpolate, within_span

if TYPE_CHECKING:
    from jaxtyping import Float, Int64
    from torch import Tensor

_MOST_SHARE = 0.25
_CANDIDATES = 33
_ROUNDS = 4
_GAUGE_STEPS = 2
_FEWEST = 5
_SIDE_US = 5_000
_CERTAIN, _LIKELY = 1e-4, 0.05
_BIN_US, _SMOOTH_BINS = 5_000, 3.0


@dataclass(frozen=True)
class ClockOffset:
    """Offset to add to a trajectory's times so that it fits the events."""

    offset_us: int
    deviation_us: float
    """Standard deviation of ``offset_us``."""
    moved_rad: float
    """RMS of the corrections that the offset explains."""
    by_chance: float
    """p-value: probability that chance explains as much of the corrections as the offset does."""

    @property
    def certain(self) -> bool:
        """Whether the offset is significant."""
        return self.by_chance < _CERTAIN

    @property
    def likely(self) -> bool:
        """Whether the offset is plausible enough for a second test."""
        return self.by_chance < _LIKELY


def clock_offset(
    given: Trajectory, found: Trajectory, translation: float = 1.0, kind: Interpolation = "linear"
) -> ClockOffset:
    """The time offset that brings ``given`` closest to ``found``.

    Corrections due to a clock offset are the velocity times the offset; other corrections are not proportional to
    velocity. The distance adds rotations in radians and positions times ``translation``, after removing a similarity of
    the world, which events do not constrain. Residuals are correlated between keyframes, so they have fewer degrees of
    freedom than values. The search covers offsets up to a quarter of the trajectory's span.
    """
    # The robust least-squares driver exists only on the CPU.
    given, found = (
        Trajectory(one.t_us.cpu(), Poses(*(column.cpu() for column in one.poses))) for one in (given, found)
    )
    if len(given.t_us) < _FEWEST:
        return ClockOffset(0, inf, 0.0, 1.0)
    most_us = _MOST_SHARE * float(given.t_us[-1] - given.t_us[0])
    centre, step = 0.0, 2 * most_us / (_CANDIDATES - 1)
    for _ in range(_ROUNDS):
        candidates = [centre + step * (k - _CANDIDATES // 2) for k in range(_CANDIDATES)]
        costs = [_distance(given, found, round(offset), translation, kind)[0] for offset in candidates]
        centre, step = candidates[min(range(len(costs)), key=costs.__getitem__)], 4 * step / _CANDIDATES
    offset_us = round(centre)
    before, _ = _distance(given, found, 0, translation, kind)
    after, numbers = _distance(given, found, offset_us, translation, kind)
    freedom = max(numbers - 1, 1.0)
    f_ratio = max(before / max(after, 1e-18) - 1, 0.0) * freedom
    # Curvature of the cost around the minimum.
    sides = (_distance(given, found, offset_us + side, translation, kind)[0] for side in (-_SIDE_US, _SIDE_US))
    growth = (sum(sides) / 2 - after) / _SIDE_US**2
    deviation_us = (after / (growth * freedom)) ** 0.5 if growth > 0 else inf
    moved_rad = max(before - after, 0.0) ** 0.5
    return ClockOffset(offset_us, deviation_us, moved_rad, float(f_distribution.sf(f_ratio, 1, freedom)))


def offset_by_activity(
    event_t_us: Int64[np.ndarray, "events"],
    given: Trajectory,
    bearings: Float[Tensor, "pixels 3"],
    kind: Interpolation = "linear",
) -> tuple[int, float, float]:
    """The offset at which the event rate correlates best with image speed, and the correlation of their logarithms at
    that offset and at zero.

    Accurate to some hundredths of a second, since the rate also depends on the scene. Events must lie in the span of
    ``given``; image motion is computed at unit distance along the camera's viewing directions ``bearings``.
    """
    first_us, last_us = (int(t_us) for t_us in given.t_us[[0, -1]])
    bins = max((last_us - first_us) // _BIN_US, 1)
    edges_us = first_us + _BIN_US * torch.arange(bins + 1, device=given.t_us.device)
    counts = np.bincount(np.clip((event_t_us - first_us) // _BIN_US, 0, bins - 1), minlength=bins)
    rate = np.log(gaussian_filter1d(counts.astype(float), _SMOOTH_BINS) + 1)
    poses = interpolate(given.t_us, given.poses, edges_us, kind)
    turn = turn_between(poses.quat_wxyz[:-1], poses.quat_wxyz[1:])[:, None].double()
    shift = rotate(quat_wxyz_conjugate(poses.quat_wxyz[:-1]), poses.position.diff(dim=0))[:, None].double()
    bearing = bearings[None].to(turn)
    across = shift - (shift * bearing).sum(dim=-1, keepdim=True) * bearing
    moved = (torch.linalg.cross(turn, bearing) + across).square().sum(dim=-1).mean(dim=-1).sqrt()
    speed = gaussian_filter1d(moved.cpu().numpy(), _SMOOTH_BINS)
    motion = np.log(speed + 1e-3 * speed.max() + 1e-12)
    most = int(_MOST_SHARE * bins)
    found = []
    for lag in range(-most, most + 1):
        seen, expected = rate[max(lag, 0) : bins + min(lag, 0)], motion[max(-lag, 0) : bins - max(lag, 0)]
        correlation = float(np.corrcoef(seen, expected)[0, 1]) if seen.std() > 0 and expected.std() > 0 else 0.0
        found.append((correlation, lag * _BIN_US))
    best, offset_us = max(found)
    return offset_us, best, found[most][0]


def _distance(
    given: Trajectory, found: Trajectory, offset_us: int, translation: float, kind: Interpolation
) -> tuple[float, float]:
    """Mean square of the residuals, and their number of degrees of freedom."""
    inside = within_span(found.t_us - offset_us, given.t_us)
    if int(inside.sum()) < _FEWEST:
        return inf, 0.0
    poses = interpolate(given.t_us, given.poses, found.t_us[inside] - offset_us, kind)
    residual = differences_less_similarity(poses, Poses(*(column[inside] for column in found.poses)), translation)
    power = float(residual.square().sum())
    rough = float(residual.diff(dim=0).square().sum()) / max(2 * power, 1e-30)
    share = residual.square().sum(dim=0) / max(power, 1e-30)
    channels = 1 / max(float(share.square().sum()), 1e-30)
    # Noise smoothed by a Gaussian has a share sqrt(rough / pi) of independent values.
    return power / len(residual), channels * (len(residual) * min((rough / pi) ** 0.5, 1.0) - 1)


def differences_less_similarity(some: Poses, others: Poses, translation: float = 1.0) -> Float[Tensor, "poses 6"]:
    """Rotation vectors from ``some`` to ``others`` in the world frame and shifts times ``translation``, after removing
    the best small similarity of the whole world. For uniform motion, a clock offset is such a similarity."""
    some, others = (Poses(*(column.double().cpu() for column in poses)) for poses in (some, others))
    centre = some.position.mean(dim=0)
    weight = torch.tensor([1.0] * 3 + [translation] * 3, dtype=torch.float64, device=centre.device)
    axes = torch.eye(3).to(centre).expand(len(some.position), 3, 3)
    for _ in range(_GAUGE_STEPS):
        position = some.position - centre
        about = torch.linalg.cross(axes, position[:, None].expand_as(axes))
        rows = torch.cat([torch.cat([axes, about], 2), torch.cat([torch.zeros_like(axes), axes], 2)], dim=1)
        larger = torch.cat([torch.zeros_like(position), position], dim=1)[:, None]
        columns = (weight[:, None] * torch.cat([rows, larger], dim=1).mT).flatten(0, 1)
        residual = weight * _displacement(some, others)
        # A static camera leaves the scale undetermined: gelsd handles rank deficiency.
        turn, shift, growth = (
            torch.linalg.lstsq(columns, residual.flatten()[:, None], driver="gelsd").solution[:, 0].split([3, 3, 1])
        )
        turned = quat_wxyz_exp(turn).expand_as(some.quat_wxyz)
        some = Poses(
            (1 + growth) * rotate(turned, position) + centre + shift, quat_wxyz_multiply(turned, some.quat_wxyz)
        )
    return weight * _displacement(some, others)


def _displacement(some: Poses, others: Poses) -> Float[Tensor, "poses 6"]:
    """Rotation vectors and shifts between poses, in the world frame."""
    turn = rotate(some.quat_wxyz, turn_between(some.quat_wxyz, others.quat_wxyz))
    return torch.cat([turn, others.position - some.position], dim=-1)
