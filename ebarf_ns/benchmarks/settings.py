"""What the benchmarks can be asked for; light, for the command line."""

from dataclasses import dataclass
from typing import Literal, get_args

# Those that fill the memory come last.
Part = Literal["hash_grid", "step", "nerfacto", "frame", "simulator", "training", "scaling", "index"]
PARTS: tuple[Part, ...] = get_args(Part)


@dataclass(frozen=True)
class EngineBenchmark:
    """What to measure and how thoroughly."""

    parts: tuple[Part, ...] = PARTS
    quick: bool = False
    """Small sizes and few repetitions: whether it runs, not how fast."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the trainings on the demo scene."""
    seconds: float = 100.0
    """Training time of each."""


@dataclass(frozen=True)
class RecordingsBenchmark:
    """How much to write and read."""

    events: int = 20_000_000
    """Of the HDF5 file; of the other formats, a tenth."""
    huge: int = 200_000_000
    """Events of the file by which memory is measured; 0: none."""
