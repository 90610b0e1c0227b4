"""Events sorted by pixel and time, in memory or in a temporary file."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np

from ebarf_ns.compiled import njit
from ebarf_ns.errors import RecordingError
from ebarf_ns.events.pairs import EVENT, PairIndex, counting
from ebarf_ns.events.pixels import dead_pixels, hot_pixels
from ebarf_ns.events.recording import Recording

if TYPE_CHECKING:
    pass


def index_pairs(
    chunks: Callable[[], Iterable[Recording]],
    width: int,
    height: int,
    memory_bytes: int = 1 << 62,
    doubles_us: int = 0,
) -> PairIndex:
    """Sort events by pixel and time; ``chunks`` yields them in time order and is called at least twice.

    An event that repeats the previous one at its pixel, with the same polarity and within ``doubles_us``, is dropped.

    An index larger than ``memory_bytes`` is stored in a temporary file and built one part of the sensor at a time; each
    part takes another pass over the events. Raises :class:`RecordingError` when no pixel has two events.
    """
    pixels = width * height
    counts = np.zeros(pixels, np.int64)
    for chunk in chunks():
        counts += np.bincount(chunk.pixels(width), minlength=pixels)
    first = np.r_[0, counts.cumsum()]
    total = int(first[-1])
    if counts.max() < 2:
        raise RecordingError(f"none of the {total:,} events has another one at its pixel: no pair to train on")
    in_memory = total * EVENT.itemsize <= memory_bytes
    events = np.empty(total, EVENT) if in_memory else _file_backed(total)
    at_once = total if in_memory else memory_bytes // EVENT.itemsize
    begin = 0
    while begin < pixels:
        end = max(int(np.searchsorted(first, first[begin] + at_once, side="right")) - 1, begin + 1)
        end = min(end, pixels)
        part = events[first[begin] : first[end]]
        free, sums = first[begin:end] - first[begin], np.zeros(end - begin, np.int32)
        for chunk in chunks():
            _place(chunk.pixels(width), chunk.t_us, chunk.polarity, begin, free, sums, part)
        begin = end
    if doubles_us:
        first = _drop_doubles(events, first, doubles_us)
        events, counts = events[: first[-1]], np.diff(first)
    hot = hot_pixels(counts, width)
    responsive = np.nonzero(~hot & ~dead_pixels(counts, width))[0]
    return counting(events, first, np.where(hot, 0, counts), responsive)


@njit(cache=True)
def _drop_doubles(events, first, doubles_us):
    """Remove double events in place; returns the new start index of each pixel."""
    kept, new_first = 0, np.zeros_like(first)
    for pixel in range(len(first) - 1):
        dropped, before, sum_before, last_us = 0, 0, 0, 0
        for k in range(first[pixel], first[pixel + 1]):
            t_us, running = events[k].t_us, events[k].running_polarity
            polarity, sum_before = running - sum_before, running
            if polarity == before and t_us - last_us <= doubles_us:
                dropped += polarity
                continue
            before, last_us = polarity, t_us
            events[kept].t_us, events[kept].running_polarity = t_us, running - dropped
            kept += 1
        new_first[pixel + 1] = kept
    return new_first


def _file_backed(count: int) -> np.ndarray:
    # An unnamed file is freed when the process ends, even if it crashes.
    size = count * EVENT.itemsize
    try:
        file = tempfile.TemporaryFile()
        # Allocate everything now: a full disk during a write to a mapped page would kill the process silently.
        os.posix_fallocate(file.fileno(), 0, size) if hasattr(os, "posix_fallocate") else file.truncate(size)
        return np.memmap(file, EVENT, "r+", shape=(count,))
    except OSError as error:
        raise RecordingError(
            f"{tempfile.gettempdir()}: no room for an index of {size / 2**30:.1f} GiB ({error.strerror}); "
            "expected TMPDIR to name a larger disk, or --pipeline.datamanager.index-memory-gib to be larger"
        ) from None


@njit(cache=True, nogil=True)
def _place(pixel, t_us, polarity, begin, free, sums, part):
    """Counting sort: each event of the pixels from ``begin`` on goes to its pixel's next free slot."""
    for i in range(len(pixel)):
        p = pixel[i] - begin
        if 0 <= p < len(free):
            sums[p] += polarity[i]
            part[free[p]]["t_us"] = t_us[i]
            part[free[p]]["running_polarity"] = sums[p]
            free[p] += 1
