"""A test sensor: textures that slide across rows of pixels, seen with thresholds and refractory periods."""

from collections.abc import Callable

import numpy as np

from ebarf_ns.events.indexing import index_pairs
from ebarf_ns.events.pairs import PairIndex
from ebarf_ns.events.recording import Recording

WIDTH, HEIGHT = 48, 30
STEP_US = 100
_SAMPLES_PER_PX = 8


def one_way(t_s: np.ndarray) -> np.ndarray:
    """Shift in pixels of a pan that never returns."""
    return 90 * t_s + 6 * np.sin(5 * t_s)


def to_and_fro(t_s: np.ndarray) -> np.ndarray:
    """Shift in pixels of a handheld camera."""
    return 30 * np.sin(4 * t_s) + 8 * np.sin(11 * t_s + 1)


def photograph(random: np.random.Generator, length: int) -> np.ndarray:
    """Log brightness along each row, sampled every eighth of a pixel: edges of many sizes and contrasts.

    As in photographs, contrasts are heavy-tailed, and some rows are out of focus.
    """
    rows = np.zeros((HEIGHT, length))
    for row in rows:
        for _ in range(length // 60):
            begin, size = random.integers(0, length), int(np.exp(random.uniform(np.log(8), np.log(400))))
            row[begin : begin + size] += np.clip(random.laplace(0, 0.6), -3, 3)
        width = random.uniform(0.15, 1.5) * _SAMPLES_PER_PX
        blur = np.exp(-0.5 * (np.arange(-40, 41) / width) ** 2)
        row[:] = np.convolve(row, blur / blur.sum(), mode="same")
    return rows


def stripes(random: np.random.Generator, length: int) -> np.ndarray:
    """Log brightness of black and white stripes of many widths, blurred by a lens."""
    rows = np.zeros((HEIGHT, length))
    for row in rows:
        edges = np.cumsum(random.integers(3 * _SAMPLES_PER_PX, 20 * _SAMPLES_PER_PX, length // 24))
        row[:] = 1.5 * (np.searchsorted(edges, np.arange(length), side="right") % 2)
    blur = np.exp(-0.5 * (np.arange(-24, 25) / (0.8 * _SAMPLES_PER_PX)) ** 2)
    return np.apply_along_axis(np.convolve, 1, rows, blur / blur.sum(), mode="same")


def record(
    texture: Callable = photograph,
    motion: Callable = to_and_fro,
    on: float = 0.2,
    off: float = 0.2,
    refractory_us: float = 0.0,
    jitter_us: float = 0.0,
    seconds: float = 2.0,
    seed: int = 0,
) -> Recording:
    """The sensor's events; after a refractory period, a pixel takes the current brightness as its reference."""
    random = np.random.default_rng(seed)
    t_us = np.arange(0, seconds * 1e6, STEP_US)
    shift = (motion(t_us * 1e-6) * _SAMPLES_PER_PX).astype(np.float64)
    shift -= shift.min()
    rows = texture(random, int(shift.max()) + (WIDTH + 2) * _SAMPLES_PER_PX)
    column = np.arange(WIDTH) * _SAMPLES_PER_PX

    def seen(k: int) -> np.ndarray:
        at = column + shift[k]
        left = at.astype(int)
        return rows[:, left] + (at - left) * (rows[:, left + 1] - rows[:, left])

    before = seen(0)
    # Reference levels are spread over the thresholds, as in a sensor that has run for a while.
    level = before + random.uniform(-off, on, before.shape)
    free_us = np.zeros_like(before)
    found = []
    for k in range(1, len(t_us)):
        after, now_us = seen(k), np.full(before.shape, t_us[k - 1])
        for _ in range(20):
            # A refractory period that ends within this step resets the level at that time.
            opens = (free_us > now_us) & (free_us < t_us[k])
            part = (free_us - t_us[k - 1]) / STEP_US
            level = np.where(opens, before + part * (after - before), level)
            now_us = np.where(opens, free_us, now_us)
            rises, falls = after >= level + on, after <= level - off
            fires = (rises | falls) & (free_us <= now_us)
            if not fires.any():
                break
            crossed = np.where(rises, level + on, level - off)
            slope = np.where(after == before, 1, after - before)
            at_us = np.clip(t_us[k - 1] + STEP_US * (crossed - before) / slope, now_us, t_us[k])
            y, x = np.nonzero(fires)
            found.append(np.stack([x, y, at_us[y, x], np.where(rises, 1, -1)[y, x]]))
            level, now_us = np.where(fires, crossed, level), np.where(fires, at_us, now_us)
            free_us = np.where(fires, at_us + refractory_us, free_us)
        before = after
    x, y, at_us, polarity = np.concatenate(found, axis=1)
    at_us = np.clip(np.rint(at_us + jitter_us * random.standard_normal(len(at_us))), 0, None)
    order = np.argsort(at_us, kind="stable")
    columns = (x.astype(np.uint16), y.astype(np.uint16), at_us.astype(np.int64), polarity.astype(np.int8))
    return Recording(*(column[order] for column in columns))


def index_of(recording: Recording) -> PairIndex:
    """Index of the recording."""
    return index_pairs(lambda: [recording], WIDTH, HEIGHT)
