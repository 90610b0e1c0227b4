"""Multi-resolution hash encoding (Müller et al. 2022, Instant Neural Graphics Primitives) with position gradients.

One lattice and one table with four backends: numba kernels on a CPU, Triton kernels on a GPU, tiny-cuda-nn if it is
importable, and plain torch, which runs anywhere and is the reference in tests. The lattice and the table layout are
those of tiny-cuda-nn, so that a trained table works with every backend.
"""

from __future__ import annotations

import sys
from functools import lru_cache
from importlib import import_module
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from torch import Tensor, nn

from ebarf_ns.radiance.lattice import PRIMES, HashGridShape, Lattice

if TYPE_CHECKING:
    from jaxtyping import Float

Backend = Literal["numba", "triton", "tcnn", "torch"]


class HashGrid(nn.Module):
    """Features of points in the unit cube, interpolated trilinearly on every level."""

    def __init__(self, shape: HashGridShape, backend: Backend | None = None):
        super().__init__()
        self.shape = shape
        self.backend: Backend | None = backend
        self.level_shares: Tensor | None = None
        """Weights of the levels' features; None: all 1."""
        self.lattice = Lattice(shape)
        # Allocated by numpy, which requests huge pages.
        self.table = nn.Parameter(torch.from_numpy(np.empty((sum(shape.rows), shape.features), np.float32)))
        nn.init.uniform_(self.table, -1e-4, 1e-4)

    def forward(self, point: Float[Tensor, "points 3"]) -> Float[Tensor, "points width"]:
        """Features of points in [0, 1]³ (points outside are clamped to it)."""
        features = self._encode(point)
        if self.level_shares is None:
            return features
        return features * self.level_shares.repeat_interleave(self.shape.features)

    def _encode(self, point: Float[Tensor, "points 3"]) -> Float[Tensor, "points width"]:
        backend = self.backend or fastest_backend(point)
        if backend == "numba":
            from ebarf_ns.radiance.hash_grid_numba import encode
        elif backend == "triton":
            from ebarf_ns.radiance.hash_grid_triton import encode
        elif backend == "tcnn":
            return self._encode_tcnn(point)
        else:
            encode = encode_reference
        return encode(point, self.table, self.lattice)

    def _encode_tcnn(self, point: Float[Tensor, "points 3"]) -> Float[Tensor, "points width"]:
        """Encode with tiny-cuda-nn, using our table as its parameters."""
        encoding = _tcnn_encoding(self.shape)
        inside = point.clamp(0, 1) * self.shape.reach
        return torch.func.functional_call(encoding, {"params": self.table.flatten()}, (inside,))


def fastest_backend(point: Float[Tensor, "points 3"]) -> Backend:
    """The fastest backend for a device and precision among those importable."""
    if point.dtype == torch.float32 and point.device.type == "cpu":
        return "numba"
    if point.dtype == torch.float32 and point.is_cuda:
        if not why_not("tinycudann"):
            return "tcnn"
        if not why_not("triton"):
            return "triton"
        _warn_slow()
    return "torch"


@lru_cache
def why_not(name: str) -> str:
    """Why a library is not used, empty if it is: tiny-cuda-nn raises its own errors on GPUs it was not built for, and
    Triton compiles its driver at first use."""
    try:
        module = import_module(name)
        if name == "triton":
            module.runtime.driver.active.get_current_device()
    except Exception as error:
        return " ".join(str(error).split()) or type(error).__name__
    return ""


@lru_cache
def _warn_slow() -> None:
    """Warn once about the slow backend."""
    sys.stderr.write(
        "the hash grid runs in plain torch on this GPU, about 200 times slower, without Triton "
        f"({why_not('triton'):.120}) and tiny-cuda-nn ({why_not('tinycudann'):.120})\n"
    )


_encodings: dict[HashGridShape, nn.Module] = {}


def _tcnn_encoding(shape: HashGridShape) -> nn.Module:
    """Cached by shape, since the encoding's own parameters are never used."""
    if shape not in _encodings:
        import tinycudann  # pyright: ignore[reportMissingImports]

        configuration = {
            "otype": "HashGrid",
            "n_levels": shape.levels,
            "n_features_per_level": shape.features,
            "log2_hashmap_size": shape.table_size_log2,
            "base_resolution": shape.coarsest,
            "per_level_scale": shape.growth,
        }
        _encodings[shape] = tinycudann.Encoding(3, configuration, dtype=torch.float32)
    return _encodings[shape]


def encode_reference(
    point: Float[Tensor, "points 3"], table: Float[Tensor, "rows features"], lattice: Lattice
) -> Float[Tensor, "points width"]:
    """The encoding in plain torch, differentiable in table and points, for any device and precision."""
    levels = []
    first_row = lattice.first_row.tolist()
    for level, vertices in enumerate(lattice.resolution.tolist()):
        start, end = first_row[level], first_row[level + 1]
        place = point.clamp(0, 1) * lattice.stretch[level].to(point) + 0.5
        cell = place.detach().floor().clamp(max=vertices - 2)
        fraction, cell = place - cell, cell.long()
        total = torch.zeros(len(point), table.shape[1], dtype=point.dtype, device=point.device)
        for corner in range(8):
            offset = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2], device=point.device)
            weight = torch.where(offset > 0, fraction, 1 - fraction).prod(dim=-1, keepdim=True)
            total = total + weight * table[start + _row(cell + offset, vertices, end - start)].to(point.dtype)
        levels.append(total)
    return torch.cat(levels, dim=-1)


def _row(vertex: Tensor, vertices: int, rows: int) -> Tensor:
    x, y, z = vertex.unbind(-1)
    if vertices**3 <= rows:
        return x + vertices * (y + vertices * z)
    return (x * PRIMES[0] ^ y * PRIMES[1] ^ z * PRIMES[2]) % rows
