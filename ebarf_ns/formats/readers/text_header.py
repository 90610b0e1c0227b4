"""Columns, units and sensor size of events as text, from the first lines of the file."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ebarf_ns.errors import RecordingError
from ebarf_ns.formats.columns import (
    ROLES,
    UNITS,
    coarseness,
    contradicting_order,
    guessed_unit,
    inferred_order,
    spaced,
    stated_unit,
)
from ebarf_ns.formats.source import TimeUnit

TIME, X, Y, POLARITY = range(4)
UNUSED = -1
WORDS = {"true": "1", "on": "1", "false": "0", "off": "0"}
"""Polarities as words."""
_ROLES = {
    "t": TIME, "ts": TIME, "time": TIME, "times": TIME, "timestamp": TIME, "timestamps": TIME, "x": X, "xs": X,
    "y": Y, "ys": Y, "p": POLARITY, "ps": POLARITY, "pol": POLARITY, "polarity": POLARITY, "polarities": POLARITY,
    "on": POLARITY,
}  # fmt: skip


class Layout(NamedTuple):
    """What the first lines of a file tell of its rows."""

    roles: tuple[int, ...]
    """Role of each column."""
    unit: TimeUnit
    guessed: bool
    """Whether the unit was only guessed from the first times."""
    doubtful: bool
    """Whether the trajectory may contradict the unit, since it was guessed or is from a comment."""
    sensor_size: tuple[int, int] | None
    header_lines: int
    order: str
    """Order of columns that no header names, one letter each."""
    words: bool
    """Whether polarities are words."""
    notes: tuple[str, ...]


class _Line(NamedTuple):
    number: int
    fields: list[str]
    comment: str
    """The comment of a line that has nothing else."""
    words: bool


def layout_of(path: Path, time_unit: TimeUnit | None, columns: str | None) -> Layout:
    """Infer the layout from the first lines; raises :class:`RecordingError`."""
    size, roles = None, None
    unit: TimeUnit | None = None
    lines = list(_first_lines(path))
    for place, line in enumerate(lines):
        if not line.fields:
            continue
        numeric = [decimal(field) for field in line.fields]
        if None in numeric and roles is None:
            roles, unit = _named_columns(path, line, time_unit)
            continue
        if len(numeric) == 2 and size is None and None not in numeric:
            size = int(numeric[0] or 0), int(numeric[1] or 0)
            continue
        rows = [later.fields for later in lines[place:] if later.fields]
        comments = [before for before in lines[:place] if before.comment]
        order, notes, remarked = "", (), None
        if roles is None and not columns:
            roles, remarked, order, notes = _named_in_comment(path, comments, rows)
        if roles is None:
            order, notes = _inferred_order(path, rows, columns)
            roles = tuple(ROLES.index(role) for role in order)
        for comment in comments:
            remarked = remarked or stated_unit(comment.comment)
        column = roles.index(TIME)
        times = [fields[column] for fields in rows if column < len(fields)]
        stated = time_unit or unit
        if remarked and not stated:
            notes += (f"times in {remarked}, as a comment says",)
        taken: TimeUnit = stated or remarked or _guessed(times)
        words = any(later.words for later in lines[place:])
        notes += ("polarity True or ON is read as 1, False or OFF as 0",) if words else ()
        numbers = [number for number in map(decimal, times) if number is not None]
        notes += tuple(coarseness(np.array(numbers, float), taken))
        guessed = not stated and not remarked
        return Layout(roles, taken, guessed, not stated, size, line.number - 1, order, words, notes)
    raise RecordingError(f"{path}: holds no events, expected lines 't[s] x y p'")


def decimal(text: str) -> Decimal | None:
    """The finite number that a text is, if it is one."""
    try:
        number = Decimal(text)
    except InvalidOperation:
        return None
    return number if number.is_finite() else None


def _first_lines(path: Path) -> Iterator[_Line]:
    try:
        with path.open("rb") as file:
            for number in range(1, 1000):
                line = file.readline(1 << 16)
                if not line:
                    return
                whole = line.decode("utf-8-sig", errors="replace").replace('"', "")
                text, comment = [*re.split("#|%|//", whole, maxsplit=1), ""][:2]
                fields = _split(text)
                if any(decimal(field) is not None for field in fields):
                    numbers = [WORDS.get(field.lower(), field) for field in fields]
                    yield _Line(number, numbers, "", numbers != fields)
                elif fields:
                    # A table's index has no name.
                    unnamed = [""] * (text.lstrip(" \t")[:1] in (",", ";"))
                    yield _Line(number, unnamed + fields, "", False)
                elif comment.strip():
                    yield _Line(number, [], comment.strip(), False)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from None


def _split(text: str) -> list[str]:
    """Fields of a line, with a unit joined to its name: "time (us)"."""
    joined = re.sub(r"\s+(?=[\[(][^\s,;]+[\])])", "", text.strip(" \t\r\n,;"))
    return re.split(r"[\s,;]+", joined) if joined else []


def _named_columns(path: Path, line: _Line, time_unit: TimeUnit | None) -> tuple[tuple[int, ...], TimeUnit | None]:
    roles, unit, of = _roles(line.fields)
    if time_unit is None and unit is None and of:
        expected = f"one of {', '.join(UNITS)}, or --event-time-unit"
        raise RecordingError(f"{path}:{line.number}: times in {of!r:.20}, expected {expected}")
    if not _complete(roles):
        fields = " ".join(line.fields)
        raise RecordingError(f"{path}:{line.number}: columns {fields!r:.60}, expected t, x, y and p once each")
    return roles, time_unit or unit


def _roles(fields: Sequence[str]) -> tuple[tuple[int, ...], TimeUnit | None, str]:
    """Roles of columns by their names, the unit of the times, and that unit as written if it is in brackets."""
    roles, unit, written = [], None, ""
    for field in fields:
        name, _, of = field.lower().strip("\"'").replace("[", "_").rstrip("])").replace("(", "_").partition("_")
        roles.append(_ROLES.get(name, UNUSED))
        if roles[-1] == TIME:
            unit, written = UNITS.get(of), of if re.search(r"[\[(].*\w", field) else ""
    return tuple(roles), unit, written


def _complete(roles: Sequence[int]) -> bool:
    return sorted(role for role in roles if role != UNUSED) == [TIME, X, Y, POLARITY]


def _named_in_comment(
    path: Path, comments: list[_Line], rows: list[list[str]]
) -> tuple[tuple[int, ...] | None, TimeUnit | None, str, tuple[str, ...]]:
    """Columns that a comment names, one for each column there is, as ``numpy.savetxt`` writes it."""
    count = len(rows[0])
    for line in comments[::-1]:
        words = [word.strip("'(){}:") for word in _split(line.comment)]
        named = [words[k : k + count] for k in range(len(words) - count + 1)]
        named = [names for names in named if _complete(_roles(names)[0])]
        if len(named) != 1:
            continue
        roles, unit, _ = _roles(named[0])
        order = "".join(ROLES[role] for role in roles if role != UNUSED)
        columns = _numbers(rows, count)
        by_role = [columns[roles.index(ROLES.index(role))] for role in order]
        if other := contradicting_order(by_role, order):
            raise RecordingError(
                f"{path}:{line.number}: the comment names columns '{spaced(order)}', but the values read as "
                f"'{spaced(other)}'; expected --event-columns with the order"
            )
        note = f"columns {' '.join(named[0])}, as the comment in line {line.number} names them"
        return roles, unit, order if count == len(ROLES) else "", (note,)
    return None, None, "", ()


def _numbers(rows: list[list[str]], count: int) -> list[np.ndarray]:
    """Columns of the first rows that are whole."""
    numbers = ([decimal(field) for field in fields] for fields in rows)
    whole = list(itertools.takewhile(lambda row: len(row) == count and None not in row, numbers))
    return list(np.array(whole, float).reshape(-1, count).T)


def _inferred_order(path: Path, rows: list[list[str]], columns: str | None) -> tuple[str, tuple[str, ...]]:
    """The order of unnamed columns, and a note on how it was found."""
    if columns:
        return columns, (f"columns {spaced(columns)}, as stated",)
    order, how = inferred_order(path, _numbers(rows, len(ROLES)), ROLES)
    return order, (f"columns {spaced(order)}, {how}",)


def _guessed(times: list[str]) -> TimeUnit:
    """Microseconds for integer times, seconds for those with fractions."""
    numbers = [decimal(time) for time in times]
    if not any(re.search("[.eE]", time) for time in times):
        return "us"
    return guessed_unit(np.array(numbers, float)) if None not in numbers else "s"
