"""A recording of any format as delivered by its reader: header information and pieces of events."""

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
"""Power of ten that converts a time to microseconds."""
_LATEST_US = 1e18


@dataclass(frozen=True)
class Piece:
    """Some events in file order; only their integer type has been checked."""

    x: Shaped[np.ndarray, "events"]
    y: Shaped[np.ndarray, "events"]
    t_us: Int64[np.ndarray, "events"]
    polarity: Shaped[np.ndarray, "events"]
    """As in the file: 0 and 1, or -1 and 1."""
    place: Callable[[int], str]
    """Location of an event of this piece in the file, for messages."""

    def __len__(self) -> int:
        return len(self.t_us)


@dataclass(frozen=True)
class Source:
    """A recording that can be read once, sequentially, in pieces."""

    path: Path
    format: str
    """The recognised format, as text for the user."""
    sensor_size: tuple[int, int] | None
    """Columns and rows, if the file gives them."""
    pieces: Iterator[Piece]
    dropped: Counter[str] = field(default_factory=Counter)
    """Number of events that are incomplete in the file, by reason; counted while reading."""
    notes: tuple[str, ...] = ()
    """Inferred properties of columns and times, as text for the user."""
    guessed_unit: TimeUnit | None = None
    """Unit of the times, if it was only guessed from their values."""
    columns: str = ""
    """Order of unnamed columns, one letter each."""


def fits(t: Num[np.ndarray, "events"], unit: TimeUnit) -> Bool[np.ndarray, "events"]:
    """Whether times are finite and fit 64-bit microseconds."""
    return np.abs(t.astype(np.float64)) * 10.0 ** DECIMALS[unit] <= _LATEST_US


def microseconds(t: Num[np.ndarray, "events"], unit: TimeUnit) -> Int64[np.ndarray, "events"]:
    """Convert times to microseconds, rounded to the nearest; exact for integers."""
    decimals = DECIMALS[unit]
    if t.dtype.kind == "f":
        return np.rint(t.astype(np.float64) * 10.0**decimals).astype(np.int64)
    t = t.astype(np.int64, copy=False)
    if decimals == 0:
        return t
    return t * 10**decimals if decimals > 0 else (t + 500) // 1000


def numbered(first: int, word: str = "event") -> Callable[[int], str]:
    """A :attr:`Piece.place` that numbers events from ``first``."""
    return lambda k: f"{word} {first + k:,}"
