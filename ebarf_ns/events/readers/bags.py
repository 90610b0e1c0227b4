"""ROS 1 and ROS 2 bags with events, through the ``rosbags`` library: no ROS needed.

``dvs_msgs/EventArray`` (and ``prophesee_event_msgs/EventArray``, which is the same) is taken apart here, as an array:
a Python object for each event would take minutes. ``event_camera_msgs/EventPacket`` holds what the sensor sent.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from os.path import commonprefix
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader

from ebarf_ns.errors import RecordingError
from ebarf_ns.events.readers.prophesee import Decoder, note_dropped
from ebarf_ns.events.source import Piece, Source

_ARRAYS = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
_PACKETS = ("event_camera_msgs/msg/EventPacket", "event_array_msgs/msg/EventArray")
# ROS 1 packs an event's 13 bytes; ROS 2 aligns its fields to their size, from the second event on like this.
_ROS1_EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("sec", "<u4"), ("nsec", "<u4"), ("p", "u1")])
_ROS2_EVENT = np.dtype(
    {
        "names": ["x", "y", "sec", "nsec", "p"],
        "formats": ["<u2", "<u2", "<i4", "<u4", "u1"],
        "offsets": [0, 2, 6, 10, 14],
        "itemsize": 16,
    }
)
_MONO_EVENT = np.dtype([("t_ns", "<u4"), ("x", "<u2"), ("y_p", "<u2")])


def read_bag(path: Path, topic: str | None = None) -> Source:
    """The events of ``topic``, or of the only topic that has any; raises :class:`RecordingError`."""
    with _opened(path) as bag:
        connections = _of_events(path, bag, topic)
        size = next((_sensor_size(bag, raw, one) for one, _, raw in bag.messages(connections)), None)
        name = f"ROS {2 if bag.is2 else 1} bag, {connections[0].msgtype} of {connections[0].topic}"
    dropped: Counter[str] = Counter()
    return Source(path, name, size, _pieces(path, topic, dropped), dropped)


def _of_events(path: Path, bag: AnyReader, topic: str | None) -> list[Any]:
    """The connections of the topic that is asked for, or of the only one with events."""
    topics = {one.topic for one in bag.connections if one.msgtype in _ARRAYS + _PACKETS}
    if topic is None and len(topics) != 1:
        everything = ", ".join(sorted(f"{one.topic} ({one.msgtype})" for one in bag.connections)) or "none"
        raise RecordingError(
            f"{path}: {len(topics)} topics have events, expected one, or --part to choose; topics: {everything}"
        )
    if topic is not None and topic not in topics:
        raise RecordingError(f"{path}: topic {topic} has no events, expected one of {', '.join(topics) or 'none'}")
    chosen = topic or next(iter(topics))
    return [one for one in bag.connections if one.topic == chosen]


@contextmanager
def _opened(path: Path) -> Iterator[AnyReader]:
    """The bag; whatever a damaged one makes the library do, for it promises no kind of exception, is one line."""
    if path.is_file() and path.suffix != ".bag":
        # A ROS 2 bag is a folder, and one of ROS 1 is known by its suffix. MCAP's files describe themselves.
        if (path.parent / "metadata.yaml").is_file():
            path = path.parent
        elif path.suffix != ".mcap":
            raise RecordingError(
                f"{path}: no metadata.yaml beside it, expected a ROS 2 bag's folder ('ros2 bag reindex FOLDER' makes "
                "metadata.yaml), an .mcap or a .bag file"
            )
    try:
        with AnyReader([path]) as bag:
            yield bag
    except RecordingError:
        raise
    except Exception as error:
        raise RecordingError(f"{path}: not a whole bag ({type(error).__name__}: {error})") from None


def _pieces(path: Path, topic: str | None, dropped: Counter[str]) -> Iterator[Piece]:
    decoder: Decoder | None = None
    with _opened(path) as bag:
        connections = _of_events(path, bag, topic)
        for number, (connection, _, raw) in enumerate(bag.messages(connections)):
            place = _place_in(number)
            if connection.msgtype in _ARRAYS:
                events = _event_array(path, number, raw, bag.is2)
                t_us = (events["sec"].astype(np.int64) * 10**9 + events["nsec"].astype(np.int64) + 500) // 1000
                piece = Piece(events["x"], events["y"], t_us, events["p"], place)
            else:
                packet: Any = bag.deserialize(raw, connection.msgtype)
                if packet.encoding == "evt3":
                    decoder = decoder or Decoder("evt3")
                    piece = _evt3(path, number, decoder, packet)
                    note_dropped(decoder, dropped)
                elif packet.encoding == "mono":
                    piece = _mono(packet, place)
                else:
                    raise RecordingError(
                        f"{path}: message {number} is encoded as {packet.encoding!r}, expected evt3 or mono"
                    )
            if len(piece):
                yield piece


def _place_in(message: int) -> Callable[[int], str]:
    return lambda k: f"event {k:,} of message {message:,}"


def _sensor_size(bag: AnyReader, raw: bytes, connection: Any) -> tuple[int, int]:
    if connection.msgtype in _ARRAYS:
        begin = _after_header(raw, bag.is2)
        height, width = struct.unpack_from("<II", raw, begin)
        return int(width), int(height)
    packet: Any = bag.deserialize(raw, connection.msgtype)
    return int(packet.width), int(packet.height)


def _after_header(raw: bytes, ros2: bool) -> int:
    """Where the fields after a message's std_msgs/Header begin."""
    # ROS 1: number, seconds, nanoseconds; ROS 2: byte order, seconds, nanoseconds. Then the frame's name.
    (name_bytes,) = struct.unpack_from("<I", raw, 12)
    end = 16 + name_bytes
    return end + -end % 4 if ros2 else end


def _event_array(path: Path, number: int, raw: bytes, ros2: bool) -> np.ndarray:
    """The events of one message, without a copy but for the first one's in ROS 2, which lies differently."""
    problem = f"{path}: message {number} of {len(raw)} bytes is no EventArray"
    try:
        if ros2 and raw[1] != 1:
            raise RecordingError(f"{problem} in little-endian order")
        begin = _after_header(raw, ros2) + 8
        (count,) = struct.unpack_from("<I", raw, begin)
        begin += 4
        if not ros2:
            return np.frombuffer(raw, _ROS1_EVENT, count, begin)
        events = np.empty(count, _ROS2_EVENT)
        if count:
            events[0] = struct.unpack_from("<HHiIB", raw, begin)
            # The last event lacks its padding.
            rest = np.frombuffer(raw[begin + 14 :] + b"\0", np.uint8)[: 16 * (count - 1)]
            events[1:] = rest.view(_ROS2_EVENT) if count > 1 else events[1:]
        return events
    except (struct.error, ValueError, IndexError):
        raise RecordingError(f"{problem}, expected as many events as it says") from None


def _evt3(path: Path, number: int, decoder: Decoder, packet: Any) -> Piece:
    try:
        return Piece(*decoder.feed(bytes(packet.events)), _place_in(number))
    except ValueError as error:
        raise RecordingError(f"{path}: message {number}: {error}") from None


def _mono(packet: Any, place: Callable[[int], str]) -> Piece:
    """64 bits an event: nanoseconds since the packet's base, column, row, and in the last bit polarity."""
    events = np.frombuffer(bytes(packet.events), _MONO_EVENT)
    t_us = (int(packet.time_base) + events["t_ns"].astype(np.int64) + 500) // 1000
    return Piece(events["x"], events["y_p"] & 0x7FFF, t_us, (events["y_p"] >> 15).astype(np.int8), place)


def read_bag_frames(path: Path, size: tuple[int, int], topic: str | None = None) -> Iterator[tuple[int, np.ndarray]]:
    """8-bit grey images as large as the event sensor, with their times in microseconds: those of the topic whose name
    is most like that of the events' (of two sensors in a bag, either has its own)."""
    with _opened(path) as bag:
        events = _of_events(path, bag, topic)[0].topic
        images = [one for one in bag.connections if one.msgtype == "sensor_msgs/msg/Image"]
        for name in sorted({one.topic for one in images}, key=lambda name: (-len(commonprefix([name, events])), name)):
            found = False
            for connection, _, raw in bag.messages([one for one in images if one.topic == name]):
                image: Any = bag.deserialize(raw, connection.msgtype)
                if (image.width, image.height) != size or image.encoding not in ("mono8", "8UC1"):
                    break
                found = True
                grey = np.asarray(image.data, np.uint8).reshape(image.height, image.step)[:, : image.width]
                yield image.header.stamp.sec * 10**6 + (image.header.stamp.nanosec + 500) // 1000, grey
            if found:
                return
