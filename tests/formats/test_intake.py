"""No event is lost silently on import."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ebarf_ns.errors import RecordingError
from ebarf_ns.events.recording import Recording, read_recording
from ebarf_ns.formats import intake as intake_module
from ebarf_ns.formats.intake import Intake, IntakeReport, hot_pixels, take_in
from ebarf_ns.formats.source import Piece, Source, numbered
from tests.formats import writers

SIZE = (24, 18)


def source(events: Sequence[writers.Event], piece: int = 7) -> Source:
    def pieces():
        for first in range(0, len(events), piece):
            t, x, y, p = (np.array(c, np.int64) for c in zip(*events[first : first + piece], strict=True))
            yield Piece(x, y, t, p, numbered(first))

    return Source(Path("camera.bin"), "a test", SIZE, pieces(), Counter())


def taken(folder: Path, events: Sequence[writers.Event], **intake: object) -> tuple[Recording, IntakeReport]:
    report = take_in(source(events), SIZE, Intake(**intake), folder / "events.h5")  # pyright: ignore[reportArgumentType]
    return read_recording(folder / "events.h5", *SIZE), report


EVENT = st.tuples(st.integers(-5000, 5000), st.integers(0, 23), st.integers(0, 17), st.integers(0, 1))


@given(st.lists(EVENT, min_size=1).map(sorted), st.integers(1, 9))
def test_ordered_events_are_unchanged(tmp_path_factory: pytest.TempPathFactory, events: list, piece: int):
    path = tmp_path_factory.mktemp("intake") / "events.h5"
    report = take_in(source(events, piece), SIZE, Intake(), path)
    back, expected = read_recording(path, *SIZE), writers.recording(events)
    for column in ("x", "y", "t_us", "polarity"):
        assert np.array_equal(getattr(back, column), getattr(expected, column))
    assert report.read == report.kept == len(events) and not report.left_out and not report.repaired
    with h5py.File(path) as file:
        times, index = np.asarray(file["events/t"]), np.asarray(file["ms_to_idx"])
        assert len(index) == times[-1] // 1000 + 2
        for millisecond, first in enumerate(index):
            assert (times[first:] >= millisecond * 1000).all() and (times[:first] < millisecond * 1000).all()


@given(st.lists(EVENT, min_size=1), st.integers(1, 9))
def test_sorting_is_stable_and_loses_nothing(tmp_path_factory: pytest.TempPathFactory, events: list, piece: int):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(intake_module, "_MERGED_AT_ONCE", 4)
        patch.setattr(intake_module, "_SAMPLE_EVERY", 2)
        path = tmp_path_factory.mktemp("intake") / "events.h5"
        report = take_in(source(events, piece), SIZE, Intake(unsorted="sort"), path)
    expected = writers.recording(sorted(events, key=lambda event: event[0]))
    back = read_recording(path, *SIZE)
    for column in ("x", "y", "t_us", "polarity"):
        assert np.array_equal(getattr(back, column), getattr(expected, column))
    assert bool(report.repaired) == (events != sorted(events, key=lambda event: event[0]))


@pytest.mark.parametrize(
    ("event", "words"),
    [
        ((50, 24, 1, 1), "x of event 2 is 24, expected 0 to 23, the sensor width"),
        ((50, 1, 18, 1), "y of event 2 is 18, expected 0 to 17, the sensor height"),
        ((50, -1, 1, 1), "x of event 2 is -1"),
        ((50, 1, 1, 2), "polarity of event 2 is 2, expected 0 (darker) and 1 (brighter)"),
        ((50, 1, 1, -1), "expected 0 (darker) and 1 (brighter), or -1 and 1, throughout"),
        ((5, 1, 1, 1), "event 2 is at 5 us, after one at 20 us; expected events in order of time"),
        ((1 << 62, 1, 1, 1), "t of event 2 is"),
    ],
)
def test_impossible_events_are_named(tmp_path: Path, event: writers.Event, words: str):
    with pytest.raises(RecordingError) as caught:
        taken(tmp_path, [(10, 1, 1, 0), (20, 1, 1, 1), event, (60, 1, 1, 1)])
    assert words in str(caught.value) and "camera.bin" in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_swapped_columns_are_suspected(tmp_path: Path):
    with pytest.raises(RecordingError, match="are they swapped"):
        taken(tmp_path, [(1, 3, 20, 1), (2, 4, 22, 1)])


def test_signed_polarities(tmp_path: Path):
    back, _ = taken(tmp_path, [(1, 3, 2, -1), (2, 4, 2, 1)])
    assert back.polarity.tolist() == [-1, 1]


@pytest.mark.parametrize(("before", "after"), [((1 << 32) - 4, 3), ((1 << 31) - 4, 3), ((1 << 31) - 4, 3 - (1 << 31))])
def test_counter_overflows_are_unwrapped(tmp_path: Path, before: int, after: int):
    back, report = taken(tmp_path, [(before - 10, 1, 1, 0), (before, 1, 1, 0), (after, 1, 1, 0), (after + 9, 1, 1, 1)])
    assert np.diff(back.t_us).tolist() == [10, 7, 9] and sum(report.repaired.values()) == 1


def test_everything_left_out_is_counted(tmp_path: Path):
    events = [(t, 5, 5, t % 2) for t in range(0, 4000, 10)] + [(4000, 1, 1, 1), (4000, 1, 1, 1), (4005, 1, 1, 0)]
    events += [(5000 + k, k % 24, k % 18, 1) for k in range(200)] + [(9000, 2, 2, 1)]
    hot = hot_pixels(source(events), SIZE, Intake(), 10)
    assert hot.reshape(18, 24)[5, 5] and hot.sum() == 1
    intake = Intake(duplicates="drop", refractory_us=8, end_us=8000, time_offset_us=0)
    report = take_in(source(events), SIZE, intake, tmp_path / "events.h5", hot)
    assert report.left_out == {
        "events outside the time window": 1, "events of 1 hot pixels": 403, "duplicate events": 1,
        "events in the refractory period": 1,
    }  # fmt: skip
    assert report.kept == len(events) - 406 and report.read == len(events)
    assert any("left out: 403" in sentence for sentence in report.sentences())


def test_the_clock_can_be_moved(tmp_path: Path):
    back, _ = taken(tmp_path, [(10, 1, 1, 0), (20, 1, 1, 1)], time_offset_us=10**15)
    assert back.t_us.tolist() == [10**15 + 10, 10**15 + 20]


def test_nothing_left_is_an_error(tmp_path: Path):
    with pytest.raises(RecordingError, match="no event is left"):
        taken(tmp_path, [(10, 1, 1, 0), (20, 1, 1, 1)], start_us=100)


def test_flips_are_reported_and_nothing_else_changes(tmp_path: Path):
    events: list[writers.Event] = [(k, k % 24, k % 18, k % 3 % 2) for k in range(100)]
    straight, report = taken(tmp_path, events)
    assert not any("flipped" in sentence for sentence in report.sentences())
    flipped, report = taken(tmp_path, events, flip_polarity=True, flip_x=True, flip_y=True)
    assert "flipped, as asked: polarity, x, y" in report.sentences()
    assert np.array_equal(flipped.polarity, -straight.polarity) and np.array_equal(flipped.t_us, straight.t_us)
    assert np.array_equal(flipped.x, 23 - straight.x) and np.array_equal(flipped.y, 17 - straight.y)
    (only_y, report) = taken(tmp_path, events, flip_y=True)
    assert np.array_equal(only_y.x, straight.x) and "flipped, as asked: y" in report.sentences()


def test_a_crop_keeps_its_pixels_counted_from_its_corner(tmp_path: Path):
    events: list[writers.Event] = [(k, k % 24, k % 18, 1) for k in range(500)]
    whole, _ = taken(tmp_path, events)
    kept, report = taken(tmp_path, events, crop=(4, 2, 20, 12))
    inside = (whole.x >= 4) & (whole.x < 20) & (whole.y >= 2) & (whole.y < 12)
    assert np.array_equal(kept.t_us, whole.t_us[inside])
    assert np.array_equal(kept.x, whole.x[inside] - 4) and np.array_equal(kept.y, whole.y[inside] - 2)
    assert report.left_out == {"events outside the crop": int((~inside).sum())}
    mirrored, _ = taken(tmp_path, events, crop=(0, 0, 24, 10), flip_y=True)
    assert np.array_equal(mirrored.y, (17 - whole.y)[whole.y >= 8])


def test_pixels_counted_from_one_are_suspected_and_shifted(tmp_path: Path):
    events: list[writers.Event] = [(7 * k, 1 + k % 24, 1 + k % 18, k % 2) for k in range(500)]
    with pytest.raises(RecordingError, match=r"y of event 17 is 18.*: counted from 1\? Then use --one-based"):
        taken(tmp_path, events)
    back, report = taken(tmp_path, events, one_based=True)
    assert back.x.tolist() == [k % 24 for k in range(500)] and back.y.tolist() == [k % 18 for k in range(500)]
    inside = [event for event in events if event[1] < 24 and event[2] < 18]
    _, report = taken(tmp_path, inside)
    assert any("are pixels counted from 1? Then use --one-based" in note for note in report.notes)
    for few in (inside[:9], [(0, 0, 5, 1), *inside]):
        _, report = taken(tmp_path, few)
        assert not report.notes
    with pytest.raises(RecordingError, match="y of event 1 is 0, expected 1 or more with --one-based"):
        taken(tmp_path, [(1, 1, 1, 1), (2, 1, 0, 1)], one_based=True)


@pytest.mark.parametrize(("step_us", "words"), [(10_000, "10,000 us"), (250, ""), (300, "100 us"), (7, "")])
def test_coarse_times_are_said(tmp_path: Path, step_us: int, words: str):
    _, report = taken(tmp_path, [(5 + step_us * (k // 20), k % 24, k % 18, 1) for k in range(500)])
    assert report.notes == ((f"times are multiples of {words}: rounded, or in another unit?",) if words else ())
