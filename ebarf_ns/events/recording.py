"""The recording: event columns with int64 microseconds, read from HDF5 with every value checked."""

from dataclasses import dataclass
from pathlib import Path

import h5py
import hdf5plugin  # noqa: F401  registers the compression filters of TUM-VIE and DSEC with HDF5
import numpy as np
from jaxtyping import Bool, Int8, Int64, UInt16

from ebarf_ns.errors import RecordingError
from ebarf_ns.files import whole_file

# Also the longest recording that gets a ms_to_idx table: about 6 days.
_MAX_SPAN_US = 1 << 39
_MAX_TIME_US = 1 << 61


@dataclass(frozen=True)
class Recording:
    """Events in non-decreasing time; ``x`` is the column and ``y`` the row, origin top left."""

    x: UInt16[np.ndarray, "events"]
    y: UInt16[np.ndarray, "events"]
    t_us: Int64[np.ndarray, "events"]
    polarity: Int8[np.ndarray, "events"]
    """+1 brighter, -1 darker."""

    def __len__(self) -> int:
        return len(self.t_us)

    def select(self, which: slice | Bool[np.ndarray, "events"]) -> "Recording":
        """The events at a slice or mask."""
        return Recording(self.x[which], self.y[which], self.t_us[which], self.polarity[which])

    def between(self, start_us: int, end_us: int) -> "Recording":
        """The events from ``start_us`` to ``end_us``, both included."""
        first, last = np.searchsorted(self.t_us, [start_us, end_us + 1])
        return self.select(slice(first, last))


def read_recording(path: Path, width: int, height: int) -> Recording:
    """Read ``/events/{x,y,t,p}`` and ``/t_offset`` of a TUM-VIE or DSEC style file.

    Raises :class:`RecordingError` naming file, column, row, value and expectation for anything that does not fit a
    ``width`` x ``height`` sensor; nothing is repaired or dropped.
    """
    try:
        with h5py.File(path, "r") as file:
            columns = {name: _read_column(file, path, name) for name in ("x", "y", "t", "p")}
            t_offset_us = int(np.asarray(file["t_offset"])) if "t_offset" in file else 0
    except OSError as error:
        reason = "no such file, expected the recording" if not path.exists() else f"not a readable HDF5 file ({error})"
        raise RecordingError(f"{path}: {reason}") from None
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise RecordingError(f"{path}: columns of /events differ in length, {lengths}; expected one row per event")
    if not lengths["t"]:
        raise RecordingError(f"{path}: /events is empty, expected at least one event")
    _check(path, "x", columns["x"], (columns["x"] < 0) | (columns["x"] >= width), f"0 to {width - 1}, the sensor width")
    _check(
        path, "y", columns["y"], (columns["y"] < 0) | (columns["y"] >= height), f"0 to {height - 1}, the sensor height"
    )
    _check(path, "p", columns["p"], (columns["p"] < 0) | (columns["p"] > 1), "0 (darker) or 1 (brighter)")
    t = columns["t"]
    _check(path, "t", t, (t > _MAX_TIME_US) | (t < -_MAX_TIME_US), f"microseconds within ±{_MAX_TIME_US}")
    t_us = t.astype(np.int64)
    _check(path, "t", columns["t"], np.r_[False, t_us[1:] < t_us[:-1]], "a time not before that of the event above it")
    return Recording(
        columns["x"].astype(np.uint16),
        columns["y"].astype(np.uint16),
        t_us + t_offset_us,
        (2 * columns["p"].astype(np.int8) - 1).astype(np.int8),
    )


def _read_column(file: h5py.File, path: Path, name: str) -> np.ndarray:
    dataset = file.get(f"events/{name}")
    if not isinstance(dataset, h5py.Dataset) or dataset.ndim != 1:
        raise RecordingError(f"{path}: dataset /events/{name} is missing, expected one column of integers")
    if dataset.dtype.kind not in "iub":
        raise RecordingError(f"{path}: /events/{name} holds {dataset.dtype}, expected integers")
    column = dataset[:]
    return column.astype(np.uint8) if dataset.dtype.kind == "b" else column


def _check(path: Path, name: str, column: np.ndarray, wrong: np.ndarray, expected: str) -> None:
    if wrong.any():
        row = int(wrong.argmax())
        raise RecordingError(
            f"{path}: /events/{name} row {row} is {column[row]}, expected {expected} "
            f"({np.count_nonzero(wrong):,} such rows of {len(column):,})"
        )


def write_recording(path: Path, recording: Recording) -> None:
    """Write the layout that :func:`read_recording` reads, with ``/ms_to_idx`` and the first millisecond as offset."""
    t_offset_us = int(recording.t_us[0]) // 1000 * 1000
    t_us = recording.t_us - t_offset_us
    if t_us[-1] >= _MAX_SPAN_US:
        raise RecordingError(f"{path}: the recording spans {t_us[-1]} us, expected less than {_MAX_SPAN_US}")
    with whole_file(path) as temporary, h5py.File(temporary, "w") as file:
        group = file.create_group("events")
        group["x"], group["y"], group["t"] = recording.x, recording.y, t_us
        group["p"] = (recording.polarity > 0).astype(np.uint8)
        milliseconds = np.arange(int(t_us[-1]) // 1000 + 2)
        file["ms_to_idx"] = np.searchsorted(t_us, milliseconds * 1000).astype(np.uint64)
        file["t_offset"] = np.int64(t_offset_us)
