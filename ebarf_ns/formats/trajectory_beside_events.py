"""Checks that a trajectory and a recording belong together: time units and overlap."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from pathlib import Path
from typing import Any

import h5py
import torch

from ebarf_ns.errors import RecordingError, TrajectoryError
from ebarf_ns.formats.source import DECIMALS, Source, TimeUnit
from ebarf_ns.geometry.trajectory import Poses, Trajectory, within_span
from ebarf_ns.scene import events_left_out

# A trajectory this many times longer than its recording, with fewer than two poses in it, has another time unit.
_LONGEST_SPAN_RATIO = 100
_FEW_KEYFRAMES, _SHORT_SHARE, _MUCH_LONGER = 4, 0.5, 500


def doubts(source: Source, span_us: tuple[int, int], trajectory: Trajectory, offset_us: int) -> list[str]:
    """Doubts about a guessed event time unit, given the trajectory; raises an error if another unit fits."""
    unit = source.guessed_unit
    if unit is None or _beside(span_us, trajectory):
        return []
    units: tuple[TimeUnit, ...] = ("s", "ms", "us", "ns")
    others = []
    for other in units:
        factor = 10.0 ** (DECIMALS[other] - DECIMALS[unit])
        scaled = tuple(round((t_us - offset_us) * factor) + offset_us for t_us in span_us)
        if other != unit and _beside(scaled, trajectory):
            others.append(f"{other} ({(scaled[1] - scaled[0]) * 1e-6:.3f} s)")
    seconds, of_poses = (span_us[1] - span_us[0]) * 1e-6, int(trajectory.t_us[-1] - trajectory.t_us[0]) * 1e-6
    doubt = f"events over {seconds:.6f} s, if their times are in {unit}, beside a trajectory over {of_poses:.3f} s"
    if others:
        raise RecordingError(
            f"{source.path}: {doubt}; expected --event-time-unit with {' or '.join(others)}, or {unit} if it is right, "
            "or another --pose-time-unit"
        )
    return [f"suspicious: {doubt}; --event-time-unit sets another unit"]


def _beside(span_us: tuple[int, ...], trajectory: Trajectory) -> bool:
    """Whether events and trajectory overlap, have comparable durations (within a factor of 500), and the events are not
    shorter than half the keyframe spacing."""
    first_us, last_us = int(trajectory.t_us[0]), int(trajectory.t_us[-1])
    if min(span_us[1], last_us) <= max(span_us[0], first_us):
        return False
    length_us = span_us[1] - span_us[0]
    alike = last_us - first_us < _MUCH_LONGER * length_us and length_us < _MUCH_LONGER * (last_us - first_us)
    short = length_us < _SHORT_SHARE * float(trajectory.t_us.diff().double().median())
    return alike and not (short and len(trajectory.t_us) >= _FEW_KEYFRAMES)


def clipped(trajectory: Trajectory, span_us: tuple[int, int], path: Path) -> Trajectory:
    """The poses within the span of the events, plus one at either end."""
    first, last = torch.searchsorted(trajectory.t_us, torch.tensor(span_us)).tolist()
    chosen = slice(max(first - 1, 0), last + 1)
    clipped = Trajectory(trajectory.t_us[chosen], Poses(*(column[chosen] for column in trajectory.poses)))
    if len(clipped.t_us) < 2:
        raise TrajectoryError(
            f"{path}: poses from {trajectory.t_us[0]} to {trajectory.t_us[-1]} us, but events from {span_us[0]} to "
            f"{span_us[1]} us; expected at least 2 poses around the events, on the same clock"
        )
    return clipped


def outside(events: Path, trajectory: Trajectory) -> list[str]:
    """Note on the share of a scene's events before the first pose and after the last one, if it is large."""
    with h5py.File(events, "r") as file:
        t_us: Any = file["events/t"]
        offset_us: Any = file["t_offset"]
        first_us, last_us = (trajectory.t_us[[0, -1]] - int(offset_us[()])).tolist()
        first, last = bisect_left(t_us, first_us), bisect_right(t_us, last_us)
        found = events_left_out(len(t_us) - (last - first), len(t_us))
    return [f"suspicious: {sentence}" for sentence in found]


def apart(trajectory: Trajectory, span_us: tuple[int, int], path: Path, intended: bool) -> list[str]:
    """Note if all events lie between two poses; raises :class:`TrajectoryError` unless this is ``intended``."""
    t_us, events_s = trajectory.t_us, (span_us[1] - span_us[0]) * 1e-6
    among = int(within_span(t_us, torch.tensor(span_us)).sum())
    poses_s = float(t_us[-1] - t_us[0]) * 1e-6
    if among >= 2 or not bool(within_span(torch.tensor(span_us), t_us).any()):
        return []
    said = f"{path}: the {len(t_us)} poses span {poses_s:g} s, with {among} of them among the events, which span "
    if poses_s > _LONGEST_SPAN_RATIO * events_s and not intended:
        raise TrajectoryError(f"{said}{events_s:g} s; expected one unit of time: --event-time-unit or --pose-time-unit")
    return [f"{said}{events_s:g} s: times in another unit? (--event-time-unit, --pose-time-unit)"]
