"""NumPy's files: ``.npz`` with a column each, as Robust e-NeRF and EventNeRF have them, and ESIM's ``.npy`` rows."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ebarf_ns.errors import RecordingError
from ebarf_ns.events.source import Piece, Source, TimeUnit, fits, microseconds, numbered
from ebarf_ns.files import opened_npz

_EVENTS_AT_ONCE = 1 << 20
_EXACT = 2.0**53  # floats beyond are no exact integers
_NAMES = {
    "x": ("x", "xs"), "y": ("y", "ys"), "t": ("t", "ts", "timestamp", "timestamps", "t_us", "t_ns"),
    "p": ("p", "ps", "pol", "polarity"),
}  # fmt: skip


def read_npz(path: Path, time_unit: TimeUnit | None = None) -> Source:
    """Columns x, y (or ``position``, a row each), t and p; raises :class:`RecordingError`.

    Times are nanoseconds in Robust e-NeRF's files (which have ``position``) and under the name ``t_ns``, seconds where
    they are floats, and else microseconds, unless ``time_unit`` says otherwise.
    """
    try:
        with opened_npz(path) as file:
            chosen = {role: next((name for name in names if name in file), None) for role, names in _NAMES.items()}
            robust = "position" in file
            if not (chosen["t"] and chosen["p"] and (robust or (chosen["x"] and chosen["y"]))):
                names = ", ".join(file) or "none"
                raise RecordingError(f"{path}: arrays {names}, expected x, y (or position), t and p")
            t, p = file[chosen["t"]], file[chosen["p"]]
            x, y = _columns(path, file["position"]) if robust else (file[chosen["x"]], file[chosen["y"]])
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: {error}") from None
    unit = time_unit or ("ns" if robust or chosen["t"] == "t_ns" else "s" if t.dtype.kind == "f" else "us")
    return Source(path, f"npz, times in {unit}", None, _pieces(path, (x, y, t, p), unit))


def _columns(path: Path, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if position.ndim != 2 or position.shape[1] != 2:
        raise RecordingError(f"{path}: position is of shape {position.shape}, expected (events, 2)")
    return position[:, 0], position[:, 1]


def read_npy(path: Path) -> Source:
    """ESIM's and E-NeRF's ``*.npy`` files, by name, or one: rows (x, y, t in nanoseconds, polarity)."""
    files = sorted(path.glob("*.npy")) if path.is_dir() else [path]
    if not files:
        raise RecordingError(f"{path}: holds no .npy file, expected rows of events in files by time")
    return Source(path, f"{len(files)} npy files, times in ns", None, _rows(files))


def _rows(files: list[Path]) -> Iterator[Piece]:
    for path in files:
        try:
            rows = np.load(path, mmap_mode="r")
        except Exception as error:
            # NumPy reads the header as Python: what a damaged one makes it raise has no common kind.
            raise RecordingError(f"{path}: not a whole npy file of a plain array ({error})") from None
        shape = getattr(rows, "shape", "none")
        if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.shape[1] != 4:
            raise RecordingError(f"{path}: an array of shape {shape}, expected rows of x, y, t and polarity")
        yield from _pieces(path, tuple(rows.T), "ns")


def _pieces(path: Path, columns: tuple[np.ndarray, ...], unit: TimeUnit) -> Iterator[Piece]:
    lengths = [column.shape for column in columns]
    if len({*lengths}) != 1 or columns[0].ndim != 1:
        raise RecordingError(f"{path}: columns of shapes {lengths}, expected one row per event")
    for first in range(0, len(columns[0]), _EVENTS_AT_ONCE):
        x, y, t, p = (column[first : first + _EVENTS_AT_ONCE] for column in columns)
        x, y, p = (_integers(path, column, name, first) for name, column in (("x", x), ("y", y), ("p", p)))
        yield Piece(x, y, _microseconds(path, t, unit, first), p, numbered(first, f"{path.name} row"))


def _integers(path: Path, column: np.ndarray, name: str, first: int) -> np.ndarray:
    """As integers, which floats may be too, as in ESIM's rows."""
    if column.dtype.kind in "iub":
        return column.astype(np.uint8) if column.dtype == bool else np.asarray(column)
    whole = (np.abs(column) < _EXACT) & (column == np.rint(column)) if column.dtype.kind == "f" else np.zeros(1, bool)
    if not whole.all():
        row = int(whole.argmin())
        raise RecordingError(f"{path}: {name} of row {first + row:,} is {column[row]!r:.30}, expected an integer")
    return column.astype(np.int64)


def _microseconds(path: Path, t: np.ndarray, unit: TimeUnit, first: int) -> np.ndarray:
    if t.dtype.kind not in "iuf" or not fits(t, unit).all():
        raise RecordingError(
            f"{path}: times from row {first:,} on are {t.dtype} or too large, expected times in {unit}"
        )
    return microseconds(t, unit)
