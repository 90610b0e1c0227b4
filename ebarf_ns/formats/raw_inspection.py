"""Inspection of a raw recording, before it becomes a scene."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ebarf_ns.errors import RecordingError
from ebarf_ns.files import whole_file, write_picture
from ebarf_ns.formats.event_checks import check_polarity
from ebarf_ns.formats.intake import Extent, far_busier
from ebarf_ns.formats.source import Piece, Source
from ebarf_ns.printing import print_facts

_LARGEST_SENSOR = 8192
_SLOT_US = 100_000
_HOTTEST, _HOT_DEVIATIONS = 5, 50
_PICTURES, _PICTURE_US = 12, 20_000
_SHORTEST_US, _FEW_A_MOMENT = 50_000, 2
_BARS = " ▁▂▃▄▅▆▇█"


@dataclass(frozen=True)
class RawSummary:
    """Statistics of a recording; ``suspicions`` are sentences for the user."""

    format: str
    events: int
    width: int
    height: int
    sensor_size_said: bool
    """Whether the file gives the size; else it is the smallest that contains all events."""
    start_us: int
    end_us: int
    events_per_second: float
    busiest_events_per_second: float
    """Rate in the busiest tenth of a second."""
    brighter_share: float
    hottest_pixels: list[tuple[int, int, int]]
    """Column, row and event count, the busiest first."""
    rate: list[int]
    """Events in equal parts of the recording's time."""
    suspicions: list[str] = field(default_factory=list)


def inspect_recording(open_events: Callable[[], Source], parts: int = 40) -> RawSummary:
    """Read a recording once and summarise it; raises :class:`RecordingError` if it cannot be read."""
    source = open_events()
    counts = np.zeros((1, 1), np.int64)
    slots: dict[int, int] = {}
    events = brighter = late = moments = 0
    first_us, last_us, before_us = None, 0, None
    lowest, highest, extent = 1, 0, Extent()
    for piece in source.pieces:
        extent.add(piece)
        lowest, highest = min(lowest, int(piece.polarity.min())), max(highest, int(piece.polarity.max()))
        check_polarity(source, piece, lowest, highest)
        counts = _count(source.path, counts, piece)
        slot, number = np.unique(piece.t_us // _SLOT_US, return_counts=True)
        for one, many in zip(slot.tolist(), number.tolist(), strict=True):
            slots[one] = slots.get(one, 0) + many
        late += int(np.count_nonzero(np.diff(piece.t_us, prepend=before_us or piece.t_us[0]) < 0))
        moments += int(np.count_nonzero(np.diff(piece.t_us))) + (before_us != piece.t_us[0])
        before_us = int(piece.t_us[-1])
        first_us = int(piece.t_us.min()) if first_us is None else min(first_us, int(piece.t_us.min()))
        last_us = max(last_us, int(piece.t_us.max())) if events else int(piece.t_us.max())
        events += len(piece)
        brighter += int(np.count_nonzero(piece.polarity > 0))
    if first_us is None:
        raise RecordingError(f"{source.path}: holds no event, expected some")
    height, width = counts.shape
    said = source.sensor_size
    seconds = max((last_us - first_us) * 1e-6, 1e-6)
    busiest = np.argsort(counts.ravel())[::-1][:_HOTTEST].tolist()
    return RawSummary(
        format="; ".join([source.format, *source.notes]),
        events=events,
        width=said[0] if said else width,
        height=said[1] if said else height,
        sensor_size_said=said is not None,
        start_us=first_us,
        end_us=last_us,
        events_per_second=events / seconds,
        busiest_events_per_second=max(slots.values()) * 1e6 / _SLOT_US,
        brighter_share=brighter / events,
        hottest_pixels=[(k % width, k // width, int(counts.ravel()[k])) for k in busiest],
        rate=_rates(slots, first_us, last_us, parts),
        suspicions=[
            *_suspicions(source, counts, brighter / events, late),
            *_doubts(source, events, moments, last_us - first_us),
            *extent.doubts(said or (width, height)),
        ],
    )


def _count(path: Path, counts: np.ndarray, piece: Piece) -> np.ndarray:
    """Add a piece to the event counts per pixel, growing the array to fit all coordinates."""
    x, y = piece.x.astype(np.int64), piece.y.astype(np.int64)
    width, height = max(int(x.max()) + 1, counts.shape[1]), max(int(y.max()) + 1, counts.shape[0])
    if min(int(x.min()), int(y.min())) < 0 or max(width, height) > _LARGEST_SENSOR:
        raise RecordingError(
            f"{path}: x from {x.min()} to {x.max()} and y from {y.min()} to {y.max()} around {piece.place(0)}, "
            f"expected 0 to {_LARGEST_SENSOR - 1} at most"
        )
    if (height, width) != counts.shape:
        counts = np.pad(counts, ((0, height - counts.shape[0]), (0, width - counts.shape[1])))
    return counts + np.bincount(y * width + x, minlength=height * width).reshape(height, width)


def _rates(slots: dict[int, int], first_us: int, last_us: int, parts: int) -> list[int]:
    edges = np.linspace(first_us, last_us + 1, parts + 1)
    centres = (np.array(list(slots)) + 0.5) * _SLOT_US
    return np.histogram(centres.clip(first_us, last_us), edges, weights=list(slots.values()))[0].astype(int).tolist()


def _suspicions(source: Source, counts: np.ndarray, brighter: float, late: int) -> list[str]:
    found = [f"{count:,} {reason}" for reason, count in source.dropped.items() if count]
    height, width = counts.shape
    if source.sensor_size and (width > source.sensor_size[0] or height > source.sensor_size[1]):
        found.append(f"events reach {width} x {height} pixels, beyond the sensor that the file says")
    if late:
        found.append(f"{late:,} events are earlier than the one before them; ebarf process has --unsorted sort")
    if not 0.35 < brighter < 0.65:
        found.append(f"{brighter:.0%} of the events are brighter: unequal thresholds, or polarity lost?")
    hot = int(np.count_nonzero(far_busier(counts, _HOT_DEVIATIONS)))
    if hot:
        found.append(
            f"{hot} pixels are more than {_HOT_DEVIATIONS} deviations busier than usual; ebarf process has --hot-pixels"
        )
    return found


def _doubts(source: Source, events: int, moments: int, span_us: int) -> list[str]:
    """Doubts about a guessed time unit: milliseconds and frame numbers give few distinct, close times."""
    if not source.guessed_unit or span_us >= _SHORTEST_US or events < _FEW_A_MOMENT * moments:
        return []
    return [
        f"{moments:,} distinct times for {events:,} events, over {span_us / 1000:.3f} ms if they are in "
        f"{source.guessed_unit}: are they numbers of frames, or in another unit? ebarf process has --event-time-unit"
    ]


def contact_sheet(open_events: Callable[[], Source], summary: RawSummary, output: Path) -> None:
    """Write one PNG with evenly spaced event images of 20 ms each."""
    middles = np.linspace(summary.start_us, summary.end_us, 2 * _PICTURES + 1)[1::2]
    starts = (middles - _PICTURE_US / 2).astype(np.int64)
    pictures = np.zeros((_PICTURES, summary.height, summary.width), np.int64)
    for piece in open_events().pieces:
        for picture, start_us in zip(pictures, starts.tolist(), strict=True):
            inside = (piece.t_us >= start_us) & (piece.t_us < start_us + _PICTURE_US)
            inside &= (piece.x < summary.width) & (piece.y < summary.height)
            signs = np.where(piece.polarity[inside] > 0, 1, -1)
            np.add.at(picture, (piece.y[inside].astype(np.int64), piece.x[inside].astype(np.int64)), signs)
    grey = (128 + np.clip(64 * pictures, -128, 127)).astype(np.uint8)
    columns = 4
    framed = np.pad(grey, ((0, 0), (2, 2), (2, 2)), constant_values=255)
    rows = [np.hstack(list(framed[k : k + columns])) for k in range(0, _PICTURES, columns)]
    with whole_file(output) as temporary:
        write_picture(temporary, np.vstack(rows))


def print_raw_summary(summary: RawSummary, path: Path) -> None:
    """Print the summary, suspicions first."""
    seconds = (summary.end_us - summary.start_us) * 1e-6
    size = f"{summary.width} x {summary.height}"
    most = max(1, *summary.rate)
    facts = [
        ("format", summary.format),
        ("sensor", size if summary.sensor_size_said else f"{size} at least, by its events; the file does not say"),
        ("events", f"{summary.events:,} over {seconds:.3f} s, {summary.events_per_second:,.0f} a second"),
        ("busiest", f"{summary.busiest_events_per_second:,.0f} a second, in a tenth of a second"),
        ("rate", "".join(_BARS[round(one / most * (len(_BARS) - 1))] for one in summary.rate)),
        ("time", f"{summary.start_us:,} to {summary.end_us:,} us"),
        ("polarity", f"{summary.brighter_share:.1%} brighter, {1 - summary.brighter_share:.1%} darker"),
        ("busiest pixels", ", ".join(f"({x}, {y}) {count:,}" for x, y, count in summary.hottest_pixels)),
    ]
    print_facts(path, summary.suspicions, facts)
