"""A recording of any format as its reader hands it on: what the header says, and the events piece by piece."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Int64, Num, Shaped

TimeUnit = Literal["s", "ms", "us", "ns"]
DECIMALS: dict[TimeUnit, int] = {"s": 6, "ms": 3, "us": 0, "ns": -3}
"""By which power of ten a time becomes microseconds."""
_LATEST_US = 1e18


@dataclass(frozen=True)
class Piece:
    """Some events in the file's order; that they are integers is all that is sure of them."""

    x: Shaped[np.ndarray, "events"]
    y: Shaped[np.ndarray, "events"]
    t_us: Int64[np.ndarray, "events"]
    polarity: Shaped[np.ndarray, "events"]
    """As the file has it: 0 and 1, or -1 and 1."""
    place: Callable[[int], str]
    """Where in the file an event of this piece is, for people."""

    def __len__(self) -> int:
        return len(self.t_us)


@dataclass(frozen=True)
class Source:
    """A recording that can be read once, from beginning to end, a piece at a time."""

    path: Path
    format: str
    """What it was recognised as, for people."""
    sensor_size: tuple[int, int] | None
    """Columns and rows, where the file says so."""
    pieces: Iterator[Piece]
    dropped: Counter[str] = field(default_factory=Counter)
    """Events that the file hints at but does not hold in full, by reason; counted while reading."""
    notes: tuple[str, ...] = ()
    """What was found out of columns and times, for people."""
    guessed_unit: TimeUnit | None = None
    """Of the times, where nothing but their look says so."""
    columns: str = ""
    """Their order, a letter each, where they have no names."""


def fits(t: Num[np.ndarray, "events"], unit: TimeUnit) -> Bool[np.ndarray, "events"]:
    """Whether times of that unit can be microseconds in 64 bits; not where they are not finite."""
    return np.abs(t.astype(np.float64)) * 10.0 ** DECIMALS[unit] <= _LATEST_US


def microseconds(t: Num[np.ndarray, "events"], unit: TimeUnit) -> Int64[np.ndarray, "events"]:
    """Times in a unit, rounded to the nearest; exact for integers."""
    decimals = DECIMALS[unit]
    if t.dtype.kind == "f":
        return np.rint(t.astype(np.float64) * 10.0**decimals).astype(np.int64)
    t = t.astype(np.int64, copy=False)
    if decimals == 0:
        return t
    return t * 10**decimals if decimals > 0 else (t + 500) // 1000


def numbered(first: int, word: str = "event") -> Callable[[int], str]:
    """A :attr:`Piece.place` that counts from ``first``."""
    return lambda k: f"{word} {first + k:,}"
