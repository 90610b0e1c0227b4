"""AEDAT4, the container of iniVation's cameras, through the ``aedat`` library."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aedat
import numpy as np

from ebarf_ns.errors import RecordingError
from ebarf_ns.formats.source import Piece, Source, numbered

_MAGIC = b"#!AER-DAT4.0\r\n"


def read_aedat4(path: Path) -> Source:
    """Read the first event stream; raises :class:`RecordingError` for a damaged file or one without events."""
    _check_container(path)
    streams = _library(path, lambda: aedat.Decoder(path).id_to_stream())
    events = {number: stream for number, stream in streams.items() if stream["type"] == "events"}
    if not events:
        kinds = ", ".join(sorted(stream["type"] for stream in streams.values())) or "none"
        raise RecordingError(f"{path}: streams of {kinds}, expected one of events")
    number, stream = min(events.items())
    return Source(path, "AEDAT4", (int(stream["width"]), int(stream["height"])), _pieces(path, number))


def read_aedat4_frames(path: Path) -> Iterator[tuple[int, np.ndarray]]:
    """Read the frames, grey or BGR, with the middle of their exposure in microseconds."""
    _check_container(path)
    for packet in _packets(path):
        if (frame := packet.get("frame")) is not None:
            yield (int(frame["exposure_begin_t"]) + int(frame["exposure_end_t"])) // 2, np.asarray(frame["pixels"])


def _pieces(path: Path, stream: int) -> Iterator[Piece]:
    first = 0
    for packet in _packets(path):
        if packet["stream_id"] == stream and len(events := packet["events"]):
            t_us, on = events["t"].astype(np.int64), events["on"].astype(np.int8)
            yield Piece(events["x"], events["y"], t_us, on, numbered(first))
            first += len(events)


def _packets(path: Path) -> Iterator[dict[str, Any]]:
    decoder = _library(path, lambda: aedat.Decoder(path))
    while (packet := _library(path, lambda: next(decoder, None))) is not None:
        yield packet


def _library(path: Path, call: Any) -> Any:
    """Call the library; its failures become one-line errors."""
    try:
        return call()
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:
        # Some damage makes it panic, which is not an Exception.
        raise RecordingError(f"{path}: not a whole AEDAT4 file ({error})") from None


def _check_container(path: Path) -> None:
    """Walk over the packets by their lengths: a truncated file ends within one."""
    size = path.stat().st_size
    with path.open("rb") as file:
        start = file.read(len(_MAGIC) + 4)
        if not start.startswith(_MAGIC) or len(start) < len(_MAGIC) + 4:
            raise RecordingError(f"{path}: begins with {start[:14]!r}, expected AEDAT4's {_MAGIC!r}")
        (header_bytes,) = struct.unpack("<i", start[-4:])
        if not 0 < header_bytes <= size - len(start):
            raise RecordingError(f"{path}: a header of {header_bytes} bytes at byte 14, expected one within the file")
        header = file.read(header_bytes)
        position = len(start) + header_bytes
        end = _data_table(header)
        if not (end == -1 or position <= end <= size):
            raise RecordingError(
                f"{path}: its table of contents is said to be at byte {end:,}, but the file ends at {size:,}; "
                "expected the whole file"
            )
        end = size if end == -1 else end
        while position < end:
            file.seek(position)
            packet = file.read(8)
            length = struct.unpack("<ii", packet)[1] if len(packet) == 8 else -1
            if length < 0 or position + 8 + length > end:
                raise RecordingError(f"{path}: the packet at byte {position:,} is cut short, expected the whole file")
            position += 8 + length


def _data_table(header: bytes) -> int:
    """End of the packets from the header's second field (a flatbuffer table); -1 if not given."""
    try:
        (root,) = struct.unpack_from("<I", header, 0)
        (to_vtable,) = struct.unpack_from("<i", header, root)
        vtable = root - to_vtable
        (vtable_bytes,) = struct.unpack_from("<H", header, vtable)
        offset = struct.unpack_from("<H", header, vtable + 6)[0] if vtable_bytes > 6 else 0
        return struct.unpack_from("<q", header, root + offset)[0] if offset else -1
    except struct.error:
        return -1
