"""ROS 1 and ROS 2 bags with events, through the ``rosbags`` library; ROS is not needed.

``dvs_msgs/EventArray`` (and the identical ``prophesee_event_msgs/EventArray``) is parsed here into arrays, since a
Python object per event would take minutes. ``event_camera_msgs/EventPacket`` holds the sensor's raw data.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from os.path import commonprefix
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.highlevel import AnyReader

from ebarf_ns.errors import RecordingError
from ebarf_ns.formats.readers.prophesee import Decoder, note_dropped
from ebarf_ns.formats.source import Piece, Source

_ARRAYS = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
_PACKETS = ("event_camera_msgs/msg/EventPacket", "event_array_msgs/msg/EventArray")
# ROS 1 packs an event into 13 bytes; ROS 2 aligns fields to their size, as below from the second event on.
_ROS1_EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("sec", "<u4"), ("nsec", "<u4"), ("p", "u1")])
_ROS2_EVENT = np.dtype(
    {
        "names": ["x", "y", "sec", "nsec", "p"],
        "formats": ["<u2", "<u2", "<i4", "<u4", "u1"],
        "offsets": [0, 2, 6, 10, 14],
        "itemsize": 16,
    }
)
_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
# Bytes per channel, channels, and conversion to grey; ROS and OpenCV name a Bayer pattern by different corners.
_ENCODINGS: dict[str, tuple[int, int, int | None]] = {
    "mono8": (1, 1, None), "8UC1": (1, 1, None), "mono16": (2, 1, None), "16UC1": (2, 1, None),
    "bgr8": (1, 3, cv2.COLOR_BGR2GRAY), "8UC3": (1, 3, cv2.COLOR_BGR2GRAY), "rgb8": (1, 3, cv2.COLOR_RGB2GRAY),
    "bgra8": (1, 4, cv2.COLOR_BGRA2GRAY), "8UC4": (1, 4, cv2.COLOR_BGRA2GRAY), "rgba8": (1, 4, cv2.COLOR_RGBA2GRAY),
    "bgr16": (2, 3, cv2.COLOR_BGR2GRAY), "rgb16": (2, 3, cv2.COLOR_RGB2GRAY),
    "bayer_rggb8": (1, 1, cv2.COLOR_BayerBG2GRAY), "bayer_bggr8": (1, 1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg8": (1, 1, cv2.COLOR_BayerGR2GRAY), "bayer_grbg8": (1, 1, cv2.COLOR_BayerGB2GRAY),
    "bayer_rggb16": (2, 1, cv2.COLOR_BayerBG2GRAY), "bayer_bggr16": (2, 1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg16": (2, 1, cv2.COLOR_BayerGR2GRAY), "bayer_grbg16": (2, 1, cv2.COLOR_BayerGB2GRAY),
}  # fmt: skip
_MONO_EVENT = np.dtype([("t_ns", "<u4"), ("x", "<u2"), ("y_p", "<u2")])


def read_bag(path: Path, topic: str | None = None) -> Source:
    """Read the events of ``topic``, by default the only one with events; raises :class:`RecordingError`."""
    with _opened(path) as bag:
        connections = _of_events(path, bag, topic)
        size = next((_sensor_size(bag, raw, one) for one, _, raw in bag.messages(connections)), None)
        name = f"ROS {2 if bag.is2 else 1} bag, {connections[0].msgtype} of {connections[0].topic}"
    dropped: Counter[str] = Counter()
    return Source(path, name, size, _pieces(path, topic, dropped), dropped)


def _of_events(path: Path, bag: AnyReader, topic: str | None) -> list[Any]:
    """The connections of the given topic, or of the only one with events."""
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
    """Open a bag; any exception of the library, which documents none, becomes a one-line error."""
    if path.is_file() and path.suffix != ".bag":
        # A ROS 2 bag is a folder, and a ROS 1 bag is recognised by its suffix. MCAP files are self-describing.
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
    """Offset of the fields after a message's std_msgs/Header."""
    # ROS 1: sequence number, seconds, nanoseconds; ROS 2: byte order, seconds, nanoseconds. Then the frame's name.
    (name_bytes,) = struct.unpack_from("<I", raw, 12)
    end = 16 + name_bytes
    return end + -end % 4 if ros2 else end


def _event_array(path: Path, number: int, raw: bytes, ros2: bool) -> np.ndarray:
    """The events of one message, without a copy for ROS 1; in ROS 2 the first event is aligned differently."""
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
    """64 bits per event: nanoseconds since the packet's base, column, row, and polarity in the last bit."""
    events = np.frombuffer(bytes(packet.events), _MONO_EVENT)
    t_us = (int(packet.time_base) + events["t_ns"].astype(np.int64) + 500) // 1000
    return Piece(events["x"], events["y_p"] & 0x7FFF, t_us, (events["y_p"] >> 15).astype(np.int8), place)


def read_bag_frames(
    path: Path, size: tuple[int, int], topic: str | None, left_out: Counter[str]
) -> Iterator[tuple[int, np.ndarray]]:
    """Read 8- or 16-bit grey images of the event sensor's size with their times in microseconds; others are counted.

    The topic with the longest name prefix in common with the events' topic is used (a bag may have two sensors); among
    several, raw images are preferred to rectified ones, grey to colour, uncompressed to compressed.
    """
    with _opened(path) as bag:
        events = _of_events(path, bag, topic)[0].topic
        images = {one.topic: [] for one in bag.connections if one.msgtype in (_IMAGE, _COMPRESSED)}
        for one in bag.connections:
            if one.topic in images:
                images[one.topic].append(one)
        looked_at = {name: _first(bag, connections, size) for name, connections in images.items()}
        chosen = min(images, key=lambda name: _rank(name, events, looked_at[name], images[name][0].msgtype), default="")
        for name, connections in images.items():
            if name != chosen and (count := sum(one.msgcount for one in connections)):
                problem = looked_at[name] if isinstance(looked_at[name], str) else f"those of {chosen} are taken"
                left_out[f"{name}: {problem}"] += count
        connections = images.get(chosen, [])
        shift = _empty_bits(bag, connections, size, looked_at.get(chosen))
        for connection, _, raw in bag.messages(connections) if connections else ():
            found = _picture(bag, raw, connection, size)
            if isinstance(found, str):
                left_out[f"{chosen}: {found}"] += 1
            else:
                yield found[0], found[1] << shift if found[1].dtype == np.uint16 else found[1]


_Found = tuple[int, np.ndarray] | str
"""Time and grey values, or what is wrong with a message."""


def _rank(name: str, events: str, found: _Found | None, kind: str) -> tuple[Any, ...]:
    wrong, rectified = not isinstance(found, tuple), "rect" in name.rsplit("/", 1)[-1]
    return wrong, -len(commonprefix([name, events])), rectified, "colo" in name, kind == _COMPRESSED, name


def _first(bag: AnyReader, connections: list[Any], size: tuple[int, int]) -> _Found | None:
    return next((_picture(bag, raw, one, size) for one, _, raw in bag.messages(connections)), None)


def _empty_bits(bag: AnyReader, connections: list[Any], size: tuple[int, int], first: _Found | None) -> int:
    """Number of upper bits of 16 that no picture uses: 10- and 12-bit sensors write nearly black images."""
    if not isinstance(first, tuple) or first[1].dtype != np.uint16:
        return 0
    found = (_picture(bag, raw, one, size) for one, _, raw in bag.messages(connections))
    brightest = max(int(one[1].max()) for one in found if isinstance(one, tuple) and one[1].dtype == np.uint16)
    return 16 - max(brightest.bit_length(), 8)


def _picture(bag: AnyReader, raw: bytes, connection: Any, size: tuple[int, int]) -> _Found:
    try:
        image: Any = bag.deserialize(raw, connection.msgtype)
        stamp = image.header.stamp
        grey = _decompressed(image) if connection.msgtype == _COMPRESSED else _grey(image)
    except Exception:
        # The library documents no exceptions; a damaged picture is no reason to refuse the events.
        return f"cannot be parsed, expected {connection.msgtype}"
    if isinstance(grey, np.ndarray) and grey.shape != size[::-1]:
        grey = f"{grey.shape[1]} x {grey.shape[0]} pixels, expected the event sensor's {size[0]} x {size[1]}"
    return grey if isinstance(grey, str) else (stamp.sec * 10**6 + (stamp.nanosec + 500) // 1000, grey)


def _grey(image: Any) -> np.ndarray | str:
    if image.encoding not in _ENCODINGS:
        return f"encoded as {image.encoding!r:.40}, expected one of {', '.join(_ENCODINGS)}"
    depth, channels, conversion = _ENCODINGS[image.encoding]
    width, height, length, used = image.width, image.height, len(image.data), image.width * channels * depth
    # A row may be padded, but not by its whole length, which indicates colour with a wrong encoding.
    if not (width and height and used <= image.step < 2 * used and length == image.step * height):
        return (
            f"{image.encoding} of {width} x {height} pixels in {length:,} bytes with rows of {image.step:,}, expected "
            f"{used * height:,} with rows of {used:,}"
        )
    rows = np.asarray(image.data, np.uint8).reshape(height, image.step)[:, :used]
    order = ">" if image.is_bigendian else "<"
    pixels = np.ascontiguousarray(rows).view(f"{order}u{depth}").astype(f"u{depth}")
    return pixels if conversion is None else cv2.cvtColor(pixels.reshape(height, width, -1), conversion)


def _decompressed(image: Any) -> np.ndarray | str:
    pixels = cv2.imdecode(np.frombuffer(bytes(image.data), np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        return f"compressed as {image.format!r:.40}, which cannot be read as a picture"
    return pixels
