"""Events as text, one ``t[s] x y p`` a line: exact decimal times, every malformed line named."""

from pathlib import Path

import numpy as np
from jaxtyping import Int64
from numba import njit

from ebarf_ns.errors import RecordingError
from ebarf_ns.events.recording import Recording

_BLOCK_BYTES = 1 << 24
_COLUMNS = 4
_LONGEST_NUMBER = 18  # digits that fit int64


def read_text_events(path: Path, width: int, height: int) -> Recording:
    """Read ``t[s] x y p`` lines, p 0 or 1; blank lines and ``#`` comments are allowed.

    Raises :class:`RecordingError` with file, line, text and expectation; nothing is repaired or dropped.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from None
    table = np.concatenate([_parse_block(path, *block) for block in _line_blocks(content)] or [np.zeros((0, 5), int)])
    if not len(table):
        raise RecordingError(f"{path}: holds no events, expected lines 't[s] x y p'")
    t_us, x, y, p, line = table.T
    late = np.r_[False, t_us[1:] < t_us[:-1]]
    for name, column, wrong, expected in (
        ("x", x, x >= width, f"0 to {width - 1}, the sensor width"),
        ("y", y, y >= height, f"0 to {height - 1}, the sensor height"),
        ("p", p, p > 1, "0 (darker) or 1 (brighter)"),
        ("t", t_us, late, "a time not before that of the event above it"),
    ):
        if wrong.any():
            row = int(wrong.argmax())
            raise RecordingError(
                f"{path}:{line[row]}: {name} is {column[row]}{' us' if name == 't' else ''}, expected {expected} "
                f"({np.count_nonzero(wrong):,} such lines)"
            )
    return Recording(x.astype(np.uint16), y.astype(np.uint16), np.ascontiguousarray(t_us), (2 * p - 1).astype(np.int8))


def _line_blocks(content: bytes):
    """Blocks of whole lines, each with the number of its first line."""
    start, line = 0, 1
    while start < len(content):
        end = content.find(b"\n", min(start + _BLOCK_BYTES, len(content)))
        end = len(content) if end < 0 else end + 1
        block = content[start:end]
        yield block, line
        line += block.count(b"\n")
        start = end


def _parse_block(path: Path, block: bytes, first_line: int) -> Int64[np.ndarray, "events 5"]:
    table, bad_line = _parse(np.frombuffer(block, np.uint8), first_line, block.count(b"\n") + 1)
    if bad_line:
        text = block.split(b"\n")[bad_line - first_line].decode(errors="replace").strip()
        raise RecordingError(f"{path}:{bad_line}: {text!r:.60} is not an event, expected 't[s] x y p'")
    return table


@njit(cache=True)
def _parse(content, first_line, most):
    """Rows (t_us, x, y, p, line), and the number of the first malformed line or 0."""
    table = np.empty((most, _COLUMNS + 1), np.int64)
    count = 0
    i, line = 0, first_line
    while i < len(content):
        column, ok, comment = 0, True, False
        while i < len(content) and content[i] != 10:
            c = content[i]
            if c == 35:  # '#'
                comment = True
            if comment or c == 32 or c == 9 or c == 13 or c == 44:
                i += 1
                continue
            value, i, ok = _number(content, i, 6 if column == 0 else 0)
            if not ok or column >= _COLUMNS:
                return table[:count], line
            table[count, column] = value
            column += 1
        if column == _COLUMNS:
            table[count, _COLUMNS] = line
            count += 1
        elif column:
            return table[:count], line
        i += 1
        line += 1
    return table[:count], 0


@njit(cache=True)
def _number(content, i, decimals):
    """A number times 10**decimals, rounded; further digits than that only where decimals are expected."""
    negative = content[i] == 45  # '-'
    i += 1 if negative else 0
    value, digits, after_point, round_up = 0, 0, -1, False
    start = i
    while i < len(content):
        c = content[i]
        if c == 46 and after_point < 0 and decimals > 0:  # '.'
            after_point = 0
        elif 48 <= c <= 57:
            if after_point < decimals:
                value = 10 * value + (c - 48)
                digits += 1
            elif after_point == decimals:
                round_up = c >= 53
            if after_point >= 0:
                after_point += 1
        else:
            break
        i += 1
    read_any = i - start > (1 if after_point >= 0 else 0)
    for _ in range(max(after_point, 0), decimals):
        value *= 10
        digits += 1
    value += 1 if round_up else 0
    separated = i == len(content) or content[i] in (32, 9, 10, 13, 44, 35)
    ok = read_any and digits <= _LONGEST_NUMBER and separated
    # Coordinates and polarities are never negative; times may be.
    return (-value if negative else value), i, ok and (decimals > 0 or not negative)
