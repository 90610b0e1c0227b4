"""Trajectories as text: columns named in a header line, or in the layout of TUM or KITTI."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import get_args

import numpy as np

from ebarf_ns.errors import TrajectoryError
from ebarf_ns.formats.raw_poses import (
    Quaternion,
    RawPoses,
    TimeUnit,
    TrajectoryFormat,
    moving,
    number,
    times_beside,
)

_TIME = re.compile(r"(?:^|_)(?:t|ts|time|times|timestamps?|stamp)(?:_(?:n|u|m|nano|micro|milli)?s(?:ecs?|econds?)?)?$")
_SECONDS = re.compile(r"(?:^|_)(?:time|timestamp|stamp)_s(?:ecs?|econds)?$")
_NANOSECONDS = re.compile(r"(?:^|_)(?:time|timestamp|stamp)_n(?:ano)?s(?:ecs?|econds?|ec)?$")
_POSITION = re.compile(r"(?:^|_)(?:p|pos|position|t|trans|translation|location)(?:_\w+)*?_?([xyz])(?:_m)?$|^([xyz])$")
_ROTATION = re.compile(r"(?:^|_)(?:q|quat|quaternion|orient|orientation|rot|rotation|attitude)(?:_\w+)*?_?([wxyz])$")
_UNITS: dict[TimeUnit, str] = {
    "ns": "ns|nsecs?|nanos?|nanosec|nanoseconds?",
    "us": "us|µs|usecs?|micros?|microseconds?",
    "ms": "ms|msecs?|millis?|milliseconds?",
    "s": "s|secs?|seconds?",
}
# Numbers of columns that may include a line counter in front.
_COUNTED = (9, 14, 18)


@dataclass(frozen=True)
class _Table:
    """Rows of fields and their line numbers."""

    rows: list[list[str]]
    lines: list[int]
    header: list[str]
    """Comments and header lines above the first row."""


@dataclass(frozen=True)
class _Columns:
    """Column indices of a pose."""

    time: int
    nanoseconds: int | None
    """For times in two columns."""
    position: list[int]
    rotation: list[int]
    order: Quaternion
    unit: TimeUnit | None
    others: list[str]
    """Names of unused columns."""


def read_text(path: Path, lines: list[str], known: TrajectoryFormat) -> RawPoses:
    """Read named columns, TUM's eight, KITTI's twelve, or 4x4 matrices, with or without a time in front."""
    table = _table(path, lines)
    columns = _named(path, table)
    return _of_names(path, table, columns) if columns else _of_numbers(path, table, known)


def _table(path: Path, lines: list[str]) -> _Table:
    rows: list[list[str]] = []
    numbers: list[int] = []
    header: list[str] = []
    named = False
    for line_number, line in enumerate(lines, start=1):
        comment = line.lstrip().startswith(("%", "//"))
        fields = [] if comment else _fields(line.split("#")[0])
        if not fields:
            header += [] if rows else [line.strip().lstrip("#%/").strip()]
        elif not rows and not named and not any(map(_begun, fields)):
            header, named = [*header, line.strip()], True
        else:
            rows.append(fields)
            numbers.append(line_number)
    if not rows:
        raise TrajectoryError(f"{path}: holds no poses")
    counts = [len(fields) for fields in rows]
    usual = Counter(counts).most_common(1)[0][0]
    for line_number, count in zip(numbers, counts, strict=True):
        if count != usual:
            where = "in the other lines" if line_number == numbers[0] else "before"
            raise TrajectoryError(f"{path}:{line_number}: {count} columns, expected {usual} as {where}")
    return _Table(rows, numbers, header)


def _fields(text: str) -> list[str]:
    """Split at commas or semicolons, keeping empty fields, or at spaces."""
    text = text.strip()
    for separator in (";", ","):
        if separator in text:
            fields = [field.strip().strip("\"'") for field in text.split(separator)]
            if not any(len(field.split()) > 1 for field in fields):
                # Ignore a trailing separator.
                return fields[:-1] if not fields[-1] else fields
    return text.replace(",", " ").replace(";", " ").split()


def _begun(field: str) -> bool:
    """Whether a field is a number or begins like one; names begin with letters."""
    try:
        Decimal(field)
    except InvalidOperation:
        return re.match(r"[-+.]?\d", field) is not None
    return True


def _named(path: Path, table: _Table) -> _Columns | None:
    """Columns from the last header line that names them; None without one."""
    for line in reversed(table.header):
        units = [(match.start(), match.group(1)) for match in re.finditer(r"[\[(]([^\])]*)[\])]", line)]
        bare = re.sub(r"[\[(][^\])]*[\])]", lambda match: " " * len(match.group()), line)
        separator = next((one for one in (";", ",") if one in bare), None)
        names = [field.strip().strip("\"'") for field in bare.split(separator)]
        if separator and not names[-1]:
            names = names[:-1]
        if len(names) < len(table.rows[0]):
            continue
        names = names[-len(table.rows[0]) :]
        columns = _columns(path, names, units[0][1] if units else "")
        if columns:
            return columns
    return None


def _columns(path: Path, names: list[str], unit: str) -> _Columns | None:
    """Columns of time, position and quaternion; None if the names do not identify them."""
    clean = [re.sub(r"[^a-zµ0-9]+", "_", name.lower()).strip("_") for name in names]
    position = {axis: _matching(clean, _POSITION, axis) for axis in "xyz"}
    rotation = {axis: _matching(clean, _ROTATION, axis) for axis in "wxyz"}
    nanoseconds = [k for k, name in enumerate(clean) if _NANOSECONDS.search(name)]
    seconds = [k for k, name in enumerate(clean) if _SECONDS.search(name)]
    paired = len(nanoseconds) == 1 and len(seconds) == 1
    times = seconds if paired else [k for k, name in enumerate(clean) if _TIME.search(name)]
    # Prefer a message's own stamp to its recording time.
    times = [k for k in times if "stamp" in clean[k] and len(times) > 1] or times
    found = [times, *position.values(), *rotation.values()]
    if not all(found):
        return None
    for columns in found:
        if len(columns) > 1:
            several = " and ".join(names[k] for k in columns)
            raise TrajectoryError(f"{path}: columns {several} mean the same, expected one pose per line")
    in_file = "".join(sorted(rotation, key=lambda axis: rotation[axis][0]))
    order: Quaternion = next((one for one in get_args(Quaternion) if one == in_file), "xyzw")
    used = [columns[0] for columns in found] + (nanoseconds if paired else [])
    return _Columns(
        time=times[0],
        nanoseconds=nanoseconds[0] if paired else None,
        position=[position[axis][0] for axis in "xyz"],
        rotation=[rotation[axis][0] for axis in order],
        order=order,
        unit="s" if paired else _unit(unit) or _unit(clean[times[0]].rsplit("_", 1)[-1]),
        others=[name or "one without a name" for k, name in enumerate(names) if k not in used],
    )


def _matching(names: list[str], pattern: re.Pattern[str], axis: str) -> list[int]:
    found = [(k, match) for k, name in enumerate(names) if (match := pattern.search(name))]
    return [k for k, match in found if axis in match.groups()]


def _unit(text: str) -> TimeUnit | None:
    return next((unit for unit, names in _UNITS.items() if re.fullmatch(names, text.strip().lower())), None)


def _of_names(path: Path, table: _Table, columns: _Columns) -> RawPoses:
    used = [columns.time, *columns.position, *columns.rotation]
    rows = _numbers(path, table, used)
    times = [row[0] for row in rows]
    if columns.nanoseconds is not None:
        parts = _numbers(path, table, [columns.nanoseconds])
        times = [time + part * Decimal("1e-9") for time, (part,) in zip(times, parts, strict=True)]
    notes = []
    if columns.others:
        some = ", ".join(columns.others[:3]) + (", ..." if len(columns.others) > 3 else "")
        one = len(columns.others) == 1
        notes = [f"{path.name}: left out: {len(columns.others)} other column{'' if one else 's'} ({some})"]
    plain = used == list(range(8)) and not columns.others
    numbers = np.array([row[1:] for row in rows], float)
    places = _places(path, table)
    return RawPoses(
        "TUM text" if plain else "text with names of columns",
        times,
        numbers[:, :3],
        numbers[:, 3:],
        columns.order,
        time_unit=columns.unit,
        pointed=any("." in row[columns.time] for row in table.rows),
        places=places,
        notes=tuple(notes),
    )


def _of_numbers(path: Path, table: _Table, known: TrajectoryFormat) -> RawPoses:
    rows = _numbers(path, table, list(range(len(table.rows[0]))))
    places = _places(path, table)
    notes: tuple[str, ...] = ()
    count = len(rows[0])
    if count in _COUNTED and _counts(rows):
        rows, count = [row[1:] for row in rows], count - 1
        notes = (f"{path.name}: left out: the first column, which counts the lines",)
    if count == 8:
        return _tum(path, table, rows, places, notes)
    if count in (12, 13, 16, 17):
        timed = count in (13, 17)
        numbers = np.array([row[timed:] for row in rows], float).reshape(len(rows), -1, 4)
        # With --pose-times, a counter in the first column is a frame number, not a time.
        numbered = timed and known.pose_times is not None and _counts(rows)
        own = timed and not numbered
        times = [row[0] for row in rows] if own else times_beside(path, len(rows), None, known)
        notes += (f"{path.name}: left out: the first column, which counts the lines",) if numbered else ()
        position, rotation = moving(path, numbers, places)
        unit = _unit_above(table)
        return RawPoses("matrices", times, position, rotation, time_unit=unit, places=places, notes=notes)
    raise TrajectoryError(
        f"{path}: {count} columns, expected 8 (TUM), or 12 or 16 (matrices) with or without a time, or a line that "
        "names them above"
    )


def _numbers(path: Path, table: _Table, columns: list[int]) -> list[list[Decimal]]:
    rows = []
    for fields, line in zip(table.rows, table.lines, strict=True):
        values = [number(fields[k]) for k in columns]
        row = [value for value in values if value is not None]
        if len(row) < len(values):
            wrong = fields[columns[values.index(None)]]
            said = " ".join(fields)
            raise TrajectoryError(f"{path}:{line}: {wrong!r:.40} in {said!r:.60} is not a number, expected a pose")
        rows.append(row)
    return rows


def _places(path: Path, table: _Table) -> tuple[str, ...]:
    return tuple(f"{path}:{line}" for line in table.lines)


def _counts(rows: list[list[Decimal]]) -> bool:
    """Whether the first column counts the rows, starting at any number."""
    numbers = [row[0] for row in rows]
    return all(value == numbers[0] + k for k, value in enumerate(numbers))


def _tum(
    path: Path, table: _Table, rows: list[list[Decimal]], places: tuple[str, ...], notes: tuple[str, ...]
) -> RawPoses:
    numbers = np.array([row[1:] for row in rows], float)
    # "qx qy qz qw", or EuRoC's "q_RS_w [], q_RS_x [], ...", anywhere in the header.
    order = "".join(re.findall(r"\bq\w*?([wxyz])\b", "\n".join(table.header).lower()))
    said: Quaternion | None = next((one for one in get_args(Quaternion) if one == order), None)
    pointed = any("." in row[len(row) - 8] for row in table.rows)
    times, unit = [row[0] for row in rows], _unit_above(table)
    return RawPoses("TUM text", times, numbers[:, :3], numbers[:, 3:], said, "camera-to-world", "opencv", unit,
                    pointed, places, notes)  # fmt: skip


def _unit_above(table: _Table) -> TimeUnit | None:
    """Unit from a header such as "[ns]"."""
    header = "\n".join(table.header).lower()
    return next((unit for unit, names in _UNITS.items() if re.search(rf"\[(?:{names})\]", header)), None)
