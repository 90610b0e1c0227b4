from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ebarf_ns.errors import RecordingError
from ebarf_ns.events.recording import Recording
from ebarf_ns.formats.intake import checked
from ebarf_ns.formats.readers import text
from ebarf_ns.formats.readers.text import read_text
from ebarf_ns.formats.recognise import open_recording
from ebarf_ns.formats.source import TimeUnit

WIDTH, HEIGHT = 240, 180


def read(tmp_path: Path, content: str | bytes, unit: TimeUnit | None = "s") -> Recording:
    path = tmp_path / "events.txt"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return checked(read_text(path, unit), (WIDTH, HEIGHT))


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
        ("0.2 1e-1 2 1", "is not an event"),
        ("0.2 1 2 1e", "is not an event"),
        ("0.2 -1 2 1", "is not an event"),
        ("0.2.1 1 2 1", "is not an event"),
        ("nan 1 2 1", "is not an event"),
        (". 1 2 1", "is not an event"),
        ("-. 1 2 1", "is not an event"),
        ("0.2 one 2 1", "is not an event"),
        ("12345678901234567890 1 2 1", "is not an event"),
        ("0.2 240 2 1", "x of line 3 is 240, expected 0 to 239"),
        ("0.2 2 180 1", "y of line 3 is 180, expected 0 to 179"),
        ("0.2 2 18 2", "polarity of line 3 is 2, expected 0 (darker) and 1 (brighter)"),
        ("0.05 2 18 1", "line 3 is at 50000 us, after one at 100000 us"),
    ],
)
def test_bad_line_is_named(tmp_path: Path, line: str, words: str):
    with pytest.raises(RecordingError) as caught:
        read(tmp_path, f"# comment\n0.1 1 1 1\n{line}\n0.3 1 1 1\n")
    said = str(caught.value)
    assert said.startswith(f"{tmp_path / 'events.txt'}:") and words in said and ("line 3" in said or ".txt:3:" in said)


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


@pytest.mark.parametrize(
    ("content", "unit", "t_us"),
    [
        ("240 180\n0.001 1 2 1\n0.002 1 2 0\n", None, [1000, 2000]),
        ("240 180\n1000 1 2 1\n2000 1 2 0\n", None, [1000, 2000]),
        ("x,y,polarity,timestamp_ns\n1,2,1,1499\n1,2,0,1500\n", None, [1, 2]),
        ("# made by a program\nt[ms];x;y;p\n0.25;1;2;1\n1.5;1;2;0\n", None, [250, 1500]),
        (
            "1.000000000000000000e+01 1.0e+00 2.0e+00 1.0e+00\n1.000000150000000000e+01 1 2 0\n",
            None,
            [10**7, 10**7 + 2],
        ),
        ("5 1 2 1\n6 1 2 -1\n", "ms", [5000, 6000]),
        ("0 1 2 1\n0.000123 1 2 0\n", None, [0, 123]),
        ("\ufefft[\u00b5s],x,y,p\n1000.4,1,2,1\n2000,1,2,0\n", None, [1000, 2000]),
        ("\ufeff5,1,2,1\n7,1,2,0\n", None, [5, 7]),
        ("time (\u03bcs),x,y,p\n5,1,2,1\n7,1,2,0\n", None, [5, 7]),
        ("time [microseconds] x y p\n5 1 2 1\n7 1 2 0\n", None, [5, 7]),
        ("time y x p extra\n0.5 2 1 1 9.9\n0.6 2 1 0 -3\n", None, [500_000, 600_000]),
    ],
)
def test_columns_and_units_as_files_have_them(tmp_path: Path, content: str, unit: TimeUnit | None, t_us: list[int]):
    recording = read(tmp_path, content, unit)
    assert recording.t_us.tolist() == t_us and recording.x.tolist() == [1, 1] and recording.y.tolist() == [2, 2]
    assert recording.polarity.tolist() == [1, -1]


def test_columns_that_are_missing_are_named(tmp_path: Path):
    with pytest.raises(RecordingError, match="expected t, x, y and p once each"):
        read(tmp_path, "t,x,p\n1,2,1\n", None)


def test_a_unit_that_is_not_known_is_named_and_not_guessed(tmp_path: Path):
    with pytest.raises(RecordingError, match="times in 'ticks', expected one of .* or --event-time-unit"):
        read(tmp_path, "t[ticks],x,y,p\n5,1,2,1\n", None)


def test_fractions_of_guessed_microseconds_are_an_error(tmp_path: Path):
    with pytest.raises(RecordingError, match=r":2001: '0.5 1 2 1' is not an event, expected 't\[us\] x y p'"):
        read(tmp_path, "0 1 2 1\n" * 2000 + "0.5 1 2 1\n", None)


def test_binary_rubbish_is_an_error(tmp_path: Path):
    with pytest.raises(RecordingError, match="events.txt"):
        read(tmp_path, bytes(range(256)))


@pytest.mark.parametrize(
    ("comment", "rows", "unit", "note"),
    [
        ("# t y x p", "{t} {y} {x} {p}", 1, "columns t y x p, as the comment in line 2 names them"),
        ("# t[ns] x y p", "{t}000 {x} {y} {p}", 1, "columns t[ns] x y p, as the comment in line 2"),
        ("# time in ms", "{t} {x} {y} {p}", 1000, "times in ms, as a comment says"),
        ("# timestamps: unit is seconds", "{t} {x} {y} {p}", 10**6, "times in s, as a comment says"),
        ("% events (ts,y,x,pol)", "{t} {y} {x} {p}", 1, "columns ts y x pol, as the comment"),
        ("// extra x y p t", "9.9 {x} {y} {p} {t}", 1, "columns extra x y p t, as the comment"),
        ("# a recording of t and x", "{t} {x} {y} {p}", 1, "that x is before y is assumed"),
    ],
)
def test_comments_name_columns_and_units(tmp_path: Path, comment: str, rows: str, unit: int, note: str):
    columns = [{"t": 7 * k, "x": k % 9, "y": 100 + k % 7, "p": k % 2} for k in range(20)]
    lines = [rows.format(**event) for event in columns]
    path = tmp_path / "events.txt"
    path.write_text("\n".join(["# made by a program", comment, *lines]))
    source = open_recording(path)
    assert any(note in said for said in source.notes), source.notes
    back = checked(source, (WIDTH, HEIGHT))
    assert back.t_us.tolist() == [unit * event["t"] for event in columns]
    assert back.x.tolist() == [event["x"] for event in columns]
    assert back.y.tolist() == [event["y"] for event in columns]


def test_a_comment_that_the_values_contradict_asks(tmp_path: Path):
    path = tmp_path / "events.txt"
    path.write_text("# t x y p\n" + "".join(f"{k % 9} {k % 7} {k % 2} {70 * k}\n" for k in range(200)))
    with pytest.raises(RecordingError, match="comment names columns 't x y p', but the values read as 'x y p t'"):
        read_text(path)
    assert len(checked(read_text(path, columns="xypt"), (WIDTH, HEIGHT))) == 200


@pytest.mark.parametrize(
    "content",
    [
        "t,x,y,p\n5,1,2,True\n6,1,2,False\n",
        "t,x,y,on\n5,1,2,ON\n6,1,2,OFF\n",
        "5 1 2 true\n6 1 2 false\n",
        '"t","x","y","p"\n"5","1","2","1"\n"6","1","2","0"\n',
        ",t,x,y,p\n0,5,1,2,1\n1,6,1,2,0\n",
        '"","t","x","y","p"\n"0",5,1,2,1\n"1",6,1,2,0\n',
    ],
)
def test_words_quotes_and_indices(tmp_path: Path, content: str):
    back = read(tmp_path, content, None)
    assert back.t_us.tolist() == [5, 6] and back.x.tolist() == [1, 1] and back.polarity.tolist() == [1, -1]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (
            "t,x,y,p\n5,1,2,1\nnan,1,2,0\n",
            ".txt:3: 'nan,1,2,0' is not an event, expected 't[us] x y p'; t[us] is 'nan'",
        ),
        ("t,x,y,p\n5,1,2,1\n6,1,2,up\n", "p is 'up', expected a whole number"),
        ("t,x,y,p\n5,1,2,1\n" + "6,1,2,0\n" * 2000 + "6.5,1,2,1\n", "t has a fraction, --event-time-unit"),
        ("0 5 1 2 1\n1 6 1 2 0\n", "columns: 5, expected 4; a first line may name them"),
        ("5 1 2 1\n6 1", "columns: 2, expected 4; is the file cut off?"),
        ("t;x;y;p\n0,5;1;2;1\n", "decimal commas?"),
        ("5 1 2 1\n6 1 2 1e999\n", "a number is too long"),
    ],
)
def test_what_is_wrong_with_a_line_is_said(tmp_path: Path, content: str, words: str):
    with pytest.raises(RecordingError) as caught:
        read(tmp_path, content, None)
    assert words in str(caught.value) and ("--event-time-unit" in str(caught.value)) == ("fraction" in words)
