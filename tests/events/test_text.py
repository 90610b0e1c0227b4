from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ebarf_ns.errors import RecordingError
from ebarf_ns.events.readers import text
from ebarf_ns.events.readers.text import read_text_events

WIDTH, HEIGHT = 240, 180


def read(tmp_path: Path, content: str | bytes):
    path = tmp_path / "events.txt"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_text_events(path, WIDTH, HEIGHT)


def test_times_are_exact(tmp_path: Path):
    content = "# t x y p\n0.003811000 96 133 0\r\n\n1.0000005,1,2,1 # noise\n1468939993.067416019\t239 179 1"
    recording = read(tmp_path, content)
    assert recording.t_us.tolist() == [3811, 1000001, 1468939993067416]
    assert recording.x.tolist() == [96, 1, 239] and recording.polarity.tolist() == [-1, 1, 1]


@given(
    st.lists(
        st.tuples(st.integers(0, 10**13), st.integers(0, 239), st.integers(0, 179), st.integers(0, 1)), min_size=1
    ),
    st.integers(6, 9),
)
def test_any_events_read_back(tmp_path_factory: pytest.TempPathFactory, events: list, decimals: int):
    events.sort(key=lambda event: event[0])
    lines = [f"{t // 10**6}.{t % 10**6:06d}{'0' * (decimals - 6)} {x} {y} {p}" for t, x, y, p in events]
    recording = read(tmp_path_factory.mktemp("text"), "\n".join(lines))
    assert recording.t_us.tolist() == [event[0] for event in events]
    assert recording.y.tolist() == [event[2] for event in events]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("0.2 1 2", "is not an event, expected 't[s] x y p'"),
        ("0.2 1 2 1 0", "is not an event"),
        ("0.2 1.5 2 1", "is not an event"),
        ("0.2 -1 2 1", "is not an event"),
        ("0.2.1 1 2 1", "is not an event"),
        ("nan 1 2 1", "is not an event"),
        (". 1 2 1", "is not an event"),
        ("-. 1 2 1", "is not an event"),
        ("0.2 one 2 1", "is not an event"),
        ("12345678901234567890 1 2 1", "is not an event"),
        ("0.2 240 2 1", "x is 240, expected 0 to 239"),
        ("0.2 2 180 1", "y is 180, expected 0 to 179"),
        ("0.2 2 18 2", "p is 2, expected 0 (darker) or 1 (brighter)"),
        ("0.05 2 18 1", "t is 50000 us, expected a time not before"),
    ],
)
def test_bad_line_is_named(tmp_path: Path, line: str, words: str):
    with pytest.raises(RecordingError) as caught:
        read(tmp_path, f"# comment\n0.1 1 1 1\n{line}\n0.3 1 1 1\n")
    assert str(caught.value).startswith(f"{tmp_path / 'events.txt'}:3:") and words in str(caught.value)


@pytest.mark.parametrize("content", ["", "\n\n", "# only a comment\n"])
def test_no_events_is_an_error(tmp_path: Path, content: str):
    with pytest.raises(RecordingError, match="holds no events"):
        read(tmp_path, content)


def test_blocks_of_any_size_give_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    content = "".join(f"{k}.{k:06d} {k % 240} {k % 180} {k % 2}\n" for k in range(50))
    whole = read(tmp_path, content)
    for size in (1, 7, 64):
        monkeypatch.setattr(text, "_BLOCK_BYTES", size)
        again = read(tmp_path, content)
        assert np.array_equal(again.t_us, whole.t_us) and np.array_equal(again.x, whole.x)


def test_binary_rubbish_is_an_error(tmp_path: Path):
    with pytest.raises(RecordingError, match="is not an event"):
        read(tmp_path, bytes(range(256)))
