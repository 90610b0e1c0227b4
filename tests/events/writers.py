"""Recordings in other people's formats, written as the formats' descriptions have them: for tests alone."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ebarf_ns.events.recording import Recording

Event = tuple[int, int, int, int]
"""t_us, x, y, polarity (0 or 1)."""


def recording(events: Sequence[Event]) -> Recording:
    t, x, y, p = (np.array(column, np.int64) for column in zip(*events, strict=True))
    return Recording(x.astype(np.uint16), y.astype(np.uint16), t, np.where(p > 0, 1, -1).astype(np.int8))


def evt2(events: Sequence[Event]) -> bytes:
    words, high = [], -1
    for t, x, y, p in events:
        if t >> 6 != high:
            high = t >> 6
            words.append(0x8 << 28 | high & 0xFFFFFFF)
        words.append(p << 28 | (t & 0x3F) << 22 | x << 11 | y)
    return np.array(words, "<u4").tobytes()


def evt21(events: Sequence[Event], swapped: bool = False) -> bytes:
    words, high, k = [], -1, 0
    while k < len(events):
        t, x, y, p = events[k]
        if t >> 6 != high:
            high = t >> 6
            words.append((0x8 << 28 | high & 0xFFFFFFF) << 32)
        valid = 1
        k += 1
        # Neighbours to the right, in order, go into the same word.
        while k < len(events) and events[k][0] == t and events[k][2:] == (y, p):
            bit = events[k][1] - x
            if not bit.bit_length() or bit >= 32 or bit < valid.bit_length():
                break
            valid |= 1 << bit
            k += 1
        words.append((p << 28 | (t & 0x3F) << 22 | x << 11 | y) << 32 | valid)
    columns = np.array(words, "<u8")
    return columns.view("<u4").reshape(-1, 2)[:, ::-1].tobytes() if swapped else columns.tobytes()


def evt3(events: Sequence[Event]) -> bytes:
    words: list[int] = []
    high = low = row = -1
    k = 0
    while k < len(events):
        t, x, y, p = events[k]
        if t >> 12 != high:
            high, low = t >> 12, -1
            words.append(0x8000 | high & 0xFFF)
        if t & 0xFFF != low:
            low = t & 0xFFF
            words.append(0x6000 | low)
        if y != row:
            row = y
            words.append(y)
        run = [x]
        while k + len(run) < len(events):
            later = events[k + len(run)]
            if later[0] != t or later[2:] != (y, p) or not run[-1] < later[1] < x + 20:
                break
            run.append(later[1])
        if len(run) == 1:
            words.append(0x2000 | p << 11 | x)
        else:
            # Twelve and eight neighbours from the first one on.
            valid = sum(1 << one - x for one in run)
            words += [0x3000 | p << 11 | x, 0x4000 | valid & 0xFFF, 0x5000 | valid >> 12]
        k += len(run)
    return np.array(words, "<u2").tobytes()


def raw(path: Path, encoding: str, content: bytes, size: tuple[int, int] | None = (640, 480)) -> Path:
    geometry = f"% geometry {size[0]}x{size[1]}\n" if size else ""
    path.write_bytes(f"% Date 2026-01-01 00:00:00\n% evt {encoding}\n{geometry}% end\n".encode() + content)
    return path


def dat(path: Path, events: Sequence[Event]) -> Path:
    header = b"% Data file containing CD events.\n% Version 2\n% Width 640\n% Height 480\n"
    words = [(t & 0xFFFFFFFF, x | y << 14 | p << 28) for t, x, y, p in events]
    path.write_bytes(header + bytes([0x0C, 8]) + np.array(words, "<u4").tobytes())
    return path
