"""The recording: event columns with int64 microseconds, read from HDF5 in chunks with every value checked."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np

from ebarf_ns.errors import RecordingError
from ebarf_ns.files import is_special, whole_file

if TYPE_CHECKING:
    from jaxtyping import Bool, Int8, Int64, UInt8, UInt16

with suppress(ImportError):
    import hdf5plugin  # noqa: F401  registers the compression filters of TUM-VIE and DSEC with HDF5

# Also the longest recording that gets a ms_to_idx table: about 6 days.
_MAX_SPAN_US = 1 << 39
_MAX_TIME_US = 1 << 61
# No compression of events comes near it.
_MOST_COMPRESSED = 1_000_000
_CHUNK = 1 << 17


@dataclass(frozen=True)
class Recording:
    """Events in non-decreasing time order; ``x`` is the column and ``y`` the row, origin at the top left."""

    x: UInt16[np.ndarray, "events"]
    y: UInt16[np.ndarray, "events"]
    t_us: Int64[np.ndarray, "events"]
    polarity: Int8[np.ndarray, "events"]
    """+1 brighter, -1 darker."""

    def __len__(self) -> int:
        return len(self.t_us)

    def select(self, which: slice | Bool[np.ndarray, "events"]) -> Recording:
        """The events selected by a slice or mask."""
        return Recording(self.x[which], self.y[which], self.t_us[which], self.polarity[which])

    def between(self, start_us: int, end_us: int) -> Recording:
        """The events from ``start_us`` to ``end_us``, inclusive."""
        first, last = np.searchsorted(self.t_us, [start_us, end_us + 1])
        return self.select(slice(first, last))

    def pixels(self, width: int) -> Int64[np.ndarray, "events"]:
        """Row-major index y * width + x of each event's pixel."""
        return self.y.astype(np.int64) * width + self.x


@dataclass(frozen=True)
class RecordingFile:
    """An HDF5 file of any size in the layout of TUM-VIE or DSEC, ``/events/{x,y,t,p}`` and ``/t_offset``.

    Nothing is repaired or dropped: every read raises :class:`RecordingError`, naming file, column, row, value and
    expectation, for data that does not fit a ``width`` x ``height`` sensor.
    """

    path: Path
    width: int
    height: int

    def span(self) -> tuple[int, int, int]:
        """Number of events, and times of the first and last one in microseconds; only these two are read."""
        with self._columns() as (columns, t_offset_us):
            count = len(columns["t"])
            first = next(self._pieces(columns, t_offset_us, 0, 1, 1))
            before = int(first.t_us[0]) - t_offset_us
            last = next(self._pieces(columns, t_offset_us, count - 1, count, 1, before))
            return count, int(first.t_us[0]), int(last.t_us[0])

    def chunks(self, size: int = 1 << 22) -> Iterator[Recording]:
        """All events, at most ``size`` at a time."""
        with self._columns() as (columns, t_offset_us):
            yield from self._pieces(columns, t_offset_us, 0, len(columns["t"]), size)

    def window(self, start_us: int, end_us: int) -> Recording:
        """The events from ``start_us`` to ``end_us``, inclusive, found by bisection; the rest is not read."""
        with self._columns() as (columns, t_offset_us):
            t = columns["t"]
            first, last = bisect_left(t, start_us - t_offset_us), bisect_right(t, end_us - t_offset_us)
            return joined(self._pieces(columns, t_offset_us, first, last, 1 << 22))

    def _pieces(
        self,
        columns: dict[str, h5py.Dataset],
        t_offset_us: int,
        first: int,
        last: int,
        size: int,
        before: int | None = None,
    ) -> Iterator[Recording]:
        for begin in range(first, last, size):
            piece = {name: column[begin : min(begin + size, last)] for name, column in columns.items()}
            self._check(piece, begin, before)
            t_us = piece["t"].astype(np.int64)
            before = int(t_us[-1])
            yield Recording(
                piece["x"].astype(np.uint16, copy=False),
                piece["y"].astype(np.uint16, copy=False),
                t_us + t_offset_us,
                (2 * piece["p"].astype(np.int8) - 1).astype(np.int8),
            )

    @contextmanager
    def _columns(self) -> Iterator[tuple[dict[str, h5py.Dataset], int]]:
        path = self.path
        if is_special(path):
            raise RecordingError(f"{path}: a pipe or a device, expected a file")
        try:
            with h5py.File(path, "r") as file:
                columns = {name: self._column(file, name) for name in ("x", "y", "t", "p")}
                lengths = {name: len(column) for name, column in columns.items()}
                if len(set(lengths.values())) > 1:
                    raise RecordingError(
                        f"{path}: columns of /events differ in length, {lengths}; expected one row per event"
                    )
                if not lengths["t"]:
                    raise RecordingError(f"{path}: /events is empty, expected at least one event")
                for name, column in columns.items():
                    if not is_stored(column):
                        raise RecordingError(f"{path}: /events/{name} declares {len(column):,} events and stores none")
                t_offset_us = self._offset_us(file)
                if abs(t_offset_us) > _MAX_TIME_US:
                    raise RecordingError(f"{path}: /t_offset is {t_offset_us}, expected within ±{_MAX_TIME_US} us")
                yield columns, t_offset_us
        except OSError as error:
            missing = "no such file, expected the recording"
            reason = missing if not path.exists() else f"not a readable HDF5 file ({error})"
            raise RecordingError(f"{path}: {reason}") from None

    def _offset_us(self, file: h5py.File) -> int:
        offset = file.get("t_offset")
        if offset is None:
            return 0
        if not isinstance(offset, h5py.Dataset) or offset.size != 1 or offset.dtype.kind not in "iu":
            raise RecordingError(f"{self.path}: /t_offset is not one integer, expected a time in microseconds")
        return int(np.asarray(offset).item())

    def _column(self, file: h5py.File, name: str) -> h5py.Dataset:
        dataset = file.get(f"events/{name}")
        if not isinstance(dataset, h5py.Dataset) or dataset.ndim != 1:
            raise RecordingError(f"{self.path}: dataset /events/{name} is missing, expected one column of integers")
        if dataset.dtype.kind not in "iub":
            raise RecordingError(f"{self.path}: /events/{name} holds {dataset.dtype}, expected integers")
        return dataset

    def _check(self, piece: dict[str, np.ndarray], begin: int, before: int | None) -> None:
        """``begin`` is the row of the piece's first event, ``before`` the time of the previous event."""
        x, y, t, p = (piece[name].view(np.uint8) if piece[name].dtype == bool else piece[name] for name in "xytp")
        t_us = t.astype(np.int64)
        late = np.r_[before is not None and bool(t_us[0] < before), t_us[1:] < t_us[:-1]]
        for name, wrong, expected in (
            ("x", (x < 0) | (x >= self.width), f"0 to {self.width - 1}, the sensor width"),
            ("y", (y < 0) | (y >= self.height), f"0 to {self.height - 1}, the sensor height"),
            ("p", (p < 0) | (p > 1), "0 (darker) or 1 (brighter)"),
            ("t", (t > _MAX_TIME_US) | (t < -_MAX_TIME_US), f"microseconds within ±{_MAX_TIME_US}"),
            ("t", late, "a time not before those of the events above it"),
        ):
            if wrong.any():
                row = int(wrong.argmax())
                others = f" ({np.count_nonzero(wrong):,} such rows of the {len(t):,} from row {begin} on)"
                raise RecordingError(
                    f"{self.path}: /events/{name} row {begin + row} is {piece[name][row]}, expected {expected}"
                    f"{others if len(t) > 1 else ''}"
                )


def read_recording(path: Path, width: int, height: int) -> Recording:
    """Read a whole :class:`RecordingFile` into memory."""
    return joined(RecordingFile(path, width, height).chunks())


def joined(pieces: Iterable[Recording]) -> Recording:
    """Concatenate consecutive pieces into one recording."""
    empty = Recording(np.zeros(0, np.uint16), np.zeros(0, np.uint16), np.zeros(0, np.int64), np.zeros(0, np.int8))
    parts = list(pieces) or [empty]
    columns = ("x", "y", "t_us", "polarity")
    return Recording(*(np.concatenate([getattr(part, name) for part in parts]) for name in columns))


def write_recording(path: Path, pieces: Iterable[Recording], source: Path | None = None) -> None:
    """Write the layout that :class:`RecordingFile` reads, with ``/ms_to_idx`` and the first millisecond as offset.

    The pieces must be in time order. Raises :class:`RecordingError`, which names ``source`` if given, for no events and
    for a span over 6 days.
    """
    count = offset_us = begun_ms = 0
    columns: dict[str, h5py.Dataset] = {}
    with whole_file(path) as temporary, h5py.File(temporary, "w") as file:
        for piece in pieces:
            if not len(piece):
                continue
            if not columns:
                offset_us = int(piece.t_us[0]) // 1000 * 1000
                columns = _columns(file)
            t_us = piece.t_us - offset_us
            if t_us[-1] >= _MAX_SPAN_US:
                raise RecordingError(
                    f"{source or path}: the events span {t_us[-1]} us, expected less than {_MAX_SPAN_US}"
                )
            # The milliseconds that begin after the previous piece's last event and up to this piece's last one.
            until_ms = int(t_us[-1]) // 1000 + 1
            for first_ms in range(begun_ms, until_ms, _CHUNK):
                milliseconds = np.arange(first_ms, min(first_ms + _CHUNK, until_ms))
                _append(columns["ms_to_idx"], count + np.searchsorted(t_us, 1000 * milliseconds))
            begun_ms = until_ms
            for name, values in (("x", piece.x), ("y", piece.y), ("t", t_us), ("p", piece.polarity > 0)):
                _append(columns[name], values)
            count += len(piece)
        if not count:
            raise RecordingError(f"{source or path}: no event is left, expected some")
        _append(columns["ms_to_idx"], np.array([count]))
        file["t_offset"] = np.int64(offset_us)


def is_stored(dataset: h5py.Dataset) -> bool:
    """Whether a file can hold what a dataset declares: chunks that were never written cost nothing."""
    declared = len(dataset) * dataset.dtype.itemsize
    return dataset.is_virtual or declared <= _MOST_COMPRESSED * dataset.id.get_storage_size()


def _columns(file: h5py.File) -> dict[str, h5py.Dataset]:
    growing = {"shape": (0,), "maxshape": (None,), "chunks": (_CHUNK,)}
    columns = {
        name: file.create_dataset(f"events/{name}", dtype=dtype, **growing)
        for name, dtype in (("x", "<u2"), ("y", "<u2"), ("t", "<i8"), ("p", "u1"))
    }
    # Long silences repeat one number, which compresses well.
    index = file.create_dataset("ms_to_idx", dtype="<u8", compression="gzip", compression_opts=1, **growing)
    return {**columns, "ms_to_idx": index}


def _append(column: h5py.Dataset, values: np.ndarray) -> None:
    column.resize((len(column) + len(values),))
    column[len(column) - len(values) :] = values


def accumulate(recording: Recording, width: int, height: int) -> UInt8[np.ndarray, "height width"]:
    """Render events as a grey image: mid-grey where there are none, brighter or darker by the polarity sum."""
    picture = np.zeros(width * height, np.int64)
    np.add.at(picture, recording.pixels(width), recording.polarity)
    return (128 + np.clip(32 * picture, -128, 127)).astype(np.uint8).reshape(height, width)
