"""Benchmark settings; imports little, so that the command line starts fast."""

from dataclasses import dataclass
from typing import Literal, get_args

# Parts that fill the memory come last.
Part = Literal["hash_grid", "roofline", "step", "nerfacto", "frame", "simulator", "training", "scaling", "index"]
PARTS: tuple[Part, ...] = get_args(Part)


@dataclass(frozen=True)
class EngineBenchmark:
    """Settings of the engine benchmark."""

    parts: tuple[Part, ...] = PARTS
    quick: bool = False
    """Small sizes and few repetitions, to check that it runs, not how fast."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the trainings on the demo scene."""
    seconds: float = 100.0
    """Training time per seed."""


@dataclass(frozen=True)
class RecordingsBenchmark:
    """Settings of the recordings benchmark."""

    events: int = 20_000_000
    """Events in the HDF5 file; other formats get a tenth."""
    huge: int = 200_000_000
    """Events in the file used to measure memory; 0: skip."""
