"""Order of unnamed event columns, and the unit of their times.

Every guess is checked against the values: times never decrease, polarities are 0 and 1 or -1 and 1, coordinates fit a
sensor. If two orders fit, an error asks for the order.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from itertools import permutations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ebarf_ns.errors import RecordingError
from ebarf_ns.formats.source import DECIMALS, TimeUnit

if TYPE_CHECKING:
    from jaxtyping import Num

SAMPLED_ROWS = 1 << 16
"""Number of events at the beginning and at the end from which order and unit are inferred."""
ROLES = "txyp"
_NAMES = {
    "t": ("t", "ts", "time", "times", "timestamp", "timestamps"),
    "x": ("x", "xs", "x_pos", "x_coordinate", "x_coordinates", "x_coord", "xpos", "x_addr", "col", "column"),
    "y": ("y", "ys", "y_pos", "y_coordinate", "y_coordinates", "y_coord", "ypos", "y_addr", "row"),
    "p": ("p", "ps", "pol", "pols", "polarity", "polarities", "on", "sign"),
}
# Includes the micro sign and the similar Greek letter.
UNITS: dict[str, TimeUnit] = {
    "s": "s", "sec": "s", "secs": "s", "seconds": "s", "ms": "ms", "msec": "ms", "milliseconds": "ms", "us": "us",
    "\u00b5s": "us", "\u03bcs": "us", "usec": "us", "microseconds": "us", "ns": "ns", "nsec": "ns", "nanoseconds": "ns",
}  # fmt: skip
"""Spellings of units in column names."""
_EXACT = 2.0**53  # larger floats are not exact integers
_LARGEST_SENSOR = 8192
_FEW_ROWS = 8
_POLARITIES = ({0, 1}, {-1, 1})
_CHECKED = "times never decrease, polarities are 0 or -1, and 1; that x is before y is assumed"


def named(fields: Iterable[str]) -> dict[str, str] | None:
    """The fields for t, x, y and p by name; None if one is missing."""
    by_name = {field.lower(): field for field in reversed(list(fields))}
    bare = {_without_unit(name): field for name, field in by_name.items() if _unit_in(name)}
    chosen = {
        role: next((found[name] for found in (by_name, bare) for name in names if name in found), None)
        for role, names in _NAMES.items()
    }
    return None if None in chosen.values() else chosen  # pyright: ignore[reportReturnType]


def unit_of(name: str) -> TimeUnit | None:
    """The unit in a column name, as in ``t_ns``."""
    return UNITS.get(_unit_in(name.lower()))


def stated_unit(text: str) -> TimeUnit | None:
    """The unit in a remark such as ``time in ms`` or ``timestamps [ns]``."""
    of = r"(?:\W*\b(?:is|are|units?|in)\b\W*|\s*[\[(:=]\s*)+"
    found = re.search(rf"\b(?:t|ts|times?|timestamps?)\b{of}([a-z\u00b5\u03bc]+)\b", text.lower())
    return UNITS.get(found[1]) if found else None


def worded_unit(text: object) -> TimeUnit | None:
    """The unit that an attribute begins with, as in ``microseconds since 2024``."""
    text = text.decode(errors="replace") if isinstance(text, bytes) else str(text)
    return UNITS.get(re.split(r"\W", text.strip().lower())[0])


def _unit_in(name: str) -> str:
    found = re.search(r"[_\[( ]+(\w+)[\])]?$", name)
    return found[1] if found and found[1] in UNITS else ""


def _without_unit(name: str) -> str:
    return re.sub(r"[_\[( ]+\w+[\])]?$", "", name)


def spaced(order: str) -> str:
    """``txyp`` as ``t x y p``."""
    return " ".join(order)


def parsed_order(text: str) -> str:
    """Parse a flag such as ``x y p t``; raises :class:`RecordingError`."""
    order = re.sub(r"[\s,;]", "", text.lower())
    if sorted(order) != sorted(ROLES):
        raise RecordingError(f"--event-columns is {text!r:.40}, expected t, x, y and p once each, such as 'x y p t'")
    return order


def inferred_order(path: Path, columns: Sequence[Num[np.ndarray, "events"]], usual: str) -> tuple[str, str]:
    """Infer the order of four columns and explain it; ``usual`` if the values do not contradict it.

    Raises :class:`RecordingError` if the values fit several orders.
    """
    readings = {order: _fit(columns, order) for order in _orders()}
    certain = [order for order, fit in readings.items() if fit == 2]
    usual_fits = readings[usual] > 0
    if len(columns[0]) < _FEW_ROWS:
        return usual, "the usual order: too few events to check it"
    if usual_fits and certain in ([], [usual]):
        return usual, f"the usual order, which the values fit: {_CHECKED}"
    fitting = certain or [order for order, fit in readings.items() if fit]
    if usual_fits and usual not in fitting:
        fitting.append(usual)
    if len(fitting) == 1:
        return fitting[0], f"inferred from the values: {_CHECKED}"
    if fitting:
        both = " and as ".join(repr(spaced(order)) for order in fitting)
        raise RecordingError(f"{path}: columns without names read as {both}, expected --event-columns with the order")
    unsorted = [order for order in readings if _fits_unsorted(columns, order)]
    if usual not in unsorted and len(unsorted) == 1:
        return unsorted[0], "inferred from the values, although times decrease"
    return usual, "the usual order, although the values do not fit it"


def contradicting_order(columns: Sequence[Num[np.ndarray, "events"]], order: str) -> str:
    """Another order that the values fit, where they do not fit ``order``; empty if there is none.

    Which of two columns is x, the values cannot tell.
    """
    plain = order if order.index("x") < order.index("y") else order.translate(str.maketrans("xy", "yx"))
    if len(columns[0]) < _FEW_ROWS or _fit(columns, plain) or _fits_unsorted(columns, plain):
        return ""
    return next((other for other in _orders() if _fit(columns, other) == 2), "")


def look_like_events(columns: Sequence[Num[np.ndarray, "events"]]) -> bool:
    """Whether four columns look like events in some order, to separate them from other arrays of that shape."""
    enough = len(columns[0]) >= _FEW_ROWS
    return enough and any(_fit(columns, order) > 0 or _fits_unsorted(columns, order) for order in _orders())


def _orders() -> list[str]:
    """All orders with x before y, since the values cannot distinguish these two."""
    return ["".join(order) for order in permutations(ROLES) if order.index("x") < order.index("y")]


def _fit(columns: Sequence[np.ndarray], order: str) -> int:
    """0: does not fit; 1: fits; 2: fits, with increasing times and both polarities."""
    t, p = (columns[order.index(role)] for role in "tp")
    if not len(t) or not _polarities(p) or not _coordinates(columns, order):
        return 0
    if not bool((t[1:] >= t[:-1]).all()):
        return 0
    return 2 if t[-1] > t[0] and p.min() != p.max() else 1


def _fits_unsorted(columns: Sequence[np.ndarray], order: str) -> bool:
    t, p = (columns[order.index(role)] for role in "tp")
    return len(t) > 0 and _polarities(p) and _coordinates(columns, order) and not _of_a_sensor(t)


def _polarities(p: np.ndarray) -> bool:
    return any(bool(np.isin(p, list(values)).all()) for values in _POLARITIES)


def _coordinates(columns: Sequence[np.ndarray], order: str) -> bool:
    return all(_of_a_sensor(columns[order.index(role)]) for role in "xy")


def _of_a_sensor(column: np.ndarray) -> bool:
    return bool(((column >= 0) & (column < _LARGEST_SENSOR)).all()) and is_whole(column)


def is_whole(column: np.ndarray) -> bool:
    """Whether all values are integers, of any type."""
    return column.dtype.kind in "iub" or (column.dtype.kind == "f" and bool((column == np.rint(column)).all()))


def guessed_unit(t: Num[np.ndarray, "events"]) -> TimeUnit:
    """Microseconds for integer times, seconds for fractional ones."""
    return "us" if t.dtype.kind != "f" or (is_whole(t) and len(t) > 0 and t.min() != t.max()) else "s"


def coarseness(t: Num[np.ndarray, "events"], unit: TimeUnit) -> list[str]:
    """Note on precision lost by times whose type cannot resolve microseconds, now or in an earlier conversion."""
    if t.dtype.kind != "f" or not len(t) or not np.isfinite(t).all():
        return []
    was = "are"
    if t.dtype == np.float64 and len(t) >= _FEW_ROWS and not is_whole(t) and np.abs(t).max() < _EXACT:
        was, t = ("were", t.astype(np.float32)) if (t == t.astype(np.float32)).all() else (was, t)
    latest = np.abs(t).max()
    step_us = float(np.spacing(latest)) * 10.0 ** DECIMALS[unit]
    if step_us <= 1:
        return []
    return [
        f"times {was} {t.dtype}, with a resolution of {step_us:.3g} us at {latest:.6g} {unit}: finer times are lost"
    ]


def sampled(columns: Sequence[Any]) -> list[np.ndarray]:
    """The first and last events of columns that may be on disk."""
    return [
        np.concatenate([column[:SAMPLED_ROWS], column[max(SAMPLED_ROWS, len(column) - SAMPLED_ROWS) :]])
        for column in columns
    ]


def integers(path: Path, column: np.ndarray, name: str, first: int) -> np.ndarray:
    """Convert a column to integers, from floats too, as in ESIM's rows; ``first`` is its first row number."""
    if column.dtype.kind in "iub":
        return column.astype(np.uint8) if column.dtype == bool else np.asarray(column)
    whole = (np.abs(column) < _EXACT) & (column == np.rint(column)) if column.dtype.kind == "f" else np.zeros(1, bool)
    if not whole.all():
        row = int(whole.argmin())
        raise RecordingError(f"{path}: {name} of row {first + row:,} is {column[row]!r:.30}, expected an integer")
    return column.astype(np.int64)
