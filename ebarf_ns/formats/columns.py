"""Columns that do not say what they are: which is which, and in what unit their times are.

Every guess is checked against the values: times never decrease, polarities are 0 and 1 or -1 and 1, coordinates are
those of a sensor. Where two readings fit, nobody guesses.
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

TELLING_ROWS = 1 << 16
"""As many events at the beginning, and at the end, tell the order and the unit of all."""
ROLES = "txyp"
_NAMES = {
    "t": ("t", "ts", "time", "times", "timestamp", "timestamps"),
    "x": ("x", "xs", "x_pos", "x_coordinate", "x_coordinates", "x_coord", "xpos", "x_addr", "col", "column"),
    "y": ("y", "ys", "y_pos", "y_coordinate", "y_coordinates", "y_coord", "ypos", "y_addr", "row"),
    "p": ("p", "ps", "pol", "pols", "polarity", "polarities", "on", "sign"),
}
# The micro sign, and the Greek letter that looks like it.
UNITS: dict[str, TimeUnit] = {
    "s": "s", "sec": "s", "secs": "s", "seconds": "s", "ms": "ms", "msec": "ms", "milliseconds": "ms", "us": "us",
    "\u00b5s": "us", "\u03bcs": "us", "usec": "us", "microseconds": "us", "ns": "ns", "nsec": "ns", "nanoseconds": "ns",
}  # fmt: skip
"""Units as names of columns have them."""
_EXACT = 2.0**53  # floats beyond are no exact integers
_LARGEST_SENSOR = 8192
_FEW_ROWS = 8
_POLARITIES = ({0, 1}, {-1, 1})


def named(fields: Iterable[str]) -> dict[str, str] | None:
    """Which field is t, x, y and p, by their names; None where one of them is missing."""
    by_name = {field.lower(): field for field in reversed(list(fields))}
    bare = {_without_unit(name): field for name, field in by_name.items() if _unit_in(name)}
    chosen = {
        role: next((found[name] for found in (by_name, bare) for name in names if name in found), None)
        for role, names in _NAMES.items()
    }
    return None if None in chosen.values() else chosen  # pyright: ignore[reportReturnType]


def unit_of(name: str) -> TimeUnit | None:
    """The unit that the name of a column says, as in ``t_ns``."""
    return UNITS.get(_unit_in(name.lower()))


def _unit_in(name: str) -> str:
    found = re.search(r"[_\[( ]+(\w+)[\])]?$", name)
    return found[1] if found and found[1] in UNITS else ""


def _without_unit(name: str) -> str:
    return re.sub(r"[_\[( ]+\w+[\])]?$", "", name)


def spaced(order: str) -> str:
    """``txyp`` as people read it."""
    return " ".join(order)


def parsed_order(text: str) -> str:
    """The letters of a flag such as ``x y p t``; raises :class:`RecordingError`."""
    order = re.sub(r"[\s,;]", "", text.lower())
    if sorted(order) != sorted(ROLES):
        raise RecordingError(f"--event-columns is {text!r:.40}, expected t, x, y and p once each, such as 'x y p t'")
    return order


def told_order(path: Path, columns: Sequence[Num[np.ndarray, "events"]], usual: str) -> tuple[str, str]:
    """The order of four columns, a letter each, and what tells it; ``usual`` where the values do not contradict it.

    Raises :class:`RecordingError` where the values fit several.
    """
    readings = {order: _fit(columns, order) for order in _orders()}
    certain = [order for order, fit in readings.items() if fit == 2]
    usual_fits = readings[usual] > 0
    if len(columns[0]) < _FEW_ROWS:
        return usual, "as is usual: too few events tell nothing else"
    if usual_fits and certain in ([], [usual]):
        return usual, "as is usual, and as their values are: times never decrease, polarities are 0 or -1, and 1"
    fitting = certain or [order for order, fit in readings.items() if fit]
    if usual_fits and usual not in fitting:
        fitting.append(usual)
    if len(fitting) == 1:
        return fitting[0], "told by their values: times never decrease, polarities are 0 or -1, and 1"
    if fitting:
        both = " and as ".join(repr(spaced(order)) for order in fitting)
        raise RecordingError(f"{path}: columns without names read as {both}, expected --event-columns with the one")
    unsorted = [order for order in readings if _fits_unsorted(columns, order)]
    if usual not in unsorted and len(unsorted) == 1:
        return unsorted[0], "told by their values, though times do decrease"
    return usual, "as is usual, though their values are not like that"


def look_like_events(columns: Sequence[Num[np.ndarray, "events"]]) -> bool:
    """Whether four columns are events in some order, where other arrays of such a shape are about."""
    enough = len(columns[0]) >= _FEW_ROWS
    return enough and any(_fit(columns, order) > 0 or _fits_unsorted(columns, order) for order in _orders())


def _orders() -> list[str]:
    """All with x before y, as nothing in their values tells one from the other."""
    return ["".join(order) for order in permutations(ROLES) if order.index("x") < order.index("y")]


def _fit(columns: Sequence[np.ndarray], order: str) -> int:
    """0: not like that; 1: it may be; 2: times do increase, and polarities are of both kinds."""
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
    """Whether all are integers, of whatever type."""
    return column.dtype.kind in "iub" or (column.dtype.kind == "f" and bool((column == np.rint(column)).all()))


def guessed_unit(t: Num[np.ndarray, "events"]) -> TimeUnit:
    """Microseconds where times are whole numbers, seconds where they have fractions."""
    return "us" if t.dtype.kind != "f" or (is_whole(t) and len(t) > 0 and t.min() != t.max()) else "s"


def coarseness(t: Num[np.ndarray, "events"], unit: TimeUnit) -> list[str]:
    """What is lost of times whose type holds no microseconds that late; or of times that went through such a type."""
    if t.dtype.kind != "f" or not len(t) or not np.isfinite(t).all():
        return []
    was = "are"
    if t.dtype == np.float64 and len(t) >= _FEW_ROWS and not is_whole(t) and np.abs(t).max() < _EXACT:
        was, t = ("were", t.astype(np.float32)) if (t == t.astype(np.float32)).all() else (was, t)
    latest = np.abs(t).max()
    step_us = float(np.spacing(latest)) * 10.0 ** DECIMALS[unit]
    if step_us <= 1:
        return []
    return [f"times {was} {t.dtype}, which lie {step_us:.3g} us apart at {latest:.6g} {unit}: what is finer is lost"]


def telling(columns: Sequence[Any]) -> list[np.ndarray]:
    """The first and the last events of columns that may be on disk."""
    return [
        np.concatenate([column[:TELLING_ROWS], column[max(TELLING_ROWS, len(column) - TELLING_ROWS) :]])
        for column in columns
    ]


def integers(path: Path, column: np.ndarray, name: str, first: int) -> np.ndarray:
    """As integers, which floats may be too, as in ESIM's rows; ``first`` is the row of the first."""
    if column.dtype.kind in "iub":
        return column.astype(np.uint8) if column.dtype == bool else np.asarray(column)
    whole = (np.abs(column) < _EXACT) & (column == np.rint(column)) if column.dtype.kind == "f" else np.zeros(1, bool)
    if not whole.all():
        row = int(whole.argmin())
        raise RecordingError(f"{path}: {name} of row {first + row:,} is {column[row]!r:.30}, expected an integer")
    return column.astype(np.int64)
