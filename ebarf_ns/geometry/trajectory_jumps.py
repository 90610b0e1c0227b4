"""Discontinuities of a trajectory: relocalisations, outlier poses, two sessions in one file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from ebarf_ns.geometry.so3 import turn_between
from ebarf_ns.geometry.trajectory import Trajectory

if TYPE_CHECKING:
    from jaxtyping import Float

# A jump is this many times faster than the motion before, after, and at the median.
_FASTER = 8
# A jump in position exceeds this share of the extent of the middle 90 % of the keyframes ...
_SHARE = 0.15
# ... and a jump in rotation this angle.
_TURN_DEG = 10
_NEIGHBOURS = 3
_NAMED = 3
# More jumps than this share of the keyframes suggest two trajectories in one.
_MANY = 0.2


@dataclass(frozen=True)
class _Motion:
    """Distances between keyframes, in metres or degrees."""

    t_us: Float[np.ndarray, "keyframes"]
    values: torch.Tensor
    turning: bool

    def distance(self, start: np.ndarray, end: np.ndarray) -> Float[np.ndarray, "pairs"]:
        if self.turning:
            return np.degrees(turn_between(self.values[start], self.values[end]).norm(dim=-1).numpy())
        return (self.values[end] - self.values[start]).norm(dim=-1).numpy()

    def speed(self, start: np.ndarray, end: np.ndarray) -> Float[np.ndarray, "pairs"]:
        """Distance per second; NaN if a keyframe does not exist. Intervals are at least half the median."""
        last = len(self.t_us) - 1
        inside = (np.minimum(start, end) >= 0) & (np.maximum(start, end) <= last)
        start, end = start.clip(0, last), end.clip(0, last)
        apart_us = np.maximum(np.abs(self.t_us[end] - self.t_us[start]), 0.5 * np.median(np.diff(self.t_us)))
        return np.where(inside, self.distance(start, end) / (apart_us * 1e-6), np.nan)

    def least(self) -> float:
        """Smallest distance that counts as a jump."""
        if self.turning:
            return _TURN_DEG
        low, high = np.quantile(self.values.numpy(), [0.05, 0.95], axis=0)
        return _SHARE * float(np.linalg.norm(high - low))


def torn(trajectory: Trajectory) -> list[str]:
    """Sentences that name implausible jumps between keyframes; empty for a continuous motion."""
    t_us = trajectory.t_us.numpy().astype(float)
    if len(t_us) < 5:
        return []
    position, quat_wxyz = (column.double().cpu() for column in trajectory.poses)
    return _sentences(_Motion(t_us, position, False)) + _sentences(_Motion(t_us, quat_wxyz, True))


def _sentences(motion: _Motion) -> list[str]:
    outliers, jumps, usual = _found(motion)
    verb, unit = ("turns", " deg") if motion.turning else ("moves", "")
    t_us = motion.t_us
    sentences = []
    for k in outliers[:_NAMED]:
        away = float(motion.distance(np.array([k - 1]), np.array([k]))[0])
        sentences.append(
            f"keyframe {k}, at {t_us[k] * 1e-6:.3f} s, is {away:.3g}{unit} from keyframes {k - 1} and {k + 1}, which "
            "are close to each other: an outlier? Leave it out of the trajectory"
        )
    if len(outliers) > _NAMED:
        sentences[-1] += f", and {len(outliers) - _NAMED} more like it"
    many = len(jumps) > _MANY * len(t_us)
    for k in jumps[: 1 if many else _NAMED]:
        moved = float(motion.distance(np.array([k]), np.array([k + 1]))[0])
        times = moved / max(usual * (t_us[k + 1] - t_us[k]) * 1e-6, 1e-12)
        sentences.append(
            f"between keyframes {k} and {k + 1} ({(t_us[k + 1] - t_us[k]) / 1000:.3g} ms, at {t_us[k] * 1e-6:.3f} s) "
            f"the camera {verb} {moved:.3g}{unit}, {min(times, 1e6):.0f} times the median"
        )
    if many:
        sentences[-1] += f", and {len(jumps) - 1} more such jumps: two sessions in one trajectory? Give one of them"
    elif jumps:
        more = f" (and {len(jumps) - _NAMED} more)" if len(jumps) > _NAMED else ""
        sentences[-1] += (
            f"{more}: a jump of the odometry? Take one side of it: ebarf process has --start-us and --end-us"
        )
    return sentences


def _found(motion: _Motion) -> tuple[list[int], list[int], float]:
    """Outlier keyframes, intervals with jumps, and the median speed."""
    every = np.arange(len(motion.t_us))
    # The lowest speed towards any of several keyframes after and before each.
    steps = range(1, _NEIGHBOURS + 1)
    with np.errstate(all="ignore"):
        after = np.fmin.reduce([motion.speed(every, every + step) for step in steps])
        before = np.fmin.reduce([motion.speed(every - step, every) for step in steps])
        usual = max(float(np.nanmedian(after)), 1e-12)
        start, end = every[:-1], every[1:]
        speed, moved = motion.speed(start, end), motion.distance(start, end)
        around = np.fmax(np.fmax(before[:-1], after[1:]), usual)
        jump = (speed > _FASTER * around) & (moved > motion.least())
        middle = every[1:-1]
        past = np.fmax(motion.speed(middle - 1, middle + 1), float(np.median(speed)))
        away = np.minimum(speed[:-1], speed[1:]) > _FASTER * past
        outlier = away & (np.minimum(moved[:-1], moved[1:]) > motion.least())
    jumps = np.flatnonzero(jump)
    # A single displaced pose is an outlier; a displacement that later poses share is a jump.
    alone = np.flatnonzero(outlier) + 1
    alone = alone[~np.isin(alone, jumps) & ~np.isin(alone - 1, jumps)]
    crossing = np.isin(alone - 1, alone) | np.isin(alone + 1, alone)
    return alone[~crossing].tolist(), sorted({*jumps.tolist(), *(alone[crossing] - 1).tolist()}), usual
