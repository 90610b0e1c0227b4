"""Trajectories on disk: TUM text, ``timestamp[s] tx ty tz qx qy qz qw``, one pose per line; ``#`` starts a comment."""

from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path

import torch

from ebarf_ns.errors import TrajectoryError, did_you_mean
from ebarf_ns.files import whole_file
from ebarf_ns.geometry.trajectory import Poses, Trajectory, check_keyframes

_COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
_LARGEST = 1e30
# Quaternions are written with 6 digits or more; a larger deviation from unit length is not rounding.
_QUATERNION_TOLERANCE = 1e-3


def read_tum(path: Path) -> Trajectory:
    """Read a TUM file into float64 poses; raises :class:`TrajectoryError` naming file, line, value and expectation."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise TrajectoryError(f"{path}: cannot be read as text ({reason}){did_you_mean(path)}") from None
    times_us: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        fields = line.split("#")[0].replace(",", " ").split()
        if fields:
            t_us, row = _parse_pose(f"{path}:{number}", fields)
            if times_us and t_us <= times_us[-1]:
                raise TrajectoryError(
                    f"{path}:{number}: timestamp {fields[0]} is not after the one before it "
                    f"({times_us[-1]} us); keyframe times must increase"
                )
            times_us.append(t_us)
            rows.append(row)
    t_us = torch.tensor(times_us, dtype=torch.int64)
    try:
        check_keyframes(t_us)
    except TrajectoryError as error:
        raise TrajectoryError(f"{path}: {error}") from None
    values = torch.tensor(rows, dtype=torch.float64)
    quat_wxyz = values[:, [6, 3, 4, 5]]
    return Trajectory(t_us, Poses(values[:, :3], quat_wxyz / quat_wxyz.norm(dim=-1, keepdim=True)))


def _parse_pose(place: str, fields: list[str]) -> tuple[int, list[float]]:
    if len(fields) != len(_COLUMNS):
        raise TrajectoryError(f"{place}: {len(fields)} columns, expected the 8 of TUM format: {' '.join(_COLUMNS)}")
    row: list[float] = []
    for name, text in zip(_COLUMNS, fields, strict=True):
        try:
            value = float(text)
        except ValueError:
            raise TrajectoryError(f"{place}: {name} is {text!r}, expected a number") from None
        if not abs(value) < _LARGEST:
            raise TrajectoryError(f"{place}: {name} is {text}, expected a finite number")
        row.append(value)
    # A float has no room for microseconds since 1970.
    t_us = int((Decimal(fields[0]) * 1_000_000).to_integral_value())
    if abs(t_us) >= 1 << 62:
        raise TrajectoryError(f"{place}: timestamp {fields[0]} does not fit 64-bit microseconds, expected seconds")
    row = row[1:]
    length = sum(q * q for q in row[3:]) ** 0.5
    if abs(length - 1) > _QUATERNION_TOLERANCE:
        raise TrajectoryError(
            f"{place}: quaternion qx qy qz qw = {' '.join(fields[4:])} has length {length:.6g}, expected 1"
        )
    return t_us, row


def write_tum(path: Path, trajectory: Trajectory, comments: Sequence[str] = ()) -> None:
    """Write poses as TUM text with times to the microsecond, preceded by one line per comment."""
    lines = [f"# {comment}" for comment in (*comments, "timestamp[s] tx ty tz qx qy qz qw")]
    position, quat_wxyz = trajectory.poses.position.double(), trajectory.poses.quat_wxyz.double()
    for t_us, p, (w, *xyz) in zip(trajectory.t_us.tolist(), position.tolist(), quat_wxyz.tolist(), strict=True):
        numbers = " ".join(f"{value:.9f}" for value in (*p, *xyz, w))
        lines.append(f"{format_seconds(t_us)} {numbers}")
    with whole_file(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def format_seconds(t_us: int) -> str:
    """Microseconds as decimal seconds, exactly."""
    sign = "-" if t_us < 0 else ""
    return f"{sign}{abs(t_us) // 1_000_000}.{abs(t_us) % 1_000_000:06d}"
