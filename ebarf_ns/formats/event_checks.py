"""Checks of raw events: coordinates, polarity, time order."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ebarf_ns.errors import RecordingError
from ebarf_ns.formats.source import Piece, Source

if TYPE_CHECKING:
    from jaxtyping import Bool, Int64

MAX_TIME_US = 1 << 61
# Timestamp counters of 31 and 32 bits wrap around; a wrap is accepted this close to the ends of the range.
_WRAPS_US, _NEAR_US = (1 << 31, 1 << 32), 1_000_000


def late(t_us: Int64[np.ndarray, "events"], before_us: int | None) -> Bool[np.ndarray, "events"]:
    """Which events are earlier than the previous one."""
    late = np.empty(len(t_us), bool)
    late[0] = before_us is not None and t_us[0] < before_us
    np.less(t_us[1:], t_us[:-1], out=late[1:])
    return late


def check_values(source: Source, piece: Piece, width: int, height: int) -> None:
    """Raise :class:`RecordingError` for pixels outside the sensor and impossible times."""
    x, y, t_us = piece.x, piece.y, piece.t_us
    wide, high = int(x.max()), int(y.max())
    # Check the extremes first, and single events only if those are wrong.
    if wide < width and high < height and int(x.min()) >= 0 and int(y.min()) >= 0 and _plausible(t_us):
        return
    swapped = _read_as(source)
    if wide < height and high < width:
        other = source.columns.translate(str.maketrans("xy", "yx"))
        swapped = f"; x reaches {wide} and y {high}: are they swapped?"
        cure = f"use --event-columns '{' '.join(other)}'" if other else "exchange width and height in the calibration"
        swapped += f" Then {cure}"
    for name, column, wrong, expected in (
        ("x", x, (x < 0) | (x >= width), f"0 to {width - 1}, the sensor width{swapped}"),
        ("y", y, (y < 0) | (y >= height), f"0 to {height - 1}, the sensor height{swapped}"),
        ("t", t_us, (t_us > MAX_TIME_US) | (t_us < -MAX_TIME_US), f"microseconds within ±{MAX_TIME_US}"),
    ):
        if wrong.any():
            k = int(wrong.argmax())
            raise RecordingError(
                f"{source.path}: {name} of {piece.place(k)} is {column[k]}, expected {expected} "
                f"({np.count_nonzero(wrong):,} such of the {len(piece):,} events around it)"
            )


def _read_as(source: Source) -> str:
    """For columns without names, how they were read, and the flag to change that."""
    return f"; columns are read as '{' '.join(source.columns)}', --event-columns changes that" if source.columns else ""


def _plausible(t_us: np.ndarray) -> bool:
    return -MAX_TIME_US <= int(t_us.min()) and int(t_us.max()) <= MAX_TIME_US


def check_polarity(source: Source, piece: Piece, lowest: int, highest: int) -> None:
    """Raise :class:`RecordingError` unless polarities are 0 and 1, or -1 and 1, in the whole file."""
    signed = lowest < 0
    p = piece.polarity
    wrong = (p != -1) & (p != 1) if signed else (p != 0) & (p != 1)
    if lowest < -1 or highest > 1 or (signed and wrong.any()):
        k = int(wrong.argmax()) if wrong.any() else 0
        raise RecordingError(
            f"{source.path}: polarity of {piece.place(k)} is {p[k]}, expected 0 (darker) and 1 (brighter), or -1 and "
            f"1, throughout; the file has {lowest} to {highest}{_read_as(source)}"
        )


def unwrapped(
    t_us: Int64[np.ndarray, "events"], before_us: int | None, wrapped_us: int, repaired: Counter[str]
) -> tuple[Int64[np.ndarray, "events"], int]:
    """Unwrap times where a 31- or 32-bit counter overflowed, which is unambiguous at such values."""
    for k in np.flatnonzero(late(t_us, before_us)).tolist():
        before = int(t_us[k - 1]) if k else before_us
        assert before is not None
        for wrap_us in _WRAPS_US:
            # A signed counter continues at minus its range.
            lowest = -wrap_us if wrap_us == 1 << 31 and t_us[k] - wrapped_us < 0 else 0
            counted = before - wrapped_us
            if 0 <= wrap_us - counted < _NEAR_US and 0 <= int(t_us[k]) - wrapped_us - lowest < _NEAR_US:
                t_us[k:] += wrap_us - lowest
                wrapped_us += wrap_us - lowest
                repaired[f"overflows of the {wrap_us.bit_length() - 1}-bit time counter"] += 1
                break
    return t_us, wrapped_us


def check_order(
    path: Path, piece: Piece, t_us: np.ndarray, before_us: int | None, unsorted: str, repaired: Counter[str]
) -> None:
    """Raise :class:`RecordingError` for events earlier than the previous ones, or count them if they will be sorted."""
    early = late(t_us, before_us)
    if not early.any():
        return
    k = int(early.argmax())
    if unsorted == "refuse":
        before = int(t_us[k - 1]) if k else before_us
        raise RecordingError(
            f"{path}: {piece.place(k)} is at {t_us[k]} us, after one at {before} us; expected events in order of time "
            f"({np.count_nonzero(early):,} such of the {len(piece):,} around it), or --unsorted sort to sort them"
        )
    repaired["events earlier than the previous one, now sorted"] += int(np.count_nonzero(early))
