"""Arrays in NumPy (``.npz``, ``.npy``) and MATLAB (``.mat``) files, or in folders of such files.

A file has one array each for x, y, time and polarity (Robust e-NeRF, EventNeRF), a structured array with such fields
(Metavision, tonic, expelliarmus), or rows of four numbers (ESIM).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat

from ebarf_ns.errors import RecordingError
from ebarf_ns.files import opened_npz
from ebarf_ns.formats.columns import (
    ROLES,
    coarseness,
    guessed_unit,
    inferred_order,
    integers,
    is_whole,
    look_like_events,
    named,
    sampled,
    spaced,
    unit_of,
)
from ebarf_ns.formats.readers.mat_elements import check_elements
from ebarf_ns.formats.source import Piece, Source, TimeUnit, fits, microseconds, numbered

_EVENTS_AT_ONCE = 1 << 20
_ESIM = "xytp"
_FEW_ROWS = 8
Arrays = Mapping[str, Any]
"""Arrays of a file, or mappings for structs, by name."""


@dataclass(frozen=True)
class _Found:
    """The four columns of a file; unnamed ones in file order."""

    columns: tuple[np.ndarray, ...]
    unit: TimeUnit | None = None
    """Unit of the times, if a name gives it."""
    order: str | None = "xytp"
    """None: not known yet."""
    offset: str = ""
    """An offset of the times beside them, as text."""

    def by_role(self, order: str) -> tuple[np.ndarray, ...]:
        """x, y, t and p, with ``order`` for unnamed columns."""
        order = self.order or order
        return tuple(self.columns[order.index(role)] for role in "xytp")


def read_npz(
    path: Path, time_unit: TimeUnit | None = None, columns: str | None = None, part: str | None = None
) -> Source:
    """Read an npz file, or all in a folder sorted by name; raises :class:`RecordingError`.

    Unless ``time_unit`` is given, times are nanoseconds in Robust e-NeRF's files (which have ``position``), else in the
    unit of their name, as in ``t_ns``, else microseconds if integer and seconds if not. ``columns`` is the order of
    unnamed columns, ``part`` selects an array if there are several.
    """
    return _read(path, "npz", _npz, time_unit, columns, part)


def read_npy(path: Path, time_unit: TimeUnit | None = None, columns: str | None = None) -> Source:
    """Read a npy file, or all in a folder sorted by name, such as ESIM's and E-NeRF's; as :func:`read_npz`, except that
    integer-valued floats in ESIM's column order are nanoseconds.
    """
    return _read(path, "npy", _npy, time_unit, columns, None)


def read_mat(
    path: Path, time_unit: TimeUnit | None = None, columns: str | None = None, part: str | None = None
) -> Source:
    """Read variables x, y, ts and pol of a MATLAB 5 file, or of a struct in it; as :func:`read_npz`."""
    return _read(path, "mat", _mat, time_unit, columns, part)


def _read(
    path: Path,
    kind: str,
    arrays_of: Callable[[Path], AbstractContextManager[Arrays]],
    time_unit: TimeUnit | None,
    columns: str | None,
    part: str | None,
) -> Source:
    files = sorted(path.glob(f"*.{kind}"), key=_by_number) if path.is_dir() else [path]
    if not files:
        raise RecordingError(f"{path}: holds no .{kind} file, expected events in files by time")

    def open_one(file: Path) -> _Found:
        with arrays_of(file) as arrays:
            return _found(file, arrays, part)

    # Reuse a single file that is already in memory.
    first = _first_with_events(files, open_one)
    last = _first_with_events(files[::-1], open_one) if len(files) > 1 else first
    opened = open_one if len(files) > 1 else lambda file: first
    ends = (first, last) if len(files) > 1 else (first,)
    samples = [np.concatenate(parts) for parts in zip(*(sampled(end.columns) for end in ends), strict=True)]
    order, notes = "", []
    if first.order is None:
        order, how = (columns, "as stated") if columns else inferred_order(path, samples, _ESIM)
        notes.append(f"columns {spaced(order)}, {how}")
    t = replace(first, columns=tuple(samples)).by_role(order)[2]
    unit = time_unit or first.unit or ("ns" if kind == "npy" and order == _ESIM and _of_esim(t) else guessed_unit(t))
    notes += coarseness(t, unit)
    if first.offset:
        notes.append(f"t_offset is {first.offset}, and is not added to the times; --time-offset-us does")
    name = f"{kind if len(files) == 1 else f'{len(files)} {kind} files'}, times in {unit}"
    guess = None if time_unit or first.unit else unit
    return Source(
        path,
        name,
        None,
        _pieces(files, opened, order, unit, guess is None),
        notes=tuple(notes),
        guessed_unit=guess,
        columns=order,
    )


def _by_number(path: Path) -> list[tuple[int, str]]:
    """Sort key that puts 10 after 9 in names without leading zeros."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part) if part.isdigit() else -1, part) for part in parts]


def _first_with_events(files: list[Path], opened: Callable[[Path], _Found]) -> _Found:
    """The first non-empty file, or the last one."""
    for file in files:
        found = opened(file)
        if len(found.columns[0]):
            return found
    return found


def _of_esim(t: np.ndarray) -> bool:
    return t.dtype.kind == "f" and is_whole(t)


def _found(path: Path, arrays: Arrays, part: str | None) -> _Found:
    """Find the events among the arrays of a file."""
    if part is not None:
        if part not in arrays:
            raise RecordingError(f"{path}: has no array {part}, expected one of {', '.join(arrays) or 'none'}")
        arrays = {part: arrays[part]}
    if found := _by_names(path, arrays):
        return found
    if found := _without_names(arrays):
        return found
    candidates: dict[str, _Found] = {}
    for name in arrays:
        found = _in_one(path, arrays[name])
        if found:
            candidates[name] = found
    if len(candidates) > 1:
        # Matrices of poses and cameras also have four columns.
        candidates = {
            name: found for name, found in candidates.items() if found.order or look_like_events(sampled(found.columns))
        } or candidates
    if len(candidates) != 1:
        raise RecordingError(_neither(path, arrays, list(candidates)))
    return next(iter(candidates.values()))


def _by_names(path: Path, arrays: Arrays) -> _Found | None:
    robust = "position" in arrays
    names = named([*arrays, "x", "y"] if robust else arrays)
    if names is None:
        return None
    x, y = _of_position(path, arrays["position"]) if robust else (arrays[names["x"]], arrays[names["y"]])
    columns = tuple(_flat(np.asarray(column)) for column in (x, y, arrays[names["t"]], arrays[names["p"]]))
    lengths = [column.shape for column in columns]
    if len({*lengths}) != 1 or columns[0].ndim != 1:
        raise RecordingError(f"{path}: columns of shapes {lengths}, expected one row per event")
    offset = np.asarray(arrays["t_offset"]) if "t_offset" in arrays else np.zeros(1)
    said = f"{offset.item()}" if offset.size == 1 and offset.item() else ""
    return _Found(columns, "ns" if robust else unit_of(names["t"]), offset=said)


def _without_names(arrays: Arrays) -> _Found | None:
    """Four columns with uninformative names, such as NumPy's defaults."""
    if len(arrays) != len(ROLES):
        return None
    columns = tuple(arrays[name] for name in arrays)
    if not all(isinstance(column, np.ndarray) and column.dtype.kind in "iubf" for column in columns):
        return None
    columns = tuple(map(_flat, columns))
    alike = len({column.shape for column in columns}) == 1 and columns[0].ndim == 1
    return _Found(columns, order=None) if alike else None


def _of_position(path: Path, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if position.ndim != 2 or position.shape[1] != 2:
        raise RecordingError(f"{path}: position is of shape {position.shape}, expected (events, 2)")
    return position[:, 0], position[:, 1]


def _flat(column: np.ndarray) -> np.ndarray:
    """Flatten MATLAB's vectors, which are matrices with one side of 1."""
    return column.reshape(-1) if column.ndim == 2 and 1 in column.shape else column


def _in_one(path: Path, array: Any) -> _Found | None:
    """The events of a struct, a structured array, or rows (or columns) of four numbers."""
    if isinstance(array, Mapping):
        return _by_names(path, array)
    if array.dtype.names:
        fields = {name: _flat(array)[name] for name in array.dtype.names}
        return _by_names(path, fields) or _without_names(fields)
    if array.ndim != 2 or 4 not in array.shape or array.dtype.kind not in "iubf":
        return None
    return _Found(tuple(array.T if array.shape[1] == 4 else array), order=None)


def _neither(path: Path, arrays: Arrays, candidates: list[str]) -> str:
    if candidates:
        return f"{path}: arrays {', '.join(candidates)} all look like events, expected one, or --part to choose"
    listed = ", ".join(f"{name} {getattr(arrays[name], 'shape', '')}".strip() for name in arrays) or "none"
    return f"{path}: arrays {listed:.200}, expected x, y (or position), t and p, or one of shape (events, 4)"


@contextmanager
def _npz(path: Path) -> Iterator[Arrays]:
    try:
        with opened_npz(path) as file:
            yield file
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: {error}") from None


@contextmanager
def _npy(path: Path) -> Iterator[Arrays]:
    try:
        array = np.load(path, mmap_mode="r")
    except Exception as error:
        # NumPy evaluates the header as Python: a damaged one can raise any exception.
        if "Python objects" in str(error):
            reason = "Python objects inside, which can run code; expected arrays of numbers, or an npz of them"
            raise RecordingError(f"{path}: {reason}") from None
        raise RecordingError(f"{path}: not a whole npy file of a plain array ({error})") from None
    if not isinstance(array, np.ndarray):
        raise RecordingError(f"{path}: not an npy file, expected rows of x, y, t and polarity")
    yield {"array": array}


@contextmanager
def _mat(path: Path) -> Iterator[Arrays]:
    try:
        check_elements(path.read_bytes())
        variables = loadmat(path)
        arrays = {
            inner: array
            for name, value in variables.items()
            if not name.startswith("__")
            for inner, array in _parts(name, _unwrapped(value))
        }
    except Exception as error:
        # A damaged file can raise any exception.
        raise RecordingError(f"{path}: not a whole MATLAB 5 file ({type(error).__name__}: {error})") from None
    yield arrays


def _unwrapped(value: Any) -> Any:
    """Convert a struct to a mapping, and an array of structs with a number in each field to a mapping of arrays."""
    if getattr(value, "dtype", None) is None or not value.dtype.names:
        return np.asarray(value)
    if value.size == 1:
        return {name: _unwrapped(value[name].item()) for name in value.dtype.names}
    fields = {name: value[name].reshape(-1) for name in value.dtype.names}
    if all(np.size(one) == 1 for field in fields.values() for one in field):
        return {name: np.array([np.asarray(one).item() for one in field]) for name, field in fields.items()}
    return np.asarray(value)


def _parts(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """A variable, and the structs within it by dotted names."""
    fields = value.items() if isinstance(value, Mapping) else ()
    structs = {inner: one for inner, one in fields if isinstance(one, Mapping)}
    if not structs or len(structs) < len(fields):
        yield name, value
    for inner, one in structs.items():
        yield from _parts(f"{name}.{inner}", one)


def _pieces(
    files: list[Path], opened: Callable[[Path], _Found], order: str, unit: TimeUnit, stated: bool
) -> Iterator[Piece]:
    before = None
    for path in files:
        found = opened(path)
        columns = found.by_role(order)
        if len(columns[2]) >= _FEW_ROWS:
            if before:
                _check_beside(path, columns[2], found.unit, before, stated)
            before = path.name, columns[2], found.unit
        for first in range(0, len(columns[0]), _EVENTS_AT_ONCE):
            x, y, t, p = (column[first : first + _EVENTS_AT_ONCE] for column in columns)
            x, y, p = (integers(path, column, name, first) for name, column in (("x", x), ("y", y), ("p", p)))
            yield Piece(x, y, _microseconds(path, t, unit, first), p, numbered(first, f"{path.name} row"))


def _check_beside(
    path: Path, t: np.ndarray, unit: TimeUnit | None, before: tuple[str, np.ndarray, TimeUnit | None], stated: bool
) -> None:
    """Raise :class:`RecordingError` for a file in another unit than the one before, or that counts from its start."""
    other, earlier, its_unit = before
    kinds = ["integers" if is_whole(column) else "fractions" for column in (t, earlier)]
    if unit != its_unit:
        kinds = [f"in {unit or 'no unit'}", f"in {its_unit or 'no unit'}"]
    elif stated and t.dtype.kind == earlier.dtype.kind:
        kinds = []
    if len({*kinds}) > 1:
        raise RecordingError(
            f"{path}: times are {kinds[0]}, those of {other} {kinds[1]}; expected one unit of time in all files"
        )
    # Whole files out of order can be sorted; those that count from their own start cannot.
    (start, end), (its_start, its_end) = ((float(column[0]), float(column[-1])) for column in (t, earlier))
    if 2 * (min(end, its_end) - max(start, its_start)) > min(end - start, its_end - its_start):
        raise RecordingError(
            f"{path}: times from {t[0]} to {t[-1]} lie over those of {other}, {earlier[0]} to {earlier[-1]}: does each "
            "file count from its own start? Expected times that go on from file to file"
        )


def _microseconds(path: Path, t: np.ndarray, unit: TimeUnit, first: int) -> np.ndarray:
    if t.dtype.kind not in "iuf" or not fits(t, unit).all():
        raise RecordingError(
            f"{path}: times from row {first:,} on are {t.dtype} or too large, expected times in {unit}"
        )
    return microseconds(t, unit)
