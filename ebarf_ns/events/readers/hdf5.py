"""HDF5 recordings of any layout: a group with a column each for x, y, time and polarity, or one compound table.

TUM-VIE and DSEC have ``/events/{x,y,t,p}`` and ``/t_offset``, EDS the columns at top level, M3ED
``/prophesee/left/{x,y,t,p}``, Prophesee a table ``/CD/events``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ebarf_ns.errors import RecordingError
from ebarf_ns.events.readers import ecf
from ebarf_ns.events.source import Piece, Source, TimeUnit, fits, microseconds, numbered

with suppress(ImportError):
    import hdf5plugin  # noqa: F401  registers the compression filters of TUM-VIE and DSEC with HDF5

_NAMES = {
    "x": ("x", "xs", "x_pos"), "y": ("y", "ys", "y_pos"), "t": ("t", "ts", "timestamp", "timestamps", "time"),
    "p": ("p", "ps", "pol", "polarity", "polarities", "on"),
}  # fmt: skip
_EVENTS_AT_ONCE = 1 << 20
# What the library raises for one damage or another.
_DAMAGES = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError, OverflowError, MemoryError)
Columns = dict[str, h5py.Dataset | tuple[h5py.Dataset, str]]


def read_hdf5(path: Path, group: str | None = None, time_unit: TimeUnit | None = None) -> Source:
    """The events of ``group``, or of the only group that has any; raises :class:`RecordingError`.

    Times are microseconds where they are integers and seconds where they are floats, unless ``time_unit`` says
    otherwise; ``t_offset`` and Prophesee's compressed tables are in microseconds.
    """
    try:
        with h5py.File(path, "r") as file:
            name = _choose(path, _groups(file), group)
            size = _sensor_size(file, name)
    except _DAMAGES as error:
        raise RecordingError(f"{path}: not a whole HDF5 file ({_one_line(error)})") from None
    return Source(path, f"HDF5, events in /{name}", size, _pieces(path, name, time_unit))


def _groups(file: h5py.File) -> dict[str, Columns]:
    """Where events are: groups with four columns, and compound tables with four fields."""
    found: dict[str, Columns] = {}

    def look(name: str, thing: h5py.Group | h5py.Dataset) -> None:
        columns = _columns_of(thing)
        if columns:
            found[name] = columns

    look("", file)
    file.visititems(look)
    return found


def _columns_of(thing: h5py.Group | h5py.Dataset) -> Columns | None:
    if isinstance(thing, h5py.Group):
        fields = [name for name, inner in thing.items() if isinstance(inner, h5py.Dataset) and inner.ndim == 1]
    else:
        fields = list(thing.dtype.names or ()) if thing.ndim == 1 else []
    chosen = {role: next((name for name in names if name in fields), None) for role, names in _NAMES.items()}
    if None in chosen.values():
        return None
    return {role: thing[name] if isinstance(thing, h5py.Group) else (thing, name) for role, name in chosen.items()}  # pyright: ignore[reportReturnType]


def _choose(path: Path, groups: dict[str, Columns], wanted: str | None) -> str:
    if wanted is not None:
        if (name := wanted.strip("/")) not in groups:
            raise RecordingError(f"{path}: /{name} holds no events, expected one of {_listed(groups)}")
        return name
    if len(groups) != 1:
        raise RecordingError(
            f"{path}: {len(groups)} groups hold events ({_listed(groups)}), expected one, or --part to choose"
            if groups
            else f"{path}: no group has columns x, y, t and p of one dimension; expected the events in one"
        )
    return next(iter(groups))


def _listed(groups: dict[str, Columns]) -> str:
    return ", ".join(f"/{name}" for name in groups) or "none"


def _sensor_size(file: h5py.File, name: str) -> tuple[int, int] | None:
    """From attributes of the group or of the file, as several writers leave them."""
    for thing in (file[name] if name else file, file):
        attributes = {key.lower(): value for key, value in thing.attrs.items()}
        if "width" in attributes and "height" in attributes:
            return int(attributes["width"]), int(attributes["height"])
        size = attributes.get("sensor_resolution", attributes.get("resolution"))
        if size is not None and np.size(size) == 2:
            # Both orders are in use; sensors are wider than high.
            return int(np.max(size)), int(np.min(size))
    return None


def _pieces(path: Path, group: str, time_unit: TimeUnit | None) -> Iterator[Piece]:
    try:
        with h5py.File(path, "r") as file:
            columns = _columns_of(file[group] if group else file)  # pyright: ignore[reportArgumentType]
            assert columns is not None
            _check(path, group, columns)
            offset_us = int(np.asarray(file["t_offset"]).item()) if "t_offset" in file else 0
            count = len(_dataset(columns["t"]))
            if _is_ecf(_dataset(columns["t"])):
                yield from _ecf_pieces(_dataset(columns["t"]), offset_us)
                return
            for first in range(0, count, _EVENTS_AT_ONCE):
                x, y, t, p = (_slice(columns[role], first) for role in "xytp")
                t_us = _microseconds(path, group, t, first, time_unit)
                yield Piece(x, y, t_us + offset_us if offset_us else t_us, p, numbered(first, "row"))
    except _DAMAGES as error:
        raise RecordingError(f"{path}: /{group} cannot be read ({_one_line(error)})") from None


def _is_ecf(table: h5py.Dataset) -> bool:
    """Whether a table is compressed as Prophesee does it, by a filter whose library no package brings."""
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
        # The last chunk may be full of what is no event any more.
        count = min(size, len(table) - first)
        if len(columns[0]) < count:
            raise ValueError(f"the chunk at row {first:,} holds {len(columns[0]):,} of its {count:,} events")
        x, y, t_us, p = (column[:count] for column in columns)
        yield Piece(x, y, t_us + offset_us, p, numbered(first, "row"))


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _dataset(column: h5py.Dataset | tuple[h5py.Dataset, str]) -> h5py.Dataset:
    return column[0] if isinstance(column, tuple) else column


def _slice(column: h5py.Dataset | tuple[h5py.Dataset, str], first: int) -> np.ndarray:
    rows = slice(first, first + _EVENTS_AT_ONCE)
    values = column[0][column[1], rows] if isinstance(column, tuple) else column[rows]
    return values.astype(np.uint8) if values.dtype == bool else values


def _check(path: Path, group: str, columns: Columns) -> None:
    lengths = {role: len(_dataset(column)) for role, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise RecordingError(f"{path}: columns of /{group} differ in length, {lengths}; expected one row per event")
    for role, column in columns.items():
        dtype = column[0].dtype[column[1]] if isinstance(column, tuple) else column.dtype
        if dtype.kind not in "iub" and not (role == "t" and dtype == np.float64):
            raise RecordingError(f"{path}: /{group} has {role} of type {dtype}, expected integers (t: or float64)")


def _microseconds(path: Path, group: str, t: np.ndarray, first: int, time_unit: TimeUnit | None) -> np.ndarray:
    unit = time_unit or ("s" if t.dtype.kind == "f" else "us")
    # Integers of microseconds always do.
    if (t.dtype.kind == "f" or unit != "us") and not (possible := fits(t, unit)).all():
        row = int(possible.argmin())
        raise RecordingError(f"{path}: /{group} row {first + row:,} is at {t[row]} {unit}, expected a finite time")
    return microseconds(t, unit)
