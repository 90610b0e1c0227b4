"""Files cut short, bent and swapped: cases 22 to 24."""

import hashlib
from pathlib import Path

import h5py
import numpy as np
import pytest

from ebarf_ns.errors import EbarfError, RecordingError
from ebarf_ns.events.recording import Recording, RecordingFile, read_recording, write_recording
from ebarf_ns.geometry.trajectory_file import read_tum

SMALLEST_BYTES = 3_000
HEADER_BYTES = 200
WIDTH, HEIGHT = 20, 10


def some_events(count: int = 300) -> Recording:
    random = np.random.default_rng(0)
    columns = random.integers(0, WIDTH, count).astype(np.uint16), random.integers(0, HEIGHT, count).astype(np.uint16)
    return Recording(
        *columns, np.sort(random.integers(0, 10**6, count)), random.choice(np.array([-1, 1], np.int8), count)
    )


def same(a: Recording, b: Recording) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("x", "y", "t_us", "polarity"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "events.h5"
    write_recording(path, [some_events()])
    return path


def read_or_refuse(path: Path, content: bytes) -> Recording | None:
    """What a reader makes of these bytes; None where it refuses them in one line."""
    path.write_bytes(content)
    try:
        return read_recording(path, WIDTH, HEIGHT)
    except RecordingError as error:
        assert str(path) in str(error) and "\n" not in str(error)
        return None


def test_case_22_a_recording_cut_anywhere_is_refused_or_whole(whole: Path, tmp_path: Path):
    content, truth = whole.read_bytes(), some_events()
    assert len(content) > SMALLEST_BYTES
    lengths = sorted({*range(0, HEADER_BYTES), *range(HEADER_BYTES, len(content), 97), len(content) - 1})
    for length in lengths:
        found = read_or_refuse(tmp_path / "cut.h5", content[:length])
        assert found is None or same(found, truth), length


def test_case_22_a_recording_with_any_header_byte_flipped_is_refused_or_the_same(whole: Path, tmp_path: Path):
    content, truth = whole.read_bytes(), some_events()
    for place in range(HEADER_BYTES):
        bent = bytearray(content)
        bent[place] ^= 0xFF
        found = read_or_refuse(tmp_path / "bent.h5", bytes(bent))
        assert found is None or same(found, truth), place


def write(path: Path, **columns: object) -> Path:
    whole = {"x": np.arange(4), "y": np.arange(4), "t": np.arange(4) * 10, "p": np.array([0, 1, 0, 1])}
    with h5py.File(path, "w") as file:
        for name, column in {**whole, **columns}.items():
            if column is not None:
                file[f"events/{name}"] = column
    return path


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"t": np.array([0, 20, 10, 30])}, "t"),
        ({"t": np.array([30, 20, 10, 0])}, "t"),
        ({"t": np.array([2**31 - 2, 2**31 - 1, -(2**31), 5])}, "t"),
        ({"t": np.array([2**32 - 2, 2**32 - 1, 0, 5])}, "t"),
        ({"t": np.array([0.0, np.nan, 1, 2])}, "t"),
        ({"x": np.array([0, 1, WIDTH, 3])}, "x"),
        ({"y": np.array([0, 1, -1, 3])}, "y"),
        ({"p": np.array([0, 1, 2, 1])}, "p"),
        ({"x": np.arange(3)}, "x"),
        ({"t": None}, "t"),
        ({name: np.zeros(0, int) for name in "xytp"}, "event"),
    ],
)
def test_case_23_wrong_columns_are_named(tmp_path: Path, columns: dict, words: str):
    with pytest.raises(RecordingError, match=words):
        read_recording(write(tmp_path / "wrong.h5", **columns), WIDTH, HEIGHT)


@pytest.mark.parametrize("polarity", [[0, 1, 0, 1], [-1, 1, -1, 1]])
@pytest.mark.parametrize("kind", ["<i8", ">i8", "<u4", "<f8"])
def test_case_23_either_polarity_and_any_byte_order_reads_the_same(tmp_path: Path, polarity: list[int], kind: str):
    path = write(tmp_path / "events.h5", p=np.array(polarity), t=np.array([5, 15, 15, 40], np.dtype(kind)))
    try:
        found = read_recording(path, WIDTH, HEIGHT)
    except RecordingError as error:
        # What is not read as it stands is named, never guessed.
        assert "events.h5" in str(error) and (polarity[0] == -1 or kind == "<f8")
        return
    assert found.t_us.tolist() == [5, 15, 15, 40] and found.polarity.tolist() == [-1, 1, -1, 1]


@pytest.mark.parametrize("size", [1, 2, 7, 299, 300, 10_000])
def test_case_23_pieces_of_any_size_are_bitwise_the_whole(whole: Path, size: int):
    pieces = list(RecordingFile(whole, WIDTH, HEIGHT).chunks(size))
    assert all(len(piece) <= size for piece in pieces)
    columns = ("x", "y", "t_us", "polarity")
    assert same(Recording(*(np.concatenate([getattr(p, name) for p in pieces]) for name in columns)), some_events())


def test_case_23_a_trajectory_cut_anywhere_loses_no_pose_in_silence(tmp_path: Path):
    lines = [f"0.{k} {k}.5 0 0 0 0 0 1" for k in range(1, 6)]
    content = "\n".join(lines).encode()
    for length in range(len(content)):
        path = tmp_path / "cut.txt"
        path.write_bytes(content[:length])
        try:
            found = read_tum(path)
        except EbarfError as error:
            assert "cut.txt" in str(error)
            continue
        # A cut between two lines, or after a digit that leaves a whole pose, cannot be seen.
        assert len(found.t_us) == len(content[:length].decode().strip().splitlines())


def test_case_24_nothing_derived_from_a_recording_is_kept_beside_it(whole: Path, tmp_path: Path):
    """There is no cache that could be stale: what is read is what the file says now, and reading leaves nothing."""
    path = tmp_path / "events.h5"
    path.write_bytes(whole.read_bytes())
    before = hashlib.sha256(path.read_bytes()).digest()
    assert same(read_recording(path, WIDTH, HEIGHT), some_events())
    assert [one.name for one in tmp_path.iterdir()] == ["events.h5"]
    assert hashlib.sha256(path.read_bytes()).digest() == before
    write_recording(path, [some_events(50)])
    assert same(read_recording(path, WIDTH, HEIGHT), some_events(50))
