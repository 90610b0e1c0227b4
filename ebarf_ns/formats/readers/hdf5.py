"""HDF5 recordings of any layout: a group with one dataset each for x, y, time and polarity, or one table.

TUM-VIE and DSEC have ``/events/{x,y,t,p}`` and ``/t_offset``, EDS the columns at top level, M3ED
``/prophesee/left/{x,y,t,p}``, Prophesee a compound table ``/CD/events``, v2e rows of four numbers
``/events``. MATLAB 7.3 files are HDF5 as well, with transposed columns.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ebarf_ns.errors import RecordingError
from ebarf_ns.events.recording import is_stored
from ebarf_ns.formats.columns import (
    ROLES,
    coarseness,
    guessed_unit,
    inferred_order,
    integers,
    look_like_events,
    named,
    sampled,
    spaced,
    unit_of,
    worded_unit,
)
from ebarf_ns.formats.readers import ecf
from ebarf_ns.formats.source import Piece, Source, TimeUnit, fits, microseconds, numbered

with suppress(ImportError):
    import hdf5plugin  # noqa: F401  registers the compression filters of TUM-VIE and DSEC with HDF5

_EVENTS_AT_ONCE = 1 << 20
# Exceptions of the library for damaged files.
_DAMAGES = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError, OverflowError, MemoryError)
_USUAL = "txyp"
_UNIT_ATTRIBUTES = ("unit", "units", "time_unit", "time_units")


@dataclass(frozen=True)
class _Column:
    """A one-dimensional dataset, or a column of a table."""

    data: h5py.Dataset
    field: str | None = None
    """Field of a compound table."""
    index: int | None = None
    """Column of a matrix, or row of a transposed one."""
    across: bool = False

    def __len__(self) -> int:
        return self.data.shape[1] if self.across else self.data.shape[0]

    def __getitem__(self, rows: slice) -> np.ndarray:
        if self.field is not None:
            return self.data[self.field, rows]
        if self.index is None:
            return self.data[rows]
        return self.data[self.index, rows] if self.across else self.data[rows, self.index]

    @property
    def dtype(self) -> np.dtype:
        return self.data.dtype if self.field is None else self.data.dtype[self.field]


@dataclass(frozen=True)
class _Events:
    """Location of the events."""

    columns: tuple[_Column, ...]
    time_name: str = ""
    order: str | None = "xytp"
    """None: not known yet."""

    def by_role(self, order: str) -> dict[str, _Column]:
        return dict(zip(self.order or order, self.columns, strict=True))


def read_hdf5(
    path: Path, group: str | None = None, time_unit: TimeUnit | None = None, columns: str | None = None
) -> Source:
    """Read the events of ``group``, by default the only one with events; raises :class:`RecordingError`.

    Unless ``time_unit`` is given, times are in the unit of their name, as in ``t_ns``, or of their attribute, else
    microseconds if integer and seconds if not; ``t_offset`` is in the same unit. Prophesee's compressed tables are in
    microseconds. ``columns`` is the order of unnamed columns.
    """
    try:
        with h5py.File(path, "r") as file:
            name = _choose(path, _groups(file, group), group)
            size = _sensor_size(file, name)
            events = _events_of(file[name] if name else file)  # pyright: ignore[reportArgumentType]
            assert events is not None
            order, unit, notes = _order_and_unit(path, name, events, time_unit, columns)
            offset_us, said_offset = _offset(file, name, events.by_role(order)["t"], unit)
    except _DAMAGES as error:
        raise RecordingError(f"{path}: not a whole HDF5 file ({_one_line(error)})") from None
    guess = None if time_unit or unit_of(events.time_name) else unit
    said = f"HDF5, events in /{name}, times in {unit}"
    return Source(
        path, said, size, _pieces(path, name, order, unit, offset_us), notes=(*notes, *said_offset),
        guessed_unit=guess, columns=order,
    )  # fmt: skip


def _order_and_unit(
    path: Path, name: str, events: _Events, time_unit: TimeUnit | None, columns: str | None
) -> tuple[str, TimeUnit, list[str]]:
    """The order of unnamed columns, the time unit, and notes on how they were found."""
    order, notes = "", []
    if events.order is None:
        order, how = (columns, "as stated") if columns else inferred_order(path, sampled(events.columns), _USUAL)
        notes.append(f"columns {spaced(order)}, {how}")
    _check(path, name, events.by_role(order))
    time = events.by_role(order)["t"]
    t = sampled([time])[0] if time.dtype.kind == "f" else np.zeros(0, np.int64)
    unit = time_unit or unit_of(events.time_name)
    if unit is None and (key := _unit_attribute(time.data)):
        unit = worded_unit(time.data.attrs[key])
        notes.append(f"times in {unit}, as the attribute {key} says")
    unit = unit or guessed_unit(t)
    return order, unit, notes + coarseness(t, unit)


def _unit_attribute(data: h5py.Dataset) -> str | None:
    """Name of a dataset's attribute with the unit of its times, if that unit is known."""
    return next((key for key in data.attrs if key.lower() in _UNIT_ATTRIBUTES and worded_unit(data.attrs[key])), None)


def _offset(file: h5py.File, name: str, time: _Column, unit: TimeUnit) -> tuple[int, list[str]]:
    """The offset of all times in microseconds, beside the columns or at top level, with a note."""
    beside = f"{name}/t_offset" if name and isinstance(file[name], h5py.Group) else "t_offset"
    found = next((key for key in (beside, "t_offset") if key in file), None)
    stored: Any = file[found] if found else None
    value = np.zeros(1) if stored is None else np.asarray(stored).reshape(-1) if stored.size == 1 else np.zeros(0)
    if len(value) != 1 or value.dtype.kind not in "iuf" or not fits(value, unit).all():
        return 0, [f"/{found} is not a time, and is not added to the times"]
    if not value[0]:
        return 0, []
    # An integer beside times in seconds may be in microseconds.
    if unit != "us" and time.dtype.kind == "f" and value.dtype.kind != "f":
        return 0, [f"/{found} is {value[0]}, in an unknown unit, and is not added to the times; --time-offset-us does"]
    return int(microseconds(value, unit)[0]), [f"/{found} is added to the times, {value[0]} {unit}"]


def _groups(file: h5py.File, wanted: str | None) -> dict[str, _Events]:
    """Locations of events: groups with four columns and compound tables with four fields; rows of four numbers only if
    there are none of those, or if a location is given."""
    found: dict[str, _Events] = {}

    def look(name: str, thing: h5py.Group | h5py.Dataset) -> None:
        events = _events_of(thing)
        if events:
            found[name] = events

    look("", file)
    file.visititems(look)
    if wanted is not None:
        return found
    if by_name := {name: events for name, events in found.items() if events.order}:
        return by_name
    if len(found) < 2:
        return found
    # Matrices of poses and cameras also have four columns.
    return {name: events for name, events in found.items() if look_like_events(sampled(events.columns))} or found


def _events_of(thing: h5py.Group | h5py.Dataset) -> _Events | None:
    if isinstance(thing, h5py.Group):
        columns = {name: _column(inner) for name, inner in thing.items() if isinstance(inner, h5py.Dataset)}
        columns = {name: column for name, column in columns.items() if column}
    elif thing.dtype.names:
        columns = {name: _Column(thing, name) for name in thing.dtype.names} if thing.ndim == 1 else {}
    else:
        return _matrix(thing)
    names = named(columns)
    numbers = all(column.dtype.kind in "iubf" for column in columns.values() if column)
    if not names and numbers and isinstance(thing, h5py.Dataset) and len(columns) == len(ROLES):
        return _Events(tuple(columns.values()), order=None)  # pyright: ignore[reportArgumentType]
    return _Events(tuple(columns[names[role]] for role in "xytp"), names["t"]) if names else None  # pyright: ignore[reportArgumentType]


def _column(data: h5py.Dataset) -> _Column | None:
    if data.ndim == 2 and 1 in data.shape:
        across = data.shape[0] == 1
        return _Column(data, index=0, across=across)
    return _Column(data) if data.ndim == 1 else None


def _matrix(data: h5py.Dataset) -> _Events | None:
    """A matrix with four columns, or four rows."""
    if data.ndim != 2 or 4 not in data.shape or data.dtype.kind not in "iubf":
        return None
    across = data.shape[1] != 4
    return _Events(tuple(_Column(data, index=k, across=across) for k in range(4)), order=None)


def _choose(path: Path, groups: dict[str, _Events], wanted: str | None) -> str:
    if wanted is not None:
        if (name := wanted.strip("/")) not in groups:
            raise RecordingError(f"{path}: /{name} holds no events, expected one of {_listed(groups)}")
        return name
    if len(groups) != 1:
        raise RecordingError(
            f"{path}: {len(groups)} places hold events ({_listed(groups)}), expected one, or --part to choose"
            if groups
            else f"{path}: no group has columns x, y, t and p of one dimension, and no dataset is of shape "
            "(events, 4); expected the events in one"
        )
    return next(iter(groups))


def _listed(groups: dict[str, _Events]) -> str:
    return ", ".join(f"/{name}" for name in groups) or "none"


def _sensor_size(file: h5py.File, name: str) -> tuple[int, int] | None:
    """Size from the attributes of the group or file, under the names of several writers."""
    for thing in (file[name] if name else file, file):
        attributes = {key.lower(): value for key, value in thing.attrs.items()}
        if "width" in attributes and "height" in attributes:
            return int(attributes["width"]), int(attributes["height"])
        size = attributes.get("sensor_resolution", attributes.get("resolution"))
        if size is not None and np.size(size) == 2:
            # Both orders are in use; sensors are wider than they are high.
            return int(np.max(size)), int(np.min(size))
    return None


def _pieces(path: Path, group: str, order: str, unit: TimeUnit, offset_us: int) -> Iterator[Piece]:
    try:
        with h5py.File(path, "r") as file:
            events = _events_of(file[group] if group else file)  # pyright: ignore[reportArgumentType]
            assert events is not None
            columns = events.by_role(order)
            if _is_ecf(columns["t"].data):
                yield from _ecf_pieces(columns["t"].data, offset_us)
                return
            for first in range(0, len(columns["t"]), _EVENTS_AT_ONCE):
                x, y, t, p = (columns[role][first : first + _EVENTS_AT_ONCE] for role in "xytp")
                x, y, p = (integers(path, column, name, first) for name, column in (("x", x), ("y", y), ("p", p)))
                t_us = _microseconds(path, group, t, first, unit)
                yield Piece(x, y, t_us + offset_us if offset_us else t_us, p, numbered(first, "row"))
    except _DAMAGES as error:
        raise RecordingError(f"{path}: /{group} cannot be read ({_one_line(error)})") from None


def _is_ecf(table: h5py.Dataset) -> bool:
    """Whether a table uses Prophesee's compression filter, which no package provides."""
    settings = table.id.get_create_plist()
    return any(settings.get_filter(k)[0] == ecf.FILTER for k in range(settings.get_nfilters()))


def _ecf_pieces(table: h5py.Dataset, offset_us: int) -> Iterator[Piece]:
    assert table.chunks is not None
    size = table.chunks[0]
    for first in range(0, len(table), size):
        skipped, content = table.id.read_direct_chunk((first,))
        if skipped:
            rows: Any = np.frombuffer(content, table.dtype)
            columns = rows["x"], rows["y"], rows["t"].astype(np.int64), rows["p"].astype(np.int8)
        else:
            columns = ecf.decode(content)
        # The last chunk may be padded.
        count = min(size, len(table) - first)
        if len(columns[0]) < count:
            raise ValueError(f"the chunk at row {first:,} holds {len(columns[0]):,} of its {count:,} events")
        x, y, t_us, p = (column[:count] for column in columns)
        yield Piece(x, y, t_us + offset_us, p, numbered(first, "row"))


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _check(path: Path, group: str, columns: dict[str, _Column]) -> None:
    lengths = {role: len(column) for role, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise RecordingError(f"{path}: columns of /{group} differ in length, {lengths}; expected one row per event")
    for role, column in columns.items():
        if column.dtype.kind not in "iubf":
            raise RecordingError(
                f"{path}: /{group} has {role} of type {column.dtype}, expected integers (t: or floats)"
            )
        if not is_stored(column.data):
            raise RecordingError(f"{path}: /{group} declares {len(column):,} events in {role} and stores none")


def _microseconds(path: Path, group: str, t: np.ndarray, first: int, unit: TimeUnit) -> np.ndarray:
    # Integer microseconds always fit.
    if (t.dtype.kind == "f" or unit != "us") and not (possible := fits(t, unit)).all():
        row = int(possible.argmin())
        raise RecordingError(f"{path}: /{group} row {first + row:,} is at {t[row]} {unit}, expected a finite time")
    return microseconds(t, unit)
