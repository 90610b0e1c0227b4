"""EVT2, EVT2.1, EVT3 and DAT against independent writers, and against a real camera's file."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ebarf_ns.errors import RecordingError
from ebarf_ns.formats.readers.ecf import decode
from ebarf_ns.formats.readers.prophesee import Decoder, read_dat, read_raw
from tests.conftest import DATA
from tests.formats import writers

ENCODERS = {"evt2": writers.evt2, "evt2.1": writers.evt21, "evt3": writers.evt3}
EVENTS = st.lists(
    st.tuples(st.integers(0, 2**24 - 1), st.integers(0, 639), st.integers(0, 479), st.integers(0, 1)), min_size=1
).map(sorted)


def columns(decoder: Decoder, content: bytes, size: int) -> list[np.ndarray]:
    parts = [decoder.feed(content[k : k + size]) for k in range(0, len(content), size)]
    return [np.concatenate(column) for column in zip(*parts, strict=True)]


@pytest.mark.parametrize("encoding", list(ENCODERS))
@given(events=EVENTS, size=st.integers(1, 40))
def test_written_events_are_read_back_in_chunks_of_any_size(encoding, events: list[writers.Event], size: int):
    content = ENCODERS[encoding](events)
    whole = columns(Decoder(encoding), content, len(content))
    assert [whole[2].tolist(), whole[0].tolist(), whole[1].tolist(), whole[3].tolist()] == [
        list(column) for column in zip(*events, strict=True)
    ]
    for one, again in zip(whole, columns(Decoder(encoding), content, size), strict=True):
        assert np.array_equal(one, again)


@pytest.mark.parametrize("encoding", list(ENCODERS))
def test_time_continues_when_its_counter_overflows(encoding):
    bits = 24 if encoding == "evt3" else 34
    # As from cameras, with occasional time words.
    times = [*range((1 << bits) - 3 * (1 << (bits - 3)), (1 << bits) + 3 * (1 << (bits - 3)), 1 << (bits - 3))]
    content = ENCODERS[encoding]([(t, 1, 2, 1) for t in times])
    assert Decoder(encoding).feed(content)[2].tolist() == times


def test_halves_of_evt21_words_may_be_swapped(tmp_path: Path):
    events = [(100, 3, 4, 1), (100, 5, 4, 1), (200, 600, 400, 0)]
    swapped = writers.raw(tmp_path / "a.raw", "2.1", writers.evt21(events, swapped=True))
    (piece,) = read_raw(swapped).pieces
    assert piece.x.tolist() == [3, 5, 600] and piece.t_us.tolist() == [100, 100, 200]
    straight = tmp_path / "b.raw"
    straight.write_bytes(b"% evt 2.1\n% endianness little\n% end\n" + writers.evt21(events))
    (piece,) = read_raw(straight).pieces
    assert piece.x.tolist() == [3, 5, 600]


def test_events_without_a_time_are_counted_and_left_out():
    decoder = Decoder("evt3")
    assert not len(decoder.feed(np.array([0x0005, 0x2801, 0x2802], "<u2").tobytes())[0]) and decoder.timeless == 2


@pytest.mark.parametrize(("encoding", "word"), [("evt2", "<u4"), ("evt2.1", "<u8")])
def test_a_word_of_unknown_type_is_named(tmp_path: Path, encoding: str, word: str):
    bits = np.dtype(word).itemsize * 8
    content = np.array([0x8 << (bits - 4), 0xB << (bits - 4)], word)
    if encoding == "evt2.1":
        content = (content << np.uint64(32)) | (content >> np.uint64(32))
    path = writers.raw(tmp_path / "a.raw", encoding.removeprefix("evt"), content.tobytes())
    with pytest.raises(RecordingError, match="word 1 is 0xb"):
        list(read_raw(path).pieces)


@pytest.mark.parametrize("kinds", [(0x9999,), (0x1000, 0x9001, 0xBFFF, 0xC123, 0xD777)])
def test_reserved_words_of_evt3_are_counted_and_left_out(tmp_path: Path, kinds: tuple[int, ...]):
    events = [(1000 * k, k % 640, k % 480, k % 2) for k in range(300)]
    words = np.frombuffer(writers.evt3(events), "<u2")
    places = np.linspace(1, len(words) - 1, 15).astype(int)
    padded = np.insert(words, places, np.resize(np.array(kinds, np.uint16), 15))
    source = read_raw(writers.raw(tmp_path / "a.raw", "3.0", padded.tobytes()))
    assert np.concatenate([piece.t_us for piece in source.pieces]).tolist() == [t for t, *_ in events]
    assert source.dropped["words of reserved types, such as padding"] == 15
    # Many words of one padding value are still padding; many diverse ones are not EVT3.
    padded = np.insert(words, np.repeat(places, 100), np.resize(np.array(kinds, np.uint16), 1500))
    source = read_raw(writers.raw(tmp_path / "b.raw", "3.0", padded.tobytes()))
    if len(kinds) == 1:
        assert sum(map(len, source.pieces)) == 300
    else:
        with pytest.raises(RecordingError, match="not an EVT3 word, like .*% of all .*expected the encoding of its"):
            list(source.pieces)


def test_random_words_are_not_evt3(tmp_path: Path):
    content = np.random.default_rng(0).bytes(4000)
    with pytest.raises(RecordingError, match="not an EVT3 word"):
        list(read_raw(writers.raw(tmp_path / "a.raw", "3.0", content)).pieces)


def test_a_cut_word_is_counted(tmp_path: Path):
    path = writers.raw(tmp_path / "a.raw", "2.0", writers.evt2([(1, 2, 3, 1), (2, 2, 3, 1)])[:-1])
    source = read_raw(path)
    assert sum(len(piece) for piece in source.pieces) == 1
    assert source.dropped["words cut short by the end of the file"] == 1


@pytest.mark.parametrize("header", ["% evt 4.0\n", "% Date today\n", ""])
def test_an_unknown_encoding_is_named(tmp_path: Path, header: str):
    path = tmp_path / "a.raw"
    path.write_bytes(header.encode() + bytes(64))
    with pytest.raises(RecordingError, match="expected EVT2, EVT2.1 or EVT3"):
        read_raw(path)


@given(events=EVENTS)
def test_dat_reads_back(tmp_path_factory: pytest.TempPathFactory, events: list[writers.Event]):
    source = read_dat(writers.dat(tmp_path_factory.mktemp("dat") / "a.dat", events))
    (piece,) = source.pieces
    assert source.sensor_size == (640, 480)
    assert list(zip(piece.t_us, piece.x, piece.y, piece.polarity, strict=True)) == events


def test_dat_continues_after_32_bits(tmp_path: Path):
    times = [(1 << 32) - 5, (1 << 32) + 5, (1 << 32) + 2**31]
    (piece,) = read_dat(writers.dat(tmp_path / "a.dat", [(t, 1, 1, 1) for t in times])).pieces
    assert piece.t_us.tolist() == times


def test_a_real_camera():
    path = DATA / "readers" / "prophesee_evt2.raw"
    if not path.is_file():
        pytest.skip(f"no recordings at {DATA}; set EBARF_TEST_DATA to their folder")
    pieces = list(read_raw(path).pieces)
    assert sum(map(len, pieces)) == 521_252 and 913.6e6 < pieces[0].t_us[0] < 913.8e6
    assert max(int(piece.x.max()) for piece in pieces) < 640 and max(int(piece.y.max()) for piece in pieces) < 480
    t_us = np.concatenate([piece.t_us for piece in pieces])
    assert (np.diff(t_us) >= 0).all()


ECF_EVENTS = st.lists(
    st.tuples(st.integers(0, 400), st.integers(0, 30), st.integers(0, 3), st.integers(0, 1)), min_size=1, max_size=300
)


@pytest.mark.parametrize("layout", ["packed", "runs and packed", "runs and masks"])
@given(events=ECF_EVENTS, far_us=st.integers(0, 1 << 40))
def test_ecf_blocks_read_back_and_cut_ones_are_refused(layout: str, events: list[writers.Event], far_us: int):
    # Runs of equal times, single times, and a long silence in the middle.
    half = len(events) // 2
    made = [(t + (far_us if k >= half else 0), x, y, p) for k, (t, x, y, p) in enumerate(sorted(events))]
    content = writers.ecf(made, layout)
    x, y, t_us, p = decode(content)
    assert list(zip(t_us.tolist(), x.tolist(), y.tolist(), p.tolist(), strict=True)) == made
    for place in (0, 3, 11, 12, len(content) // 2, len(content) - 1):
        with pytest.raises(ValueError, match="ECF block"):
            decode(content[:place])
