"""Writers for foreign recording formats, implemented from the format descriptions, for tests only."""

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import h5py
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
        # Neighbours to the right, in order, share a word.
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
            # Vectors of twelve and eight neighbours, starting at the first one.
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


def ecf(events: Sequence[Event], layout: str) -> bytes:
    """A block of Prophesee's ECF; ``layout`` is "packed", "runs and packed" or "runs and masks"."""
    times = bytearray(np.array([events[0][0]], "<i8").tobytes())
    now, i = events[0][0], 0
    while i < len(events):
        step = events[i][0] - now
        run = next((k for k in range(1, len(events) - i) if events[i + k][0] != events[i][0]), len(events) - i)
        if step >= 15:
            while step:
                times.append(0xF0 | step & 15)
                step >>= 4
        times += bytes([step << 4 | run]) if run < 15 else bytes([step << 4 | 15, run & 255, run >> 8])
        now, i = events[i][0], i + run
    four = [*events, *[(0, 0, 0, 0)] * (-len(events) % 4)]
    header = np.array([len(events) << 2 | {"packed": 2, "runs and packed": 1}.get(layout, 0)], "<u4").tobytes()
    if layout == "packed":
        words = []
        for k in range(0, len(four), 4):
            a, b, c, d = (y << 12 | x << 1 | p for _, x, y, p in four[k : k + 4])
            words += [a << 8 | b & 255, b >> 8 << 16 | c & 0xFFFF, c >> 16 << 24 | d]
        return header + bytes(times) + np.array(words, "<u4").tobytes()
    words = []
    for y, run in runs([y for _, _, y, _ in events]):
        words += [y << 5 | run] if run < 31 else [y << 5 | 31, run]
    rows = np.array(words, "<u2").tobytes()
    if layout == "runs and packed":
        words = []
        for k in range(0, len(four), 4):
            a, b, c, d = (x << 1 | p for _, x, _, p in four[k : k + 4])
            words += [a << 4 | b & 15, b >> 4 << 8 | c & 255, c >> 8 << 12 | d]
        return header + bytes(times) + rows + np.array(words, "<u2").tobytes()
    words, i = [], 0
    while i < len(events):
        x, mask = events[i][1], 0
        i += 1
        for k in range(5):
            if i < len(events) and events[i][1] == x + k + 1:
                mask |= 16 >> k
                i += 1
        words.append(x << 5 | mask)
    polarities = b"".join(
        bytes([p << 7 | run]) if run < 127 else bytes([p << 7 | 127, run & 255, run >> 8])
        for p, run in runs([p for _, _, _, p in events])
    )
    return header + bytes(times) + rows + np.array(words, "<u2").tobytes() + polarities


def runs(values: Sequence[int]) -> list[tuple[int, int]]:
    return [(value, len(list(same))) for value, same in groupby(values)]


def ecf_file(path: Path, events: Sequence[Event], layouts: Sequence[str], chunk: int = 100) -> Path:
    """An HDF5 file as Metavision writes it, with chunks cycling through these layouts, or "as they are"."""
    event = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    settings.set_chunk((chunk,))
    settings.set_filter(36559, h5py.h5z.FLAG_OPTIONAL)
    with h5py.File(path, "w") as file:
        group, space = file.create_group("CD"), h5py.h5s.create_simple((len(events),), (h5py.h5s.UNLIMITED,))
        table = h5py.h5d.create(group.id, b"events", h5py.h5t.py_create(event), space, settings)
        for number, first in enumerate(range(0, len(events), chunk)):
            layout, some = layouts[number % len(layouts)], events[first : first + chunk]
            if layout == "as they are":
                plain = np.array([(x, y, p, t) for t, x, y, p in some], event).tobytes()
                table.write_direct_chunk((first,), plain, filter_mask=1)
            else:
                table.write_direct_chunk((first,), ecf(some, layout))
    return path
