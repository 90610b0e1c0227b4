"""Events as text, one per line: exact decimal times, every malformed line reported.

``t x y p`` in any order, given by a header line or a comment, or inferred from the values, separated by blanks, commas
or semicolons; a first line ``width height`` is rpg_e2vid's. Numbers may have quotes, decimal points and exponents, as
written by ``numpy.savetxt``; polarities may be words. Comments begin with ``#``, ``%`` or ``//``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ebarf_ns.compiled import njit
from ebarf_ns.errors import RecordingError
from ebarf_ns.formats.readers.text_header import POLARITY, TIME, UNUSED, WORDS, Layout, X, Y, decimal, layout_of
from ebarf_ns.formats.source import DECIMALS, Piece, Source, TimeUnit

_BLOCK_BYTES = 1 << 22
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_SIGNIFICANT = 18  # digits that fit int64
_LINE, _TABLE = 4, 5


def read_text(path: Path, time_unit: TimeUnit | None = None, columns: str | None = None) -> Source:
    """Read events; the column order comes from a header, ``columns``, a comment or the values; usually ``t x y p``.

    Unless their name, a comment or ``time_unit`` gives a unit, times are seconds if the first ones have fractions, else
    microseconds.
    Raises :class:`RecordingError` with file, line, text and expectation; nothing is repaired or dropped.
    """
    layout = layout_of(path, time_unit, columns)
    name = f"text, times in {layout.unit}"
    guess = layout.unit if layout.doubtful else None
    return Source(
        path, name, layout.sensor_size, _pieces(path, layout), notes=layout.notes, guessed_unit=guess,
        columns=layout.order,
    )  # fmt: skip


def _pieces(path: Path, layout: Layout) -> Iterator[Piece]:
    roles = np.array(layout.roles)
    for block, line in _line_blocks(path, layout.header_lines):
        # A fractional time contradicts guessed microseconds.
        exact = layout.guessed and layout.unit == "us"
        plain = _plain(block, layout.words)
        content = np.frombuffer(plain, np.uint8)
        table, bad_line = _parse(content, line, roles, DECIMALS[layout.unit], not exact, plain.count(b"\n") + 1)
        if bad_line:
            lines = block.decode(errors="replace").split("\n")
            text = lines[bad_line - line].strip()
            names = " ".join(_name(role, layout.unit) for role in layout.roles)
            why = _why_not(text, layout, exact) + "; is the file cut off?" * (bad_line - line == len(lines) - 1)
            raise RecordingError(f"{path}:{bad_line}: {text!r:.60} is not an event, expected '{names}'; {why}")
        if len(table):
            t_us, x, y, polarity, lines = table.T
            yield Piece(x, y, np.ascontiguousarray(t_us), polarity, lambda k, lines=lines: f"line {lines[k]:,}")


def _plain(block: bytes, words: bool) -> bytes:
    """The same lines without quotes, and with numbers instead of words."""
    block = block.replace(b'"', b"") if b'"' in block else block
    if not words:
        return block
    return re.sub(rb"[A-Za-z]+", lambda word: WORDS.get(word[0].decode().lower(), word[0].decode()).encode(), block)


def _name(role: int, unit: TimeUnit) -> str:
    return {TIME: f"t[{unit}]", X: "x", Y: "y", POLARITY: "p"}.get(role, "-")


def _why_not(text: str, layout: Layout, exact: bool) -> str:
    """What is wrong with a line."""
    fields = [field for field in re.split(r"[\s,;]+", re.split("#|%|//", text.replace('"', ""))[0]) if field]
    if len(fields) != len(layout.roles):
        many = len(fields) > len(layout.roles)
        hint = "; a first line may name them, as in 't x y p other'" if many and layout.order else ""
        hint = "; decimal commas? Expected points" if many and ";" in text and "," in text else hint
        return f"columns: {len(fields)}, expected {len(layout.roles)}{hint}"
    for field, role in zip(fields, layout.roles, strict=True):
        number = decimal(WORDS.get(field.lower(), field) if layout.words else field)
        whole = number is not None and number == number.to_integral_value()
        if role == UNUSED or (number is not None and role == TIME and (whole or not exact)):
            continue
        if role == TIME and number is not None:
            return "t has a fraction, --event-time-unit gives its unit"
        if number is None or not whole or (number < 0 and role != POLARITY):
            expected = ("a number" if role == TIME else "a whole number") + ", or --event-columns" * bool(layout.order)
            return f"{_name(role, layout.unit)} is {field!r:.20}, expected {expected}"
    return "a number is too long"


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
            if c == 35 or c == 37 or (c == 47 and i + 1 < len(content) and content[i + 1] == 47):  # '#', '%', '//'
                comment = True
            if comment or c == 32 or c == 9 or c == 13 or c == 44 or c == 59:
                i += 1
                continue
            if column >= len(roles):
                return table[:count], line
            role = roles[column]
            value, i, ok = _number(content, i, time_decimals if role == TIME else 0, role == TIME and round_times)
            if role != UNUSED:
                if not ok or (value < 0 and (role == X or role == Y)):
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
