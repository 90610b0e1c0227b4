"""Speed and memory of converting recordings to scenes, against the reading speed of other libraries."""

from __future__ import annotations

import json
import os
import statistics
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from datetime import date
from pathlib import Path
from time import perf_counter
from typing import Any

import h5py
import numpy as np

from ebarf_ns.benchmarks.figures import Figure, machine
from ebarf_ns.benchmarks.settings import RecordingsBenchmark
from ebarf_ns.formats.intake import Intake, take_in
from ebarf_ns.formats.recognise import open_recording
from ebarf_ns.memory import peak_memory_mib

SIZE = (640, 480)
_EVENTS_A_MESSAGE = 20_000
_PIECE = 1 << 20


def run_recordings_benchmark(
    settings: RecordingsBenchmark, say: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Time the conversion of a file in each format to a scene, and the simplest ways of reading that file."""
    figures = []
    with tempfile.TemporaryDirectory() as folder:
        for figure in _figures(settings, Path(folder)):
            figures.append({**vars(figure), "verdict": figure.verdict})
            say(f"  {figure.what}: {figure.value:.3g} {figure.unit} {figure.target} {figure.verdict}")
    return {"date": date.today().isoformat(), "machine": machine(), "figures": figures}


def _figures(settings: RecordingsBenchmark, folder: Path) -> Iterator[Figure]:
    targets = {"hdf5": 20.0, "evt3": 5.0, "aedat4": 5.0, "bag": 5.0, "text": 3.0}
    for name, target in targets.items():
        count = settings.events if name == "hdf5" else settings.events // 10
        path = _WRITERS[name](folder, count)
        _settle()
        ours = _median_seconds(path, folder / "out.h5", 5)
        yield Figure(f"{name}, {count:,} events into a scene", count / ours / 1e6, "M events/s", at_least=target)
        for library, read in _PLAIN.get(name, {}).items():
            yield Figure(f"{name}, the same by {library}", count / _seconds(read, path) / 1e6, "M events/s")
        path.unlink()
    if settings.huge:
        path = write_hdf5(folder, settings.huge)
        _settle()
        child = [sys.executable, "-m", "ebarf_ns.benchmarks.recordings", str(path), str(folder / "out.h5")]
        finished = subprocess.run(child, capture_output=True, text=True, check=True)
        result = json.loads(finished.stdout.splitlines()[-1])
        name = f"hdf5, {settings.huge:,} events into a scene"
        yield Figure(f"{name}: memory", result["peak_memory_mib"] / 1024, "GiB", at_most=1.0)
        yield Figure(name, settings.huge / result["seconds"] / 1e6, "M events/s", at_least=20.0)


def _settle() -> None:
    """Flush pending writes to disk, so that they do not disturb the timing."""
    if hasattr(os, "sync"):
        os.sync()


def _median_seconds(path: Path, output: Path, repetitions: int) -> float:
    """Median time after a warm-up run, which compiles kernels and allocates memory."""
    _convert(path, output)
    return statistics.median(_seconds(_convert, path, output) for _ in range(repetitions))


def _seconds(call: Callable[..., object], *arguments: object) -> float:
    started = perf_counter()
    call(*arguments)
    return perf_counter() - started


def _convert(path: Path, output: Path) -> None:
    take_in(open_recording(path), SIZE, Intake(), output)


def _columns(first: int, count: int) -> tuple[np.ndarray, ...]:
    """Ten million events per second, ten in each microsecond."""
    random = np.random.default_rng(first)
    x, y = random.integers(0, SIZE[0], count), random.integers(0, SIZE[1], count)
    return (np.arange(first, first + count) // 10, x, y, random.integers(0, 2, count))


def write_hdf5(folder: Path, count: int) -> Path:
    """HDF5 in the layout of TUM-VIE and DSEC."""
    path = folder / "events.h5"
    with h5py.File(path, "w") as file:
        made = {
            name: file.create_dataset(f"events/{name}", (count,), dtype, chunks=(min(1 << 17, count),))
            for name, dtype in (("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1"))
        }
        for first in range(0, count, _PIECE):
            for name, column in zip("txyp", _columns(first, min(_PIECE, count - first)), strict=True):
                made[name][first : first + len(column)] = column
    return path


def _write_evt3(folder: Path, count: int) -> Path:
    """EVT3 with time and row words before every event, as for scattered events."""
    path = folder / "events.raw"
    with path.open("wb") as file:
        file.write(b"% evt 3.0\n% geometry 640x480\n% end\n")
        for first in range(0, count, _PIECE):
            t, x, y, p = _columns(first, min(_PIECE, count - first))
            words = np.stack([0x8000 | (t >> 12) & 0xFFF, 0x6000 | t & 0xFFF, y, 0x2000 | p << 11 | x], axis=1)
            file.write(words.astype("<u2").tobytes())
    return path


def aedat4(pieces: Iterable[tuple[np.ndarray, ...]], size: tuple[int, int] = SIZE) -> Iterator[bytes]:
    """An uncompressed AEDAT4 file from chunks of t [us], x, y and polarity: a header and one packet per chunk."""
    description = (
        '<dv version="2.0"><node name="outInfo" path="/"><node name="0" path="/0/">'
        '<attr key="compression" type="string">NONE</attr><attr key="typeIdentifier" type="string">EVTS</attr>'
        f'<node name="info" path="/0/info/"><attr key="sizeX" type="int">{size[0]}</attr>'
        f'<attr key="sizeY" type="int">{size[1]}</attr></node></node></node></dv>'
    ).encode()
    # Flatbuffers: root offset, identifier, and a table of compression, end of the packets (not given) and description.
    table = struct.pack("<5Hi2Iq", 10, 20, 4, 12, 8, 10, 0, 12, -1)
    header = struct.pack("<I4s6x", 24, b"IOHE") + table + struct.pack("<I", len(description)) + description + b"\0"
    yield b"#!AER-DAT4.0\r\n" + struct.pack("<I", len(header)) + header
    event = np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("on", "u1"), ("unused", "V3")])
    for t, x, y, p in pieces:
        events = np.zeros(len(t), event)
        events["t"], events["x"], events["y"], events["on"] = t, x, y, p
        packet = struct.pack("<I4s2x3Hi2I", 16, b"EVTS", 6, 8, 4, 6, 4, len(t)) + events.tobytes()
        yield struct.pack("<2iI", 0, 4 + len(packet), len(packet)) + packet


def _write_aedat4(folder: Path, count: int) -> Path:
    path = folder / "events.aedat4"
    firsts = range(0, count, _EVENTS_A_MESSAGE)
    with path.open("wb") as file:
        file.writelines(aedat4(_columns(first, min(_EVENTS_A_MESSAGE, count - first)) for first in firsts))
    return path


def _write_bag(folder: Path, count: int) -> Path:
    """A ROS 1 bag with dvs_msgs/EventArray messages."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("uint16 x\nuint16 y\ntime ts\nbool polarity\n", "dvs_msgs/msg/Event"))
    array = "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events\n"
    store.register(get_types_from_msg(array, "dvs_msgs/msg/EventArray"))
    event = np.dtype([("x", "<u2"), ("y", "<u2"), ("sec", "<u4"), ("nsec", "<u4"), ("p", "u1")])
    path = folder / "events.bag"
    with Writer(path) as bag:
        connection = bag.add_connection("/dvs/events", "dvs_msgs/msg/EventArray", typestore=store)
        for first in range(0, count, _EVENTS_A_MESSAGE):
            t, x, y, p = _columns(first, min(_EVENTS_A_MESSAGE, count - first))
            events = np.zeros(len(t), event)
            events["x"], events["y"], events["p"] = x, y, p
            events["sec"], events["nsec"] = t // 10**6, t % 10**6 * 1000
            header = np.array([0, 0, 0, 0, SIZE[1], SIZE[0], len(t)], "<u4").tobytes()
            bag.write(connection, 10**9 + first, header + events.tobytes())
    return path


def _write_text(folder: Path, count: int) -> Path:
    path = folder / "events.txt"
    with path.open("w") as file:
        for first in range(0, count, _PIECE):
            columns = (column.tolist() for column in _columns(first, min(_PIECE, count - first)))
            file.writelines(f"{t // 10**6}.{t % 10**6:06d} {x} {y} {p}\n" for t, x, y, p in zip(*columns, strict=True))
    return path


def _read_h5py(path: Path) -> None:
    with h5py.File(path, "r") as file:
        for name in "txyp":
            _ = file[f"events/{name}"][:]  # pyright: ignore[reportIndexIssue]


def _read_loadtxt(path: Path) -> None:
    np.loadtxt(path)


def _read_pandas(path: Path) -> None:
    import pandas

    pandas.read_csv(path, sep=" ", header=None)


def _read_rosbags(path: Path) -> None:
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as bag:
        for connection, _, raw in bag.messages():
            bag.deserialize(raw, connection.msgtype)


_WRITERS = {
    "hdf5": write_hdf5, "evt3": _write_evt3, "aedat4": _write_aedat4, "bag": _write_bag, "text": _write_text
}  # fmt: skip
_PLAIN: dict[str, dict[str, Callable[[Path], None]]] = {
    "hdf5": {"h5py, the columns alone": _read_h5py},
    "bag": {"rosbags, as Python objects": _read_rosbags},
    "text": {"numpy.loadtxt": _read_loadtxt, "pandas.read_csv": _read_pandas},
}


if __name__ == "__main__":
    seconds = _median_seconds(Path(sys.argv[1]), Path(sys.argv[2]), 3)
    print(json.dumps({"seconds": seconds, "peak_memory_mib": peak_memory_mib()}))
