"""Trajectories as text: columns named in a header line, or in the layout of TUM or KITTI."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from ebarf_ns.errors import TrajectoryError
from ebarf_ns.formats.raw_poses import (
    RawPoses,
    TrajectoryFormat,
    moving,
    number,
    times_beside,
)
from ebarf_ns.formats.trajectory_columns import (
    Columns,
    Header,
    named_columns,
    order_above,
    transform_above,
    unit_above,
)

# Numbers of columns that may include a line counter in front.
_COUNTED = (9, 14, 18)
# Numbers of a pose without a time.
_FEWEST = 7


@dataclass(frozen=True)
class _Table:
    """Rows of fields and their line numbers."""

    rows: list[list[str]]
    lines: list[int]
    header: Header


def read_text(path: Path, lines: list[str], known: TrajectoryFormat) -> RawPoses:
    """Read named columns, TUM's eight, KITTI's twelve, or 4x4 matrices, with or without a time in front."""
    table = _table(path, lines)
    columns = named_columns(path, table.header, len(table.rows[0]))
    raw = _of_names(path, table, columns) if columns else _of_numbers(path, table, known)
    if not raw.order_told:
        order, unclear = order_above(table.header)
        notes = (
            (*raw.notes, f"{path.name}: quaternions {order}, as the lines above the poses say") if order else raw.notes
        )
        raw = replace(raw, quaternion=order, unclear=unclear or raw.unclear, notes=notes)
    transform = None if known.transform else transform_above(path, table.header)
    if not transform:
        return raw
    said = f"{path.name}: {transform}, as its comments say; --transform says otherwise"
    return replace(raw, transform=transform, notes=(*raw.notes, said))


def _table(path: Path, lines: list[str]) -> _Table:
    rows: list[list[str]] = []
    numbers: list[int] = []
    comments: list[str] = []
    names: str | None = None
    for line_number, line in enumerate(lines, start=1):
        comment = line.lstrip().startswith(("%", "//"))
        fields = [] if comment else _fields(line.split("#")[0])
        if not fields:
            comments += [] if rows else [line.strip().lstrip("#%/").strip()]
        elif not rows and names is None and not any(map(_begun, fields)):
            names = line.strip()
        else:
            rows.append(fields)
            numbers.append(line_number)
    if not rows:
        raise TrajectoryError(f"{path}: holds no poses")
    first = lines[numbers[0] - 1].split()
    if len(first) >= _FEWEST and all(re.fullmatch(r"[-+]?\d+,\d+", field) for field in first):
        raise TrajectoryError(f"{path}:{numbers[0]}: {first[0]} has a decimal comma, expected decimal points")
    counts = [len(fields) for fields in rows]
    usual = Counter(counts).most_common(1)[0][0]
    for line_number, count in zip(numbers, counts, strict=True):
        if count != usual:
            where = "in the other lines" if line_number == numbers[0] else "before"
            raise TrajectoryError(f"{path}:{line_number}: {count} columns, expected {usual} as {where}")
    return _Table(rows, numbers, Header(comments, names))


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


def _of_names(path: Path, table: _Table, columns: Columns) -> RawPoses:
    used = [columns.time, *columns.position, *columns.rotation]
    rows = _numbers(path, table, used)
    times = [row[0] for row in rows]
    if columns.nanoseconds is not None:
        parts = _numbers(path, table, [columns.nanoseconds])
        times = [time + part * Decimal("1e-9") for time, (part,) in zip(times, parts, strict=True)]
    notes = [f"{path.name}: times from the column {columns.left}, the only one left"] if columns.left else []
    if columns.others:
        some = ", ".join(columns.others[:3]) + (", ..." if len(columns.others) > 3 else "")
        one = len(columns.others) == 1
        notes += [f"{path.name}: left out: {len(columns.others)} other column{'' if one else 's'} ({some})"]
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
        unclear=columns.unclear,
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
        unit = unit_above(table.header)
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
    pointed = any("." in row[len(row) - 8] for row in table.rows)
    times, unit = [row[0] for row in rows], unit_above(table.header)
    return RawPoses("TUM text", times, numbers[:, :3], numbers[:, 3:], None, "camera-to-world", "opencv", unit,
                    pointed, places, notes)  # fmt: skip
