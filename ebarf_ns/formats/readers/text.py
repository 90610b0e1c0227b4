"""Events as text, one per line: exact decimal times, every malformed line reported.

``t x y p`` in any order, given by a header line or inferred from the values, separated by blanks, commas or semicolons;
a first line ``width height`` is rpg_e2vid's. Numbers may have decimal points and exponents, as written by
``numpy.savetxt``.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ebarf_ns.compiled import njit
from ebarf_ns.errors import RecordingError
from ebarf_ns.formats.columns import ROLES, UNITS, coarseness, guessed_unit, inferred_order, spaced
from ebarf_ns.formats.source import DECIMALS, Piece, Source, TimeUnit

_BLOCK_BYTES = 1 << 22
_TIME, _X, _Y, _POLARITY, _LINE, _TABLE = range(6)
_ROLES = {
    "t": _TIME, "ts": _TIME, "time": _TIME, "times": _TIME, "timestamp": _TIME, "timestamps": _TIME, "x": _X, "xs": _X,
    "y": _Y, "ys": _Y, "p": _POLARITY, "ps": _POLARITY, "pol": _POLARITY, "polarity": _POLARITY,
    "polarities": _POLARITY, "on": _POLARITY,
}  # fmt: skip
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_SIGNIFICANT = 18  # digits that fit int64
_UNUSED = -1


class _Layout(NamedTuple):
    roles: tuple[int, ...]
    """Role of each column."""
    unit: TimeUnit
    guessed: bool
    """Whether the unit was only guessed from the first times."""
    sensor_size: tuple[int, int] | None
    header_lines: int
    order: str
    """Order of unnamed columns, one letter each."""
    notes: tuple[str, ...]


def read_text(path: Path, time_unit: TimeUnit | None = None, columns: str | None = None) -> Source:
    """Read events; the column order comes from a header, ``columns`` or the values, and is usually ``t x y p``.

    Unless their name or ``time_unit`` gives a unit, times are seconds if the first ones have fractions, else
    microseconds.
    Raises :class:`RecordingError` with file, line, text and expectation; nothing is repaired or dropped.
    """
    layout = _layout(path, time_unit, columns)
    name = f"text, times in {layout.unit}"
    guess = layout.unit if layout.guessed else None
    return Source(
        path, name, layout.sensor_size, _pieces(path, layout), notes=layout.notes, guessed_unit=guess,
        columns=layout.order,
    )  # fmt: skip


def _layout(path: Path, time_unit: TimeUnit | None, columns: str | None) -> _Layout:
    """Infer the layout from the first lines."""
    size, roles, unit = None, None, None
    lines = list(_first_lines(path))
    for place, (number, fields) in enumerate(lines):
        numeric = [_decimal(field) for field in fields]
        if None in numeric and roles is None:
            roles, unit = _named_columns(path, number, fields, time_unit)
            continue
        if len(fields) == 2 and size is None and None not in numeric:
            size = int(numeric[0] or 0), int(numeric[1] or 0)
            continue
        order, notes = "", ()
        if roles is None:
            order, notes = _inferred_order(path, [fields for _, fields in lines[place:]], columns)
            roles = tuple(ROLES.index(role) for role in order)
        column = roles.index(_TIME)
        times = [fields[column] for _, fields in lines[place:] if column < len(fields)]
        stated, unit = time_unit or unit, time_unit or unit or _guessed(times)
        numbers = [number for number in map(_decimal, times) if number is not None]
        notes += tuple(coarseness(np.array(numbers, float), unit))
        return _Layout(roles, unit, stated is None, size, number - 1, order, notes)
    raise RecordingError(f"{path}: holds no events, expected lines 't[s] x y p'")


def _inferred_order(path: Path, rows: list[list[str]], columns: str | None) -> tuple[str, tuple[str, ...]]:
    """The order of unnamed columns, and a note on how it was found."""
    if columns:
        return columns, (f"columns {spaced(columns)}, as stated",)
    numbers = [[_decimal(field) for field in fields] for fields in rows]
    whole = list(itertools.takewhile(lambda row: len(row) == len(ROLES) and None not in row, numbers))
    order, how = inferred_order(path, list(np.array(whole, float).reshape(-1, len(ROLES)).T), ROLES)
    return order, (f"columns {spaced(order)}, {how}",)


def _guessed(times: list[str]) -> TimeUnit:
    """Unit guessed from the first times, see :func:`read_text`."""
    numbers = [_decimal(time) for time in times]
    if not any(re.search("[.eE]", time) for time in times):
        return "us"
    return guessed_unit(np.array(numbers, float)) if None not in numbers else "s"


def _first_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    try:
        with path.open("rb") as file:
            for number in range(1, 1000):
                line = file.readline(1 << 16)
                if not line:
                    return
                text = line.decode("utf-8-sig", errors="replace").split("#")[0].strip(" \t\r\n,;")
                # Join a unit with its name: "time (us)".
                fields = re.split(r"[\s,;]+", re.sub(r"\s+(?=[\[(])", "", text))
                if fields != [""]:
                    yield number, fields
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from None


def _decimal(text: str) -> Decimal | None:
    try:
        number = Decimal(text)
    except InvalidOperation:
        return None
    return number if number.is_finite() else None


def _named_columns(
    path: Path, number: int, fields: list[str], time_unit: TimeUnit | None
) -> tuple[tuple[int, ...], TimeUnit | None]:
    unit = time_unit
    roles = []
    for field in fields:
        name, _, of = field.lower().strip("\"'").replace("[", "_").rstrip("])").replace("(", "_").partition("_")
        role = _ROLES.get(name, _UNUSED)
        if role == _TIME and time_unit is None:
            unit = UNITS.get(of)
            if unit is None and re.search(r"[\[(].*\w", field):
                expected = f"one of {', '.join(UNITS)}, or --event-time-unit"
                raise RecordingError(f"{path}:{number}: times in {of!r:.20}, expected {expected}")
        roles.append(role)
    if sorted(role for role in roles if role != _UNUSED) != [_TIME, _X, _Y, _POLARITY]:
        raise RecordingError(f"{path}:{number}: columns {' '.join(fields)!r:.60}, expected t, x, y and p once each")
    return tuple(roles), unit


def _pieces(path: Path, layout: _Layout) -> Iterator[Piece]:
    roles = np.array(layout.roles)
    for block, line in _line_blocks(path, layout.header_lines):
        content = np.frombuffer(block, np.uint8)
        # A fractional time contradicts guessed microseconds.
        exact = layout.guessed and layout.unit == "us"
        table, bad_line = _parse(content, line, roles, DECIMALS[layout.unit], not exact, block.count(b"\n") + 1)
        if bad_line:
            text = block.split(b"\n")[bad_line - line].decode(errors="replace").strip()
            columns = {_TIME: f"t[{layout.unit}]", _X: "x", _Y: "y", _POLARITY: "p", _UNUSED: "-"}
            names = " ".join(columns[role] for role in layout.roles)
            hint = ", or --event-time-unit" if exact else ""
            hint += ", or --event-columns" if layout.order else ""
            raise RecordingError(f"{path}:{bad_line}: {text!r:.60} is not an event, expected '{names}'{hint}")
        if len(table):
            t_us, x, y, polarity, lines = table.T
            yield Piece(x, y, np.ascontiguousarray(t_us), polarity, lambda k, lines=lines: f"line {lines[k]:,}")


def _line_blocks(path: Path, header_lines: int) -> Iterator[tuple[bytes, int]]:
    """Blocks of whole lines, with the number of their first line."""
    line, rest = 1 + header_lines, b""
    with path.open("rb") as file:
        if file.read(len(_BYTE_ORDER_MARK)) != _BYTE_ORDER_MARK:
            file.seek(0)
        for _ in range(header_lines):
            file.readline()
        while content := file.read(_BLOCK_BYTES):
            whole, newline, rest = (rest + content).rpartition(b"\n")
            if newline:
                yield whole + newline, line
                line += whole.count(b"\n") + 1
    if rest:
        yield rest, line


@njit(cache=True)
def _parse(content, first_line, roles, time_decimals, round_times, most):
    """Parse rows (t_us, x, y, p, line); also returns the number of the first malformed line, or 0."""
    table = np.empty((most, _TABLE), np.int64)
    count = 0
    i, line = 0, first_line
    while i < len(content):
        column, comment = 0, False
        while i < len(content) and content[i] != 10:
            c = content[i]
            if c == 35:  # '#'
                comment = True
            if comment or c == 32 or c == 9 or c == 13 or c == 44 or c == 59:
                i += 1
                continue
            if column >= len(roles):
                return table[:count], line
            role = roles[column]
            value, i, ok = _number(content, i, time_decimals if role == _TIME else 0, role == _TIME and round_times)
            if role != _UNUSED:
                if not ok or (value < 0 and (role == _X or role == _Y)):
                    return table[:count], line
                table[count, role] = value
            column += 1
        if column == len(roles):
            table[count, _LINE] = line
            count += 1
        elif column:
            return table[:count], line
        i += 1
        line += 1
    return table[:count], 0


@njit(cache=True)
def _number(content, i, decimals, rounded):
    """Parse a number times 10**decimals as an integer; a fraction is rounded or makes it invalid."""
    negative = content[i] == 45  # '-'
    i += 1 if negative or content[i] == 43 else 0
    value, power, digits, seen, after_point = 0, decimals, 0, False, False
    while i < len(content):
        c = content[i]
        if c == 46 and not after_point:  # '.'
            after_point = True
        elif 48 <= c <= 57:
            seen = True
            if digits < _SIGNIFICANT:
                value = 10 * value + (c - 48)
                digits += 1 if value else 0
                power -= 1 if after_point else 0
            else:
                power += 0 if after_point else 1
        else:
            break
        i += 1
    ok = seen
    if i < len(content) and (content[i] == 101 or content[i] == 69):  # 'e', 'E'
        i += 1
        sign = 1
        if i < len(content) and (content[i] == 45 or content[i] == 43):
            sign = -1 if content[i] == 45 else 1
            i += 1
        exponent, any_digit = 0, False
        while i < len(content) and 48 <= content[i] <= 57:
            exponent = min(10 * exponent + (content[i] - 48), 1000)
            any_digit = True
            i += 1
        ok = ok and any_digit
        power += sign * exponent
    if i < len(content) and content[i] not in (32, 9, 10, 13, 44, 59, 35):
        ok = False
        while i < len(content) and content[i] not in (32, 9, 10, 13, 44, 59, 35):
            i += 1
    if value and power > 0:
        ok = ok and digits + power <= _SIGNIFICANT
        for _ in range(min(power, _SIGNIFICANT)):
            value *= 10
    elif power < 0:
        unit = 1
        for _ in range(min(-power, _SIGNIFICANT)):
            unit *= 10
        rest = value % unit if -power <= _SIGNIFICANT else value
        value = value // unit if -power <= _SIGNIFICANT else 0
        ok = ok and (rounded or rest == 0)
        value += 1 if 2 * rest >= unit else 0
    return -value if negative else value, i, ok
