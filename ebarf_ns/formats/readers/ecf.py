"""ECF, the compression of Prophesee's HDF5 files: run lengths of times, rows and polarities, and packed numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ebarf_ns.compiled import njit

if TYPE_CHECKING:
    from jaxtyping import Int64, UInt8, UInt16

FILTER = 36559
_HEADER_BYTES = 12
_MOST_EVENTS = 65535


def decode(
    content: bytes,
) -> tuple[UInt16[np.ndarray, "n"], UInt16[np.ndarray, "n"], Int64[np.ndarray, "n"], UInt8[np.ndarray, "n"]]:
    """Decode x, y, t [us] and polarity (0 or 1) of a block; raises :class:`ValueError` if invalid or truncated."""
    if len(content) < _HEADER_BYTES:
        raise ValueError(f"an ECF block of {len(content)} bytes, expected {_HEADER_BYTES} or more")
    raw = np.frombuffer(content, np.uint8)
    header, origin_us = int(raw[:4].view("<u4")[0]), int(raw[4:12].view("<i8")[0])
    count = header >> 2
    if count > _MOST_EVENTS:
        raise ValueError(f"an ECF block of {count} events, expected at most {_MOST_EVENTS}")
    x, y, p = np.empty(count, np.uint16), np.empty(count, np.uint16), np.empty(count, np.uint8)
    t_us = np.empty(count, np.int64)
    place = _times(raw, _HEADER_BYTES, origin_us, t_us)
    packed = np.empty(count, np.int64)
    if header & 2:
        place = _packed(raw, place, 4, packed)
        y[:], x[:], p[:] = packed >> 12 & 2047, packed >> 1 & 2047, packed & 1
    else:
        place = _runs(raw, place, 2, 5, y)
        if header & 1:
            place = _packed(raw, place, 2, packed)
            x[:], p[:] = packed >> 1 & 2047, packed & 1
        else:
            place = _runs(raw, _masked_columns(raw, place, x), 1, 7, p)
    if place < 0:
        raise ValueError(f"an ECF block of {len(content)} bytes ends within its {count} events")
    return x, y, t_us, p


@njit(cache=True)
def _times(raw, place, now_us, t_us):
    """Bytes of a time step (upper half) and a run length (lower half; 15: two more bytes follow); an upper half of 15
    marks a digit of a longer step, lowest first."""
    i = 0
    while i < len(t_us):
        if place >= len(raw):
            return -1
        step, run = np.int64(raw[place] >> 4), np.int64(raw[place] & 15)
        place += 1
        if step == 15:
            shift = 0
            while True:
                if shift > 56 or place >= len(raw):
                    return -1
                now_us += run << shift
                if raw[place] >> 4 != 15:
                    break
                run, shift, place = np.int64(raw[place] & 15), shift + 4, place + 1
            continue
        if run == 15:
            if place + 2 > len(raw):
                return -1
            run, place = _word(raw, place, 2), place + 2
        if not 0 < run <= len(t_us) - i:
            return -1
        now_us += step
        t_us[i : i + run] = now_us
        i += run
    return place


@njit(cache=True, inline="always")
def _word(raw, place, size):
    """Little-endian integer of ``size`` bytes."""
    value = np.int64(0)
    for k in range(size):
        value |= np.int64(raw[place + k]) << (8 * k)
    return value


@njit(cache=True)
def _runs(raw, place, size, bits, values):
    """Words of ``size`` bytes: a value above a run length of ``bits`` bits; all ones: two more bytes hold it."""
    i, most = 0, (1 << bits) - 1
    while i < len(values):
        if place < 0 or place + size > len(raw):
            return -1
        word = _word(raw, place, size)
        run, place = word & most, place + size
        if run == most:
            if place + 2 > len(raw):
                return -1
            run, place = _word(raw, place, 2), place + 2
        if not 0 < run <= len(values) - i:
            return -1
        values[i : i + run] = word >> bits
        i += run
    return place


@njit(cache=True)
def _masked_columns(raw, place, x):
    """Two bytes: a column above a 5-bit mask of the next five columns."""
    i = 0
    while i < len(x):
        if place < 0 or place + 2 > len(raw):
            return -1
        word = _word(raw, place, 2)
        place += 2
        x[i] = word >> 5
        i += 1
        for k in range(5):
            if word & (16 >> k) and i < len(x):
                x[i] = (word >> 5) + k + 1
                i += 1
    return place


@njit(cache=True)
def _packed(raw, place, size, numbers):
    """Four numbers in three words of ``size`` bytes: 12 bits each, column and polarity, or 24 bits, with the row."""
    quarter = 2 * size
    ones = (1 << quarter) - 1
    for i in range(0, len(numbers), 4):
        if place < 0 or place + 3 * size > len(raw):
            return -1
        a, b, c = _word(raw, place, size), _word(raw, place + size, size), _word(raw, place + 2 * size, size)
        place += 3 * size
        # The second and third numbers span two words, with their lower bits in the earlier one.
        second = a & ones | b >> 2 * quarter << quarter
        third = b & (1 << 2 * quarter) - 1 | c >> 3 * quarter << 2 * quarter
        four = (a >> quarter, second, third, c & (1 << 3 * quarter) - 1)
        for k in range(min(4, len(numbers) - i)):
            numbers[i + k] = four[k]
    return place
