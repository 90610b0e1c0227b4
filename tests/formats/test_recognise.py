"""Formats are recognised from content, and all damage results in a one-line error."""

import gzip
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.io import savemat

from ebarf_ns.benchmarks.recordings import aedat4
from ebarf_ns.errors import RecordingError
from ebarf_ns.events.recording import Recording, read_recording
from ebarf_ns.formats.intake import Intake, checked, take_in
from ebarf_ns.formats.raw_inspection import inspect_recording
from ebarf_ns.formats.recognise import open_recording, recognised
from tests.conftest import DATA
from tests.formats import writers

SIZE = (640, 480)
EVENTS: list[writers.Event] = [(1000 * k, k % 640, (7 * k) % 480, k % 2) for k in range(300)]
CUTS = 200
EVENT_ARRAY = "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events\n"
EVENT = "uint16 x\nuint16 y\ntime ts\nbool polarity\n"


def columns() -> tuple[np.ndarray, ...]:
    return tuple(np.array(column) for column in zip(*EVENTS, strict=True))


def hdf5(path: Path, group: str = "events") -> Path:
    t, x, y, p = columns()
    with h5py.File(path, "w") as file:
        for name, column in (("x", x), ("y", y), ("t", t), ("p", p)):
            file[f"{group}/{name}"] = column
    return path


def compound(path: Path) -> Path:
    t, x, y, p = columns()
    table = np.zeros(len(t), [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    table["x"], table["y"], table["p"], table["t"] = x, y, p, t
    with h5py.File(path, "w") as file:
        file["CD/events"] = table
        file["CD/indexes"] = np.arange(3)
    return path


def npz(path: Path) -> Path:
    t, x, y, p = columns()
    np.savez(path, x=x, y=y, t=t, p=2 * p - 1)
    return path


def robust(path: Path) -> Path:
    t, x, y, p = columns()
    np.savez(path, position=np.stack([x, y], 1).astype(np.uint16), timestamp=t * 1000, polarity=p.astype(bool))
    return path


def npy(path: Path) -> Path:
    t, x, y, p = columns()
    path.mkdir()
    rows = np.stack([x, y, t * 1000, 2 * p - 1], 1).astype(float)
    np.save(path / "events_0000.npy", rows[:100])
    np.save(path / "events_0001.npy", rows[100:])
    return path


def npy_file(path: Path) -> Path:
    t, x, y, p = columns()
    np.save(path, np.stack([x, y, t * 1000, 2 * p - 1], 1).astype(float))
    return path


def mat(path: Path) -> Path:
    t, x, y, p = columns()
    savemat(path, {"x": x, "y": y, "ts": t.astype(float), "pol": 2.0 * p - 1})
    return path


def text(path: Path) -> Path:
    path.write_text("".join(f"{t / 1e6:.6f} {x} {y} {p}\n" for t, x, y, p in EVENTS))
    return path


def aedat4_file(path: Path) -> Path:
    t, x, y, p = columns()
    path.write_bytes(b"".join(aedat4([(t[:100], x[:100], y[:100], p[:100]), (t[100:], x[100:], y[100:], p[100:])])))
    return path


def types(ros: int):
    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    event = EVENT if ros == 1 else EVENT.replace("time ts", "builtin_interfaces/Time ts")
    store.register(get_types_from_msg(event, "dvs_msgs/msg/Event"))
    store.register(get_types_from_msg(EVENT_ARRAY, "dvs_msgs/msg/EventArray"))
    return store


def messages(store, events: list[writers.Event], size: tuple[int, int]) -> list:
    of = store.types
    header = of["std_msgs/msg/Header"]
    time = of["builtin_interfaces/msg/Time"]
    found = []
    for first in range(0, len(events), 100):
        some = [
            of["dvs_msgs/msg/Event"](x, y, time(t // 10**6, t % 10**6 * 1000), bool(p))
            for t, x, y, p in events[first : first + 100]
        ]
        arguments = (time(0, 0), "camera")
        head = header(0, *arguments) if "seq" in header.__dataclass_fields__ else header(*arguments)
        found.append(of["dvs_msgs/msg/EventArray"](head, size[1], size[0], some))
    return found


def bag1(path: Path, events: list[writers.Event] = EVENTS, size: tuple[int, int] = SIZE) -> Path:
    store = types(1)
    with Writer1(path) as bag:
        connection = bag.add_connection("/dvs/events", "dvs_msgs/msg/EventArray", typestore=store)
        for k, message in enumerate(messages(store, events, size)):
            bag.write(connection, 10**9 + k, store.serialize_ros1(message, "dvs_msgs/msg/EventArray"))
    return path


def bag2(path: Path, plugin: StoragePlugin = StoragePlugin.SQLITE3) -> Path:
    store = types(2)
    with Writer2(path, version=9, storage_plugin=plugin) as bag:
        connection = bag.add_connection("/dvs/events", "dvs_msgs/msg/EventArray", typestore=store)
        for k, message in enumerate(messages(store, EVENTS, SIZE)):
            bag.write(connection, 10**9 + k, store.serialize_cdr(message, "dvs_msgs/msg/EventArray"))
    return path


MADE: dict[str, Callable[[Path], Path]] = {
    "a.h5": hdf5,
    "eds.h5": lambda path: hdf5(path, "/"),
    "m3ed.h5": lambda path: hdf5(path, "prophesee/left"),
    "prophesee.hdf5": compound,
    "ecf.hdf5": lambda path: writers.ecf_file(path, EVENTS, ["packed", "runs and packed", "runs and masks"]),
    "ecf-plain.hdf5": lambda path: writers.ecf_file(path, EVENTS, ["as they are", "packed"]),
    "evt2.raw": lambda path: writers.raw(path, "2.0", writers.evt2(EVENTS)),
    "evt21.raw": lambda path: writers.raw(path, "2.1", writers.evt21(EVENTS, swapped=True)),
    "evt3.raw": lambda path: writers.raw(path, "3.0", writers.evt3(EVENTS)),
    "a.dat": lambda path: writers.dat(path, EVENTS),
    "a.aedat4": aedat4_file,
    "a.npz": npz,
    "raw_events.npz": robust,
    "npy": npy,
    "a.npy": lambda path: npy_file(path),
    "a.mat": mat,
    "a.txt": text,
    "a.bag": bag1,
    "ros2": bag2,
}


def taken(path: Path, output: Path) -> Recording:
    take_in(open_recording(path), SIZE, Intake(), output)
    return read_recording(output, *SIZE)


@pytest.mark.parametrize("name", list(MADE))
def test_the_same_events_come_out_of_every_format(tmp_path: Path, name: str):
    expected, back = writers.recording(EVENTS), taken(MADE[name](tmp_path / name), tmp_path / "out.h5")
    for column in ("x", "y", "t_us", "polarity"):
        assert np.array_equal(getattr(back, column), getattr(expected, column)), column


@pytest.mark.parametrize("name", list(MADE))
@pytest.mark.parametrize("size", [1, 7])
def test_pieces_of_any_size_are_the_same_events(tmp_path: Path, name: str, size: int, monkeypatch: pytest.MonkeyPatch):
    path, expected = MADE[name](tmp_path / name), writers.recording(EVENTS)
    monkeypatch.setattr("ebarf_ns.formats.readers.hdf5._EVENTS_AT_ONCE", size)
    monkeypatch.setattr("ebarf_ns.formats.readers.arrays._EVENTS_AT_ONCE", size)
    monkeypatch.setattr("ebarf_ns.formats.readers.prophesee._BYTES_AT_ONCE", 8 * size)
    monkeypatch.setattr("ebarf_ns.formats.readers.text._BLOCK_BYTES", 8 * size)
    back = checked(open_recording(path), SIZE)
    for column in ("x", "y", "t_us", "polarity"):
        assert np.array_equal(getattr(back, column), getattr(expected, column)), column


SINGLE = [name for name in MADE if name not in ("npy", "ros2")]


@pytest.mark.parametrize("name", SINGLE)
def test_a_cut_file_is_an_error_or_the_events_before_the_cut(tmp_path: Path, name: str):
    content = MADE[name](tmp_path / name).read_bytes()
    expected = writers.recording(EVENTS)
    header = 256
    places = [*range(min(header, len(content))), *np.linspace(header, len(content) - 1, CUTS).astype(int).tolist()]
    cut = tmp_path / f"cut-{name}"
    for place in places:
        cut.write_bytes(content[:place])
        try:
            back = checked(open_recording(cut), SIZE)
        except RecordingError as error:
            assert str(cut) in str(error) and "\n" not in str(error)
            continue
        assert np.array_equal(back.t_us, expected.t_us[: len(back)]) and np.array_equal(back.x, expected.x[: len(back)])
        # All events still in the file are read; formats without lengths cannot detect truncation.
        assert len(back) == len(expected) or name.split(".")[-1] in ("raw", "dat", "txt"), place


@pytest.mark.parametrize("name", SINGLE)
def test_flipped_bytes_of_the_header_never_end_in_a_traceback(tmp_path: Path, name: str):
    content = bytearray(MADE[name](tmp_path / name).read_bytes())
    flipped = tmp_path / f"flipped-{name}"
    for place in range(min(128, len(content))):
        for bits in (0xFF, 0x01):
            content[place] ^= bits
            flipped.write_bytes(content)
            content[place] ^= bits
            try:
                checked(open_recording(flipped), SIZE)
            except RecordingError as error:
                assert "flipped" in str(error)


@pytest.mark.parametrize(
    "content", [b"", b"\0" * 100, b"\x89PNG\r\n\x1a\n", b"%PDF-1.4\n", b"PK\x03\x04rubbish", b"hello\n"]
)
def test_other_files_are_no_recordings(tmp_path: Path, content: bytes):
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(RecordingError, match="file"):
        list(open_recording(tmp_path / "file").pieces)


def test_times_in_nanoseconds_where_hdf5_does_not_say_so(tmp_path: Path):
    path = hdf5(tmp_path / "a.h5")
    with h5py.File(path, "r+") as file:
        del file["events/t"]
        file["events/t"] = 1000 * columns()[0] + 499
    back = checked(open_recording(path, time_unit="ns"), SIZE)
    assert np.array_equal(back.t_us, writers.recording(EVENTS).t_us)


def test_a_file_in_a_ros2_bag_opens_the_bag_and_alone_reports_missing_metadata(tmp_path: Path):
    folder = bag2(tmp_path / "ros2")
    (database,) = folder.glob("*.db3")
    assert np.array_equal(checked(open_recording(database), SIZE).t_us, writers.recording(EVENTS).t_us)
    (folder / "metadata.yaml").unlink()
    with pytest.raises(RecordingError, match="no metadata.yaml beside it, expected a ROS 2 bag's folder"):
        open_recording(database)


def test_a_file_of_mcap_is_read_alone(tmp_path: Path):
    (file,) = bag2(tmp_path / "ros2", StoragePlugin.MCAP).glob("*.mcap")
    alone = file.rename(tmp_path / "alone.mcap")
    assert np.array_equal(checked(open_recording(alone), SIZE).t_us, writers.recording(EVENTS).t_us)
    alone.write_bytes(alone.read_bytes()[:-100])
    with pytest.raises(RecordingError, match="alone.mcap: not a whole bag"):
        open_recording(alone)


@pytest.mark.parametrize("known", ["npz", "npy"])
def test_a_mislabelled_array_file_is_named(tmp_path: Path, known: str):
    path = (npy_file if known == "npz" else npz)(tmp_path / ("a.npy" if known == "npz" else "a.npz"))
    with pytest.raises(RecordingError, match=r"a.np."):
        list(open_recording(path, known).pieces)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("name", ["a.h5", "a.bag"])
def test_what_must_be_chosen_is_listed(tmp_path: Path, name: str):
    path = MADE[name](tmp_path / name)
    with pytest.raises(RecordingError, match="dvs/events|/events"):
        open_recording(path, part="/elsewhere")


@pytest.mark.parametrize(
    ("name", "events", "size"),
    [
        ("ros1_event_packet_evt3.bag", 343_474, (640, 480)),
        ("dvxplorer.aedat4", 111_954, (320, 240)),
        ("prophesee_evt2.raw", 521_252, None),
    ],
)
def test_real_files(tmp_path: Path, name: str, events: int, size: tuple[int, int] | None):
    path = DATA / "readers" / name
    if not path.is_file():
        pytest.skip(f"no recordings at {DATA}; set EBARF_TEST_DATA to their folder")
    source = open_recording(path)
    assert source.sensor_size == size
    report = take_in(source, SIZE, Intake(), tmp_path / "out.h5")
    assert report.kept + sum(report.left_out.values()) == events


def test_a_cut_aedat4_is_an_error(tmp_path: Path):
    whole = DATA / "readers" / "dvxplorer.aedat4"
    if not whole.is_file():
        pytest.skip(f"no recordings at {DATA}; set EBARF_TEST_DATA to their folder")
    content = whole.read_bytes()
    for place in [*range(0, 64), *np.linspace(64, len(content) - 1, 100).astype(int).tolist()]:
        cut = tmp_path / "cut.aedat4"
        cut.write_bytes(content[:place])
        try:
            # Only a table of contents follows the last packet.
            assert sum(map(len, open_recording(cut).pieces)) == 111_954
        except RecordingError as error:
            assert "cut.aedat4" in str(error)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (gzip.compress(b"1 2 3 1", mtime=0), "compressed by gzip, expected the file within"),
        ("1 2 3 1".encode("utf-16"), "text in UTF-16, expected it in UTF-8"),
        (b"#!AER-DAT2.0\r\n\0\1\2", "AEDAT 2, as jAER writes it, expected AEDAT 4"),
    ],
)
def test_files_of_other_kinds_are_named(tmp_path: Path, content: bytes, words: str):
    (tmp_path / "events").write_bytes(content)
    with pytest.raises(RecordingError, match=words):
        open_recording(tmp_path / "events")


def test_text_below_comments_of_matlab_is_not_taken_for_prophesees(tmp_path: Path):
    (tmp_path / "events.txt").write_text("% t x y p\n1 2 3 1\n")
    assert recognised(tmp_path / "events.txt") == "text"
    assert recognised(writers.dat(tmp_path / "events.dat", [(1, 2, 3, 1)])) == "dat"


@pytest.mark.parametrize("p", [[0, 255], [1, 2], [-1, 0]])
def test_inspection_refuses_polarities_that_processing_refuses(tmp_path: Path, p: list[int]):
    np.savez(tmp_path / "a.npz", t=np.arange(40), x=np.arange(40) % 7, y=np.arange(40) % 5, p=np.tile(p, 20))
    with pytest.raises(RecordingError, match="expected 0 .darker. and 1 .brighter., or -1 and 1"):
        inspect_recording(lambda: open_recording(tmp_path / "a.npz"))


def test_an_npy_file_of_python_objects_is_not_unpickled(tmp_path: Path):
    np.save(tmp_path / "a.npy", np.array(dict(zip("txyp", columns(), strict=True))), allow_pickle=True)
    with pytest.raises(RecordingError, match="Python objects inside"):
        open_recording(tmp_path / "a.npy")
