"""Convert any source to the scene's ``events.h5``: every event is checked, every loss reported, memory bounded.

An irregularity in a file is either an error; a repair that was requested or is unambiguous, and is counted; or
harmless, like equal times at different pixels.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from ebarf_ns.compiled import njit
from ebarf_ns.errors import RecordingError
from ebarf_ns.events.recording import Recording, joined, write_recording
from ebarf_ns.formats.event_checks import MAX_TIME_US, check_order, check_polarity, check_values, late, unwrapped
from ebarf_ns.formats.source import Piece, Source

if TYPE_CHECKING:
    from jaxtyping import Bool, Int64

_RUN = np.dtype([("t_us", "<i8"), ("x", "<u2"), ("y", "<u2"), ("polarity", "i1")])
_COARSE_US, _FEW_EVENTS = 100, 8
_MERGED_AT_ONCE, _SAMPLE_EVERY = 1 << 20, 1 << 10


@dataclass(frozen=True)
class Intake:
    """Filters and repairs applied to events on import."""

    unsorted: Literal["refuse", "sort"] = "refuse"
    """Events earlier than the previous ones: refuse the file, or sort it (stably)."""
    duplicates: Literal["keep", "drop"] = "keep"
    """Events equal in time and polarity to the last one of their pixel."""
    hot_pixels: float | None = None
    """Drop pixels with more events than the median of the active ones plus this many median deviations."""
    refractory_us: int = 0
    """Drop events closer than this to the last kept event of their pixel."""
    one_based: bool = False
    """Subtract 1 from x and y, for a source that counts pixels from 1, as MATLAB does."""
    flip_polarity: bool = False
    """Swap ON and OFF, for a source with inverted polarity."""
    flip_x: bool = False
    """Mirror columns, for events whose x counts from the right; frames and calibration are unchanged."""
    flip_y: bool = False
    """Mirror rows, for events whose y counts from the bottom; frames and calibration are unchanged."""
    crop: tuple[int, int, int, int] | None = None
    """Keep pixels from column X0 and row Y0 to column X1 and row Y1 (exclusive), after mirroring. The camera and its
    frames are cropped too."""
    time_offset_us: int = 0
    """Offset added to every time."""
    start_us: int | None = None
    """Drop events before this time, on the recording's clock after the offset."""
    end_us: int | None = None
    """Drop events after this time."""


@dataclass
class Extent:
    """Extremes of the pixels, and the common step of the times, while events are read."""

    left: int = 1 << 62
    top: int = 1 << 62
    right: int = -1
    bottom: int = -1
    first_us: int | None = None
    last_us: int = 0
    step_us: int = 1_000_000
    """The largest power of ten of which all times are multiples, after the first one."""
    events: int = 0

    def add(self, piece: Piece) -> None:
        """Take the events of a piece into account."""
        self.left, self.right = min(self.left, int(piece.x.min())), max(self.right, int(piece.x.max()))
        self.top, self.bottom = min(self.top, int(piece.y.min())), max(self.bottom, int(piece.y.max()))
        self.first_us = int(piece.t_us[0]) if self.first_us is None else self.first_us
        self.last_us, self.events = int(piece.t_us[-1]), self.events + len(piece)
        while self.step_us >= _COARSE_US and ((piece.t_us - self.first_us) % self.step_us).any():
            self.step_us //= 10

    def swapped(self, sensor_size: tuple[int, int]) -> bool:
        """Whether the events fit the sensor with x and y swapped."""
        return self.right < sensor_size[1] and self.bottom < sensor_size[0]

    def doubts(self, sensor_size: tuple[int, int] | None) -> list[str]:
        """Notes on coarse times, and on pixels that may be counted from 1."""
        found = []
        if self.events >= _FEW_EVENTS and self.step_us >= _COARSE_US and self.last_us != self.first_us:
            found.append(f"times are multiples of {self.step_us:,} us: rounded, or in another unit?")
        if sensor_size and (self.left, self.top, self.right + 1, self.bottom + 1) == (1, 1, *sensor_size):
            found.append("no event has an x or y of 0: are pixels counted from 1? Then use --one-based")
        return found


@dataclass
class IntakeReport:
    """Counts of events read, repaired and left out."""

    format: str = ""
    read: int = 0
    kept: int = 0
    first_us: int = 0
    last_us: int = 0
    left_out: Counter[str] = field(default_factory=Counter)
    repaired: Counter[str] = field(default_factory=Counter)
    notes: tuple[str, ...] = ()

    def sentences(self) -> list[str]:
        """The report as sentences."""
        span_s = (self.last_us - self.first_us) * 1e-6
        found = [f"{self.format}: {self.read:,} events read, {self.kept:,} kept, over {span_s:.3f} s", *self.notes]
        found += [f"left out: {count:,} {reason}" for reason, count in self.left_out.items() if count]
        found += [f"repaired: {count:,} {what}" for what, count in self.repaired.items() if count]
        return found


def take_in(
    source: Source,
    sensor_size: tuple[int, int],
    intake: Intake,
    output: Path,
    hot: Bool[np.ndarray, "pixels"] | None = None,
    progress: Callable[[int], None] = lambda events: None,
) -> IntakeReport:
    """Write ``output`` in the layout that :class:`~ebarf_ns.events.recording.RecordingFile` reads.

    ``hot`` marks pixels to leave out, see :func:`hot_pixels`. Raises :class:`RecordingError`, naming file, place, value
    and expectation, for anything but ordered events of a sensor of that size.
    """
    report = IntakeReport(source.format, notes=source.notes + _flips(intake))
    pieces = _checked(source, sensor_size, intake, report, progress)
    if intake.unsorted == "sort":
        pieces = _sorted(pieces, report)
    kept = _filtered(pieces, sensor_size, intake, hot, report)
    write_recording(output, _noted(kept, report), source.path)
    report.left_out += source.dropped
    return report


def _flips(intake: Intake) -> tuple[str, ...]:
    flipped = {"polarity": intake.flip_polarity, "x": intake.flip_x, "y": intake.flip_y}
    return (
        (f"flipped, as asked: {', '.join(name for name in flipped if flipped[name])}",) if any(flipped.values()) else ()
    )


def checked(source: Source, sensor_size: tuple[int, int]) -> Recording:
    """Read a small recording into memory; raises what :func:`take_in` raises."""
    return joined(_checked(source, sensor_size, Intake(), IntakeReport(), lambda events: None))


def hot_pixels(
    source: Source, sensor_size: tuple[int, int], intake: Intake, deviations: float
) -> Bool[np.ndarray, "pixels"]:
    """Pixels with more events over the whole recording than median + ``deviations`` x median absolute deviation.

    Statistics are over pixels with events; the deviation is at least a tenth of the median, so that evenly active
    sensors have no hot pixels.
    """
    width, height = sensor_size
    counts = np.zeros(width * height, np.int64)
    for piece in _checked(source, sensor_size, intake, IntakeReport(), lambda events: None):
        counts += np.bincount(piece.pixels(width), minlength=len(counts))
    return far_busier(counts, deviations)


def far_busier(counts: Int64[np.ndarray, "*pixels"], deviations: float) -> Bool[np.ndarray, "*pixels"]:
    """Pixels with far more events than the median, see :func:`hot_pixels`."""
    active = counts[counts > 0]
    if not len(active):
        return counts > 0
    middle = float(np.median(active))
    deviation = max(float(np.median(np.abs(active - middle))), 0.1 * middle)
    return counts > middle + deviations * deviation


def _checked(
    source: Source,
    sensor_size: tuple[int, int],
    intake: Intake,
    report: IntakeReport,
    progress: Callable[[int], None],
) -> Iterator[Recording]:
    """Pieces of valid events in file order, within the time window."""
    width, height = sensor_size
    wrapped_us, before_us, lowest, highest = 0, None, 1, 0
    extent = Extent()
    for piece in source.pieces:
        extent.add(piece)
        if intake.one_based:
            piece = _from_zero(source, piece)  # noqa: PLW2901
        else:
            _check_counted_from_zero(source, piece, extent, sensor_size)
        check_values(source, piece, width, height)
        lowest, highest = min(lowest, int(piece.polarity.min())), max(highest, int(piece.polarity.max()))
        check_polarity(source, piece, lowest, highest)
        t_us = piece.t_us + wrapped_us if wrapped_us else piece.t_us
        if late(t_us, before_us).any():
            t_us, wrapped_us = unwrapped(t_us.copy(), before_us, wrapped_us, report.repaired)
            check_order(source.path, piece, t_us, before_us, intake.unsorted, report.repaired)
        before_us = int(t_us[-1]) if before_us is None else max(before_us, int(t_us.max()))
        report.read += len(piece)
        progress(report.read)
        polarity = 2 * (piece.polarity > 0).view(np.int8) - 1
        x, y = (column.astype(np.uint16, copy=False) for column in (piece.x, piece.y))
        polarity = -polarity if intake.flip_polarity else polarity
        x = (width - 1 - x).astype(np.uint16) if intake.flip_x else x
        y = (height - 1 - y).astype(np.uint16) if intake.flip_y else y
        t_us = t_us + intake.time_offset_us if intake.time_offset_us else t_us
        yield _windowed(Recording(x, y, t_us, polarity), intake, report)
    report.notes += tuple(extent.doubts(None if intake.one_based else sensor_size))


def _from_zero(source: Source, piece: Piece) -> Piece:
    """Events with pixels counted from 0 instead of 1."""
    for name, column in (("x", piece.x), ("y", piece.y)):
        if column.min() < 1:
            raise RecordingError(
                f"{source.path}: {name} of {piece.place(int(column.argmin()))} is {column.min()}, expected 1 or more "
                "with --one-based"
            )
    return replace(piece, x=piece.x - 1, y=piece.y - 1)


def _check_counted_from_zero(source: Source, piece: Piece, extent: Extent, sensor_size: tuple[int, int]) -> None:
    """Raise :class:`RecordingError` for pixels just beyond a sensor whose first row and column have no events."""
    beyond = extent.right == sensor_size[0] or extent.bottom == sensor_size[1]
    if not beyond or extent.right > sensor_size[0] or extent.bottom > sensor_size[1] or extent.swapped(sensor_size):
        return
    if extent.left >= 1 and extent.top >= 1:
        names = ("x", piece.x, "width"), ("y", piece.y, "height")
        name, column, side = names[extent.right < sensor_size[0]]
        largest = int(column.max())
        raise RecordingError(
            f"{source.path}: {name} of {piece.place(int(column.argmax()))} is {largest}, expected 0 to {largest - 1}, "
            f"the sensor {side}; x is from {extent.left} to {extent.right} and y from {extent.top} to {extent.bottom}: "
            "counted from 1? Then use --one-based"
        )


def _windowed(events: Recording, intake: Intake, report: IntakeReport) -> Recording:
    if intake.start_us is None and intake.end_us is None:
        return events
    start_us = -MAX_TIME_US if intake.start_us is None else intake.start_us
    end_us = MAX_TIME_US if intake.end_us is None else intake.end_us
    inside = (events.t_us >= start_us) & (events.t_us <= end_us)
    report.left_out["events outside the time window"] += int(len(events) - np.count_nonzero(inside))
    return events.select(inside)


def _sorted(pieces: Iterable[Recording], report: IntakeReport) -> Iterator[Recording]:
    """Sort all events by time, stably, with an external merge sort in a temporary file."""
    with tempfile.TemporaryFile() as file:
        ends = [0]
        for piece in pieces:
            run = np.empty(len(piece), _RUN)
            for name in _RUN.names or ():
                run[name] = getattr(piece, name)
            file.write(run[np.argsort(run["t_us"], kind="stable")].tobytes())
            ends.append(ends[-1] + len(run))
        file.flush()
        if not ends[-1]:
            return
        events = np.memmap(file, _RUN, "r")
        runs = [events[begin:end] for begin, end in zip(ends, ends[1:], strict=False) if end > begin]
        samples = np.sort(np.concatenate([run["t_us"][::_SAMPLE_EVERY] for run in runs]))
        limits = [*np.unique(samples[:: _MERGED_AT_ONCE // _SAMPLE_EVERY])[1:].tolist(), None]
        places = [0] * len(runs)
        for limit in limits:
            until = [len(run) if limit is None else int(np.searchsorted(run["t_us"], limit)) for run in runs]
            merged = np.concatenate([run[a:b] for run, a, b in zip(runs, places, until, strict=True)])
            merged = merged[np.argsort(merged["t_us"], kind="stable")]
            places = until
            yield Recording(*(np.ascontiguousarray(merged[name]) for name in ("x", "y", "t_us", "polarity")))


def _filtered(
    pieces: Iterable[Recording],
    sensor_size: tuple[int, int],
    intake: Intake,
    hot: np.ndarray | None,
    report: IntakeReport,
) -> Iterator[Recording]:
    """Drop duplicates, hot pixels and events in the refractory period, as requested; empty pieces are skipped."""
    width, height = sensor_size
    last_us = np.full(width * height, -MAX_TIME_US)
    last_polarity = np.zeros(width * height, np.int8)
    of_hot = f"events of {np.count_nonzero(hot)} hot pixels" if hot is not None else ""
    for piece in pieces:
        if hot is not None:
            cold = ~hot[piece.pixels(width)]
            report.left_out[of_hot] += int(len(cold) - np.count_nonzero(cold))
            piece = piece.select(cold)  # noqa: PLW2901
        if intake.duplicates == "drop" or intake.refractory_us:
            columns = piece.pixels(width), piece.t_us, piece.polarity
            why = _superfluous(*columns, last_us, last_polarity, intake.duplicates == "drop", intake.refractory_us)
            report.left_out["duplicate events"] += int(np.count_nonzero(why == 1))
            report.left_out["events in the refractory period"] += int(np.count_nonzero(why == 2))
            piece = piece.select(why == 0)  # noqa: PLW2901
        if intake.crop:
            piece = _cropped(piece, intake.crop, report)  # noqa: PLW2901
        if len(piece):
            yield piece


def _cropped(events: Recording, crop: tuple[int, int, int, int], report: IntakeReport) -> Recording:
    left, top, right, bottom = crop
    inside = (events.x >= left) & (events.x < right) & (events.y >= top) & (events.y < bottom)
    report.left_out["events outside the crop"] += int(len(events) - np.count_nonzero(inside))
    kept = events.select(inside)
    return replace(kept, x=kept.x - np.uint16(left), y=kept.y - np.uint16(top))


@njit(cache=True)
def _superfluous(pixel, t_us, polarity, last_us, last_polarity, drop_equal, refractory_us):
    """1 for a duplicate of the pixel's last kept event, 2 for one too soon after it; kept events update the state."""
    why = np.zeros(len(pixel), np.int8)
    for i in range(len(pixel)):
        p = pixel[i]
        if drop_equal and t_us[i] == last_us[p] and polarity[i] == last_polarity[p]:
            why[i] = 1
        elif t_us[i] - last_us[p] < refractory_us:
            why[i] = 2
        else:
            last_us[p], last_polarity[p] = t_us[i], polarity[i]
    return why


def _noted(pieces: Iterable[Recording], report: IntakeReport) -> Iterator[Recording]:
    for piece in pieces:
        report.first_us = report.first_us if report.kept else int(piece.t_us[0])
        report.last_us = int(piece.t_us[-1])
        report.kept += len(piece)
        yield piece
