from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ebarf_ns.errors import RecordingError
from ebarf_ns.events.recording import Recording, RecordingFile, read_recording, write_recording

WIDTH, HEIGHT = 24, 18
GOOD = {"x": [0, 23, 5], "y": [0, 17, 5], "t": [10, 10, 2500], "p": [0, 1, 1]}


def write(path: Path, t_offset: int | None = None, **columns: object) -> Path:
    with h5py.File(path, "w") as file:
        for name, column in {**GOOD, **columns}.items():
            if column is not None:
                file[f"events/{name}"] = np.asarray(column)
        if t_offset is not None:
            file["t_offset"] = np.int64(t_offset)
    return path


def test_reads_columns_with_offset(tmp_path: Path):
    recording = read_recording(write(tmp_path / "e.h5", t_offset=1_700_000_000_000_000), WIDTH, HEIGHT)
    assert recording.t_us.tolist() == [1_700_000_000_000_010, 1_700_000_000_000_010, 1_700_000_000_002_500]
    assert recording.polarity.tolist() == [-1, 1, 1]
    assert recording.x.dtype == np.uint16 and recording.t_us.dtype == np.int64


@given(
    st.lists(st.tuples(st.integers(0, 23), st.integers(0, 17), st.integers(0, 5000), st.booleans()), min_size=1),
    st.integers(-(10**15), 10**15),
)
def test_written_recording_reads_back_equal(tmp_path_factory: pytest.TempPathFactory, events: list, start_us: int):
    x, y, t, p = (np.array(column) for column in zip(*events, strict=True))
    t_us = np.sort(t).astype(np.int64) + start_us
    recording = Recording(x.astype(np.uint16), y.astype(np.uint16), t_us, np.where(p, 1, -1).astype(np.int8))
    path = tmp_path_factory.mktemp("h5") / "e.h5"
    write_recording(path, [recording])
    back = read_recording(path, WIDTH, HEIGHT)
    for column in ("x", "y", "t_us", "polarity"):
        assert np.array_equal(getattr(back, column), getattr(recording, column))
    with h5py.File(path) as file:
        times, index = np.asarray(file["events/t"]), np.asarray(file["ms_to_idx"])
        for millisecond, first in enumerate(index):
            assert (times[first:] >= millisecond * 1000).all() and (times[:first] < millisecond * 1000).all()


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"x": [0, 24, 5]}, "/events/x row 1 is 24, expected 0 to 23"),
        ({"y": [0, 18, 5]}, "/events/y row 1 is 18, expected 0 to 17"),
        ({"y": [-1, 0, 5]}, "/events/y row 0 is -1"),
        ({"p": [0, 1, 2]}, "/events/p row 2 is 2, expected 0 (darker) or 1 (brighter)"),
        ({"p": np.array([-1, 1, 1], np.int8)}, "/events/p row 0 is -1, expected 0"),
        ({"t": [10, 9, 2500]}, "/events/t row 1 is 9, expected a time not before"),
        ({"t": np.array([1, 2, 1 << 63], np.uint64)}, "/events/t row 2 is 9223372036854775808, expected microseconds"),
        ({"t": [10, 20]}, "columns of /events differ in length"),
        ({"t": [0.1, 0.2, float("nan")]}, "/events/t holds float64, expected integers"),
        ({"x": None}, "dataset /events/x is missing"),
        ({"x": [[1, 2, 3]]}, "dataset /events/x is missing, expected one column"),
        ({"x": [], "y": [], "t": [], "p": []}, "holds float64"),
        ({name: np.zeros(0, np.int64) for name in "xytp"}, "/events is empty"),
    ],
)
def test_wrong_columns_are_named_with_row_and_value(tmp_path: Path, columns: dict, words: str):
    path = write(tmp_path / "e.h5", **columns)
    with pytest.raises(RecordingError) as caught:
        read_recording(path, WIDTH, HEIGHT)
    assert str(caught.value).startswith(str(path)) and words in str(caught.value)


def test_swapped_columns_do_not_fit_the_sensor(tmp_path: Path):
    with pytest.raises(RecordingError, match="sensor height"):
        read_recording(write(tmp_path / "e.h5", x=[3, 17, 5], y=[3, 23, 5]), WIDTH, HEIGHT)


def test_cut_file_is_an_error_at_every_length(tmp_path: Path):
    whole = write(tmp_path / "e.h5").read_bytes()
    expected = read_recording(tmp_path / "e.h5", WIDTH, HEIGHT)
    cut = tmp_path / "cut.h5"
    for length in range(0, len(whole), 61):
        cut.write_bytes(whole[:length])
        try:
            read = read_recording(cut, WIDTH, HEIGHT)
        except RecordingError as error:
            assert str(cut) in str(error)
        else:
            assert np.array_equal(read.t_us, expected.t_us)


def test_missing_file_is_named(tmp_path: Path):
    with pytest.raises(RecordingError, match="no such file"):
        read_recording(tmp_path / "gone.h5", WIDTH, HEIGHT)


@given(st.integers(1, 300), st.integers(0, 1100), st.integers(0, 1100), st.sampled_from([0, -70, 10**15]))
def test_pieces_of_any_size_are_bitwise_the_window_asked_for(
    tmp_path_factory: pytest.TempPathFactory, size: int, a: int, b: int, t_offset: int
):
    random = np.random.default_rng(5)
    columns = {"x": random.integers(0, 24, 200), "y": random.integers(0, 18, 200), "p": random.integers(0, 2, 200)}
    path = tmp_path_factory.mktemp("h5") / "e.h5"
    write(path, t_offset, t=np.sort(random.integers(0, 1000, 200)), **columns)
    start_us, end_us = min(a, b) + t_offset, max(a, b) + t_offset
    expected = read_recording(path, WIDTH, HEIGHT).between(start_us, end_us)
    file = RecordingFile(path, WIDTH, HEIGHT)
    pieces = list(file.chunks(size))
    assert all(0 < len(piece) <= size for piece in pieces) and file.span()[0] == 200
    for column in ("x", "y", "t_us", "polarity"):
        joined = np.concatenate([getattr(piece.between(start_us, end_us), column) for piece in pieces])
        assert np.array_equal(joined, getattr(expected, column))
        assert np.array_equal(getattr(file.window(start_us, end_us), column), getattr(expected, column))


def test_disorder_across_pieces_is_found_with_its_row(tmp_path: Path):
    file = RecordingFile(write(tmp_path / "e.h5", t=[10, 20, 19]), WIDTH, HEIGHT)
    for size in (1, 2, 3):
        with pytest.raises(RecordingError, match="/events/t row 2 is 19, expected a time not before"):
            list(file.chunks(size=size))


def test_between_includes_both_ends(tmp_path: Path):
    recording = read_recording(write(tmp_path / "e.h5"), WIDTH, HEIGHT)
    assert len(recording.between(10, 10)) == 2 and len(recording.between(11, 2500)) == 1
    assert len(recording.between(11, 12)) == 0


def test_the_span_is_checked_without_reading_the_middle(tmp_path: Path):
    file = RecordingFile(write(tmp_path / "e.h5", t=[10, 2500, 5]), WIDTH, HEIGHT)
    with pytest.raises(RecordingError, match="/events/t row 2 is 5, expected a time not before"):
        file.span()
    assert RecordingFile(write(tmp_path / "f.h5", t_offset=7), WIDTH, HEIGHT).span() == (3, 17, 2507)


def test_an_offset_beyond_all_time_is_named(tmp_path: Path):
    path = write(tmp_path / "e.h5")
    with h5py.File(path, "a") as file:
        file["t_offset"] = np.uint64(2**63 + 5)
    with pytest.raises(RecordingError, match="/t_offset is 9223372036854775813, expected within"):
        read_recording(path, WIDTH, HEIGHT)


def test_lengths_that_are_only_declared_are_refused_at_once(tmp_path: Path):
    from ebarf_ns.formats.raw_inspection import inspect_recording
    from ebarf_ns.formats.recognise import open_recording

    path = tmp_path / "events.h5"
    with h5py.File(path, "w") as file:
        for name, dtype in (("x", "u2"), ("y", "u2"), ("t", "i8"), ("p", "u1")):
            file.create_dataset(f"events/{name}", (10**11,), dtype, chunks=(1024,))[:2000] = 0
    with pytest.raises(RecordingError, match=r"declares 100,000,000,000 events .*stores none"):
        RecordingFile(path, 4, 4).span()
    with pytest.raises(RecordingError, match=r"declares 100,000,000,000 events .*stores none"):
        inspect_recording(lambda: open_recording(path, "hdf5"))


def test_an_offset_of_times_is_one_number(tmp_path: Path):
    path = tmp_path / "events.h5"
    pixels = np.zeros(3, np.uint16)
    write_recording(path, [Recording(pixels, pixels, np.zeros(3, np.int64), np.ones(3, np.int8))])
    with h5py.File(path, "r+") as file:
        del file["t_offset"]
        file.create_dataset("t_offset", (10**11,), "i8", chunks=(1024,))
    with pytest.raises(RecordingError, match="/t_offset is not one integer"):
        RecordingFile(path, 4, 4).span()
