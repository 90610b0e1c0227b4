"""The levels of a hash grid: resolutions, table rows, scales."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    pass

PRIMES = (1, 2654435761, 805459861)


@dataclass(frozen=True)
class HashGridShape:
    """Levels of geometrically growing resolution; a level that fits the table size is stored densely, else hashed."""

    levels: int = 8
    features: int = 4
    coarsest: int = 8
    finest: int = 192
    table_size_log2: int = 17

    @property
    def growth(self) -> float:
        """Ratio of successive resolutions, slightly reduced so that rounding cannot add a vertex."""
        return ((self.finest - 0.1) / self.coarsest) ** (1 / max(self.levels - 1, 1))

    @property
    def scales(self) -> list[float]:
        """Number of cells of each level between its first and last vertex."""
        return [self.coarsest * self.growth**level - 1 for level in range(self.levels)]

    @property
    def resolutions(self) -> list[int]:
        """Vertices per side of each level."""
        return [int(np.ceil(scale)) + 1 for scale in self.scales]

    @property
    def rows(self) -> list[int]:
        """Table rows of each level, a multiple of 8."""
        return [min(-(-(resolution**3) // 8) * 8, 1 << self.table_size_log2) for resolution in self.resolutions]

    @property
    def width(self) -> int:
        """Number of features over all levels."""
        return self.levels * self.features

    @property
    def reach(self) -> float:
        """Share of tiny-cuda-nn's cube in which every cell has both vertices: [0, 1] is mapped to [0, reach]."""
        return (self.coarsest - 1.5) / (self.coarsest - 1)


class Lattice(nn.Module):
    """Level parameters for the kernels, as tensors that move with the module."""

    def __init__(self, shape: HashGridShape):
        super().__init__()
        self.register_buffer("stretch", torch.tensor(shape.scales).float() * shape.reach, persistent=False)
        self.register_buffer("resolution", torch.tensor(shape.resolutions), persistent=False)
        self.register_buffer("first_row", torch.tensor([0, *np.cumsum(shape.rows)]), persistent=False)
        self.stretch: Tensor
        """Cells of each level across the unit cube, float32 (levels,)."""
        self.resolution: Tensor
        """Vertices per side, int64 (levels,)."""
        self.first_row: Tensor
        """First table row of each level, int64 (levels + 1,)."""
