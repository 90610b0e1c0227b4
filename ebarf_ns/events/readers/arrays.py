"""NumPy's files: ``.npz`` with a column each, as Robust e-NeRF and EventNeRF have them, and ESIM's ``.npy`` rows."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ebarf_ns.errors import RecordingError
from ebarf_ns.events.readers.text import DECIMALS, TimeUnit
from ebarf_ns.events.source import Piece, Source, numbered

_EVENTS_AT_ONCE = 1 << 20
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
        with np.load(path) as file:
            columns = {name: file[name] for name in file.files}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise RecordingError(f"{path}: not a whole npz file of plain arrays ({error})") from None
    names = ", ".join(columns) or "none"
    robust = "position" in columns
    if robust and columns["position"].ndim == 2 and columns["position"].shape[1] == 2:
        columns["x"], columns["y"] = columns["position"].T
    chosen = {role: next((name for name in names if name in columns), None) for role, names in _NAMES.items()}
    if None in chosen.values():
        raise RecordingError(f"{path}: arrays {names}, expected x, y (or position), t and p")
    x, y, t, p = (columns[chosen[role] or ""] for role in "xytp")
    unit = time_unit or ("ns" if robust or chosen["t"] == "t_ns" else "s" if t.dtype.kind == "f" else "us")
    return Source(path, f"npz, times in {unit}", None, _pieces(path, (x, y, t, p), unit))


def read_npy_folder(folder: Path) -> Source:
    """ESIM's and E-NeRF's ``*.npy`` files, by name: rows (x, y, t in nanoseconds, polarity)."""
    files = sorted(folder.glob("*.npy"))
    if not files:
        raise RecordingError(f"{folder}: holds no .npy file, expected rows of events in files by time")
    return Source(folder, f"{len(files)} npy files, times in ns", None, _rows(files))


def _rows(files: list[Path]) -> Iterator[Piece]:
    for path in files:
        try:
            rows = np.load(path, mmap_mode="r")
        except (OSError, ValueError, EOFError) as error:
            raise RecordingError(f"{path}: not a whole npy file of a plain array ({error})") from None
        if rows.ndim != 2 or rows.shape[1] != 4:
            raise RecordingError(f"{path}: an array of shape {rows.shape}, expected rows of x, y, t and polarity")
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
    wrong = ~(np.isfinite(column) & (column == np.rint(column))) if column.dtype.kind == "f" else np.ones(1, bool)
    if wrong.any():
        row = int(wrong.argmax())
        raise RecordingError(f"{path}: {name} of row {first + row:,} is {column[row]!r:.30}, expected an integer")
    return column.astype(np.int64)


def _microseconds(path: Path, t: np.ndarray, unit: TimeUnit, first: int) -> np.ndarray:
    decimals = DECIMALS[unit]
    if t.dtype.kind in "iu":
        # Rounded to the nearest, exactly.
        return t.astype(np.int64) * 10**decimals if decimals >= 0 else (t.astype(np.int64) + 500) // 1000
    if t.dtype.kind != "f" or not np.isfinite(t).all():
        raise RecordingError(f"{path}: times from row {first:,} on are {t.dtype} or not finite, expected numbers")
    return np.rint(t.astype(np.float64) * 10.0**decimals).astype(np.int64)
