"""Prophesee's file formats: ``.raw`` in the encodings EVT2, EVT2.1 and EVT3, and ``.dat``.

Follows the format descriptions at docs.prophesee.ai (Data / Encoding Formats, File Formats). A ``.raw`` file has no
checksums: only words of an undefined type and a truncated last word can be detected.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Literal

import numpy as np

from ebarf_ns.compiled import njit
from ebarf_ns.errors import RecordingError
from ebarf_ns.formats.source import Piece, Source, numbered

Encoding = Literal["evt2", "evt2.1", "evt3"]
_WORD: dict[Encoding, str] = {"evt2": "<u4", "evt2.1": "<u8", "evt3": "<u2"}
_EVENTS_A_WORD: dict[Encoding, int] = {"evt2": 1, "evt2.1": 32, "evt3": 12}
_BYTES_AT_ONCE = 1 << 20
_LONGEST_HEADER = 1 << 16
TIMELESS = "events before the first time word, whose time is unknown"
"""Reason for dropped events of a stream."""
RESERVED = "words of reserved types, such as padding"
"""Reason for dropped words of a stream."""
_RESERVED_KINDS = np.isin(np.arange(16), (0x1, 0x9, 0xB, 0xC, 0xD))
_MANY_RESERVED, _PADDINGS = 0.1, 4
# State of a decoder between words.
_TIME_HIGH, _TIME_LOW, _EPOCH, _Y, _X_BASE, _POLARITY, _TIMELESS_EVENTS, _STATE = range(8)
_UNKNOWN = -1


@dataclass
class Decoder:
    """Decodes words of one encoding into events; the state of time and row persists between calls."""

    encoding: Encoding
    swapped_halves: bool = False
    """EVT2.1 as sent by sensors like the IMX636: the upper 32 bits of each word come first."""

    def __post_init__(self):
        self._state = np.full(_STATE, _UNKNOWN, np.int64)
        self._state[[_EPOCH, _TIMELESS_EVENTS]] = 0
        self._rest = b""
        self._reserved: Counter[int] = Counter()
        self.words = 0

    @property
    def timeless(self) -> int:
        """Number of events so far before the first time word."""
        return int(self._state[_TIMELESS_EVENTS])

    @property
    def dropped(self) -> dict[str, int]:
        """Dropped words and events so far, by reason."""
        return {TIMELESS: self.timeless, RESERVED: self._reserved.total()}

    @property
    def cut_bytes(self) -> int:
        """Number of bytes of an incomplete word at the end."""
        return len(self._rest)

    def feed(self, content: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Decode more bytes into x, y, t_us and polarity (0, 1) of their events.

        Raises :class:`ValueError` with the word's number for a type that the encoding does not have. EVT3's reserved
        types, which some cameras use as padding, are dropped unless they are frequent and diverse.
        """
        word = np.dtype(_WORD[self.encoding])
        content = self._rest + content
        whole = len(content) // word.itemsize * word.itemsize
        self._rest = content[whole:]
        words = np.frombuffer(content[:whole], word)
        if self.encoding == "evt3":
            self._check_reserved(words)
        if self.swapped_halves:
            words = (words << np.uint64(32)) | (words >> np.uint64(32))
        most = len(words) * _EVENTS_A_WORD[self.encoding]
        columns = (
            np.empty(most, np.uint16),
            np.empty(most, np.uint16),
            np.empty(most, np.int64),
            np.empty(most, np.int8),
        )
        count, bad = _DECODERS[self.encoding](words, self._state, *columns)
        if bad >= 0:
            raise ValueError(f"word {self.words + bad:,} is {int(words[bad]):#x}, not a {self.encoding.upper()} word")
        self.words += len(words)
        x, y, t_us, polarity = (column[:count].copy() for column in columns)
        return x, y, t_us, polarity

    def _check_reserved(self, words: np.ndarray) -> None:
        """Count words of reserved types; data other than EVT3 has many of diverse values, padding a few values."""
        reserved = _RESERVED_KINDS[words >> 12]
        if not reserved.any():
            return
        values, counts = np.unique(words[reserved], return_counts=True)
        self._reserved.update(dict(zip(values.tolist(), counts.tolist(), strict=True)))
        share = self._reserved.total() / (self.words + len(words))
        if share > _MANY_RESERVED and len(self._reserved) > _PADDINGS:
            first = int(reserved.argmax())
            raise ValueError(
                f"word {self.words + first:,} is {int(words[first]):#x}, not an EVT3 word, like {share:.0%} of all"
            )


def read_raw(path: Path) -> Source:
    """Read a ``.raw`` file; raises :class:`RecordingError` if its header names no known encoding."""
    header, begin = _header(path)
    encoding = _encoding(path, header)
    size = _size_of_raw(header)
    swapped = encoding == "evt2.1" and header.get("endianness", "").lower() != "little"
    dropped: Counter[str] = Counter()
    pieces = _raw_pieces(path, begin, Decoder(encoding, swapped), dropped)
    return Source(path, f"Prophesee {encoding.upper()}", size, pieces, dropped)


def _raw_pieces(path: Path, begin: int, decoder: Decoder, dropped: Counter[str]) -> Iterator[Piece]:
    events = 0
    with path.open("rb") as file:
        file.seek(begin)
        while content := file.read(_BYTES_AT_ONCE):
            try:
                columns = decoder.feed(content)
            except ValueError as error:
                raise RecordingError(
                    f"{path}: {error} (words begin at byte {begin:,}); expected the encoding of its header"
                ) from None
            note_dropped(decoder, dropped)
            if len(columns[0]):
                yield Piece(*columns, numbered(events))
                events += len(columns[0])
    if decoder.cut_bytes:
        dropped["words cut short by the end of the file"] += 1


def note_dropped(decoder: Decoder, dropped: Counter[str]) -> None:
    """Copy a decoder's counts of dropped words and events."""
    for reason, count in decoder.dropped.items():
        dropped[reason] = count


def _header(path: Path) -> tuple[dict[str, str], int]:
    """The header's fields, from lines ``% name value``, and its end offset."""
    fields: dict[str, str] = {}
    with path.open("rb") as file:
        end = 0
        while True:
            line = file.readline(_LONGEST_HEADER)
            if not line.startswith(b"%") or not line.endswith(b"\n"):
                return fields, end
            end += len(line)
            name, _, value = line[1:].decode("latin-1").strip().partition(" ")
            fields[name.lower()] = value.strip()
            if name.lower() == "end":
                return fields, end


def _encoding(path: Path, header: dict[str, str]) -> Encoding:
    named = header.get("format", "").split(";")[0] or f"EVT{header.get('evt', '')}"
    encodings: dict[str, Encoding] = {
        "EVT2": "evt2", "EVT2.0": "evt2", "EVT21": "evt2.1", "EVT2.1": "evt2.1", "EVT3": "evt3", "EVT3.0": "evt3",
    }  # fmt: skip
    encoding = encodings.get(named.upper())
    if encoding is None:
        raise RecordingError(f"{path}: its header says the encoding is {named!r}, expected EVT2, EVT2.1 or EVT3")
    return encoding


def _size_of_raw(header: dict[str, str]) -> tuple[int, int] | None:
    options = dict(part.split("=", 1) for part in header.get("format", "").split(";")[1:] if "=" in part)
    found = re.fullmatch(r"(\d+)x(\d+)", header.get("geometry", "")) or re.fullmatch(
        r"(\d+)x(\d+)", f"{options.get('width')}x{options.get('height')}"
    )
    return (int(found[1]), int(found[2])) if found else None


@njit(cache=True)
def _decode_evt2(words, state, x, y, t_us, polarity):
    """32-bit words: events with 6 bits of time, and time words with the 28 bits above them."""
    count = 0
    for i in range(len(words)):
        word = np.int64(words[i])
        kind = word >> 28
        if kind <= 1:
            if state[_TIME_HIGH] == _UNKNOWN:
                state[_TIMELESS_EVENTS] += 1
                continue
            x[count], y[count], polarity[count] = (word >> 11) & 0x7FF, word & 0x7FF, kind
            t_us[count] = state[_EPOCH] + (state[_TIME_HIGH] << 6) + ((word >> 22) & 0x3F)
            count += 1
        elif kind == 8:
            _advance(state, word & 0xFFFFFFF, 28, 34)
        elif kind not in (0xA, 0xE, 0xF):
            return count, i
    return count, -1


@njit(cache=True)
def _decode_evt21(words, state, x, y, t_us, polarity):
    """64-bit words: up to 32 neighbours in a row with 6 bits of time, and time words as in EVT2."""
    count = 0
    for i in range(len(words)):
        high, valid = np.int64(words[i] >> np.uint64(32)), np.int64(words[i] & np.uint64(0xFFFFFFFF))
        kind = high >> 28
        if kind <= 1:
            time = state[_EPOCH] + (state[_TIME_HIGH] << 6) + ((high >> 22) & 0x3F)
            for bit in range(32):
                if not (valid >> bit) & 1:
                    continue
                if state[_TIME_HIGH] == _UNKNOWN:
                    state[_TIMELESS_EVENTS] += 1
                    continue
                x[count], y[count], polarity[count] = ((high >> 11) & 0x7FF) + bit, high & 0x7FF, kind
                t_us[count] = time
                count += 1
        elif kind == 8:
            _advance(state, high & 0xFFFFFFF, 28, 34)
        elif kind not in (0xA, 0xE, 0xF):
            return count, i
    return count, -1


@njit(cache=True)
def _decode_evt3(words, state, x, y, t_us, polarity):
    """16-bit words, each of which sets one thing: the row, half of the time, or the start of a run of neighbours."""
    count = 0
    for i in range(len(words)):
        word = np.int64(words[i])
        kind, payload = word >> 12, word & 0xFFF
        if kind == 0x0:
            state[_Y] = payload & 0x7FF
        elif kind == 0x2 or kind == 0x4 or kind == 0x5:
            run, valid, base, sign = 1, 1, payload & 0x7FF, payload >> 11
            if kind != 0x2:
                run = 12 if kind == 0x4 else 8
                valid, base, sign = payload & ((1 << run) - 1), state[_X_BASE], state[_POLARITY]
                if base != _UNKNOWN:
                    state[_X_BASE] += run
            known = state[_TIME_HIGH] != _UNKNOWN and state[_Y] != _UNKNOWN and base != _UNKNOWN
            for bit in range(run):
                if not (valid >> bit) & 1:
                    continue
                if not known:
                    state[_TIMELESS_EVENTS] += 1
                    continue
                x[count], y[count], polarity[count] = base + bit, state[_Y], sign
                t_us[count] = state[_EPOCH] + (state[_TIME_HIGH] << 12) + state[_TIME_LOW]
                count += 1
        elif kind == 0x3:
            state[_X_BASE], state[_POLARITY] = payload & 0x7FF, payload >> 11
        elif kind == 0x6:
            state[_TIME_LOW] = payload
        elif kind == 0x8:
            if state[_TIME_HIGH] != payload:
                # The matching low half comes next.
                state[_TIME_LOW] = 0
            _advance(state, payload, 12, 24)
    # The other types are external triggers, continuations, or reserved.
    return count, -1


@njit(cache=True)
def _advance(state, high, bits, all_bits):
    """Set the upper part of the time; a decrease of more than half its range is an overflow."""
    if state[_TIME_HIGH] - high > (1 << (bits - 1)):
        state[_EPOCH] += 1 << all_bits
    state[_TIME_HIGH] = high


_DECODERS = {"evt2": _decode_evt2, "evt2.1": _decode_evt21, "evt3": _decode_evt3}


def read_dat(path: Path) -> Source:
    """Read a ``.dat`` file of change detection events; raises :class:`RecordingError` for other event types."""
    header, begin = _header(path)
    with path.open("rb") as file:
        file.seek(begin)
        kind = file.read(2)
    version = int(header.get("version", "2")) if header.get("version", "2").isdigit() else 0
    if len(kind) < 2 or kind[1] != 8 or kind[0] not in (0x00, 0x0C) or version not in (1, 2):
        raise RecordingError(
            f"{path}: version {header.get('version')!r}, event type and size {kind.hex()!r} at byte {begin}; expected "
            "change events of 8 bytes, version 1 or 2"
        )
    sizes = header.get("width", ""), header.get("height", "")
    size = (int(sizes[0]), int(sizes[1])) if sizes[0].isdigit() and sizes[1].isdigit() else None
    dropped: Counter[str] = Counter()
    return Source(path, f"Prophesee DAT {version}", size, _dat_pieces(path, begin + 2, version, dropped), dropped)


def _dat_pieces(path: Path, begin: int, version: int, dropped: Counter[str]) -> Iterator[Piece]:
    events, epoch_us, before = 0, 0, 0
    with path.open("rb") as file:
        file.seek(begin)
        while content := _read_whole(file, _BYTES_AT_ONCE):
            whole = len(content) // 8 * 8
            if whole < len(content):
                dropped["events cut short by the end of the file"] += 1
            time, address = np.frombuffer(content[:whole], "<u4").reshape(-1, 2).astype(np.int64).T
            if not len(time):
                return
            # 32-bit microseconds overflow after 71 minutes.
            turns = np.cumsum(np.diff(time, prepend=before) < -(1 << 31), dtype=np.int64)
            t_us = time + epoch_us + (turns << 32)
            before, epoch_us = int(time[-1]), epoch_us + (int(turns[-1]) << 32)
            if version == 2:
                x, y, polarity = address & 0x3FFF, (address >> 14) & 0x3FFF, (address >> 28) & 0xF
            else:
                x, y, polarity = address & 0x1FF, (address >> 9) & 0xFF, (address >> 17) & 1
            yield Piece(x, y, t_us, polarity, numbered(events))
            events += len(time)


def _read_whole(file: IO[bytes], size: int) -> bytes:
    """Read ``size`` bytes, or fewer at the end of the file."""
    content = file.read(size)
    while len(content) < size and (more := file.read(size - len(content))):
        content += more
    return content
