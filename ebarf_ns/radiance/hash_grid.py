"""Multi-resolution hash encoding (Müller et al. 2022, Instant Neural Graphics Primitives) with position gradients.

One set of formulas, two carriers: a plain torch implementation that runs anywhere and serves as reference, and numba
kernels for CPU that make no temporaries per corner and need no atomics, because each thread owns whole levels.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int64
from numba import njit, prange
from torch import Tensor, nn

_PRIMES = (1, 2654435761, 805459861)


@dataclass(frozen=True)
class HashGridShape:
    """Levels of geometrically growing resolution; a level that fits ``table_size`` is stored densely, else hashed."""

    levels: int = 8
    features: int = 4
    coarsest: int = 8
    finest: int = 192
    table_size_log2: int = 15

    @property
    def resolutions(self) -> list[int]:
        """Cells per side of each level."""
        growth = (self.finest / self.coarsest) ** (1 / max(self.levels - 1, 1))
        return [round(self.coarsest * growth**level) for level in range(self.levels)]

    @property
    def rows(self) -> list[int]:
        """Table rows of each level."""
        return [min((resolution + 1) ** 3, 1 << self.table_size_log2) for resolution in self.resolutions]


class HashGrid(nn.Module):
    """Features of points in the unit cube, trilinear between the vertices of every level."""

    def __init__(self, shape: HashGridShape):
        super().__init__()
        self.shape = shape
        self.table = nn.Parameter(torch.empty(sum(shape.rows), shape.features))
        self.register_buffer("resolution", torch.tensor(shape.resolutions), persistent=False)
        self.register_buffer("first_row", torch.tensor([0, *np.cumsum(shape.rows)]), persistent=False)
        self.resolution: Int64[Tensor, "levels"]
        self.first_row: Int64[Tensor, "levels+1"]
        self.reset()

    def reset(self) -> None:
        """Draw the table anew, uniform in ±1e-4."""
        nn.init.uniform_(self.table, -1e-4, 1e-4)

    @property
    def width(self) -> int:
        """Number of features over all levels."""
        return self.shape.levels * self.shape.features

    def forward(self, point: Float[Tensor, "points 3"]) -> Float[Tensor, "points width"]:
        """Features of points in [0, 1]³ (points outside are moved to the nearest face)."""
        if point.device.type == "cpu" and point.dtype == torch.float32:
            encoded: Tensor = _NumbaEncoding.apply(point, self.table, self.resolution, self.first_row)  # pyright: ignore[reportAssignmentType]
            return encoded
        return encode_reference(point, self.table, self.resolution, self.first_row)


def encode_reference(
    point: Float[Tensor, "points 3"],
    table: Float[Tensor, "rows features"],
    resolution: Int64[Tensor, "levels"],
    first_row: Int64[Tensor, "levels+1"],
) -> Float[Tensor, "points width"]:
    """The encoding in plain torch, differentiable in table and points, any device and precision."""
    levels = []
    for cells, start, end in zip(resolution.tolist(), first_row[:-1].tolist(), first_row[1:].tolist(), strict=True):
        scaled = point.clamp(0, 1) * cells
        cell = scaled.detach().floor().clamp(0, cells - 1)
        fraction, cell = scaled - cell, cell.long()
        total = torch.zeros(len(point), table.shape[1], dtype=point.dtype, device=point.device)
        for corner in range(8):
            offset = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2], device=point.device)
            weight = torch.where(offset > 0, fraction, 1 - fraction).prod(dim=-1, keepdim=True)
            total = total + weight * table[start + _row(cell + offset, cells, end - start)].to(point.dtype)
        levels.append(total)
    return torch.cat(levels, dim=-1)


def _row(vertex: Int64[Tensor, "points 3"], cells: int, rows: int) -> Int64[Tensor, "points"]:
    x, y, z = vertex.unbind(-1)
    if (cells + 1) ** 3 <= rows:
        return x + (cells + 1) * (y + (cells + 1) * z)
    return (x * _PRIMES[0] ^ y * _PRIMES[1] ^ z * _PRIMES[2]) % rows


class _NumbaEncoding(torch.autograd.Function):
    @staticmethod
    def forward(ctx, point: Tensor, table: Tensor, resolution: Tensor, first_row: Tensor) -> Tensor:
        ctx.save_for_backward(point, table, resolution, first_row)
        encoded = torch.empty(len(point), len(resolution) * table.shape[1])
        arguments = (point.detach().contiguous(), table.detach(), resolution, first_row, encoded)
        _kernels(table.shape[1])[0](*(tensor.numpy() for tensor in arguments))
        return encoded

    @staticmethod
    def backward(ctx, *gradients: Tensor) -> tuple[Tensor | None, Tensor, None, None]:
        point, table, resolution, first_row = ctx.saved_tensors
        table_gradient = torch.zeros_like(table)
        # Each level adds to a plane of its own, so that levels can run in parallel.
        point_gradient = torch.zeros(len(resolution), len(point) if ctx.needs_input_grad[0] else 0, 3)
        arguments = (point.detach().contiguous(), table.detach(), resolution, first_row, gradients[0].contiguous())
        outputs = (table_gradient, point_gradient)
        _kernels(table.shape[1])[1](*(tensor.numpy() for tensor in arguments + outputs))
        return point_gradient.sum(0) if ctx.needs_input_grad[0] else None, table_gradient, None, None


_BLOCK = 2048  # points whose features stay in cache while all levels are visited


@njit(cache=True, inline="always")
def _cell(coordinate, cells):
    """Cell number along one axis and the place in it, points outside moved to the face."""
    scaled = min(max(coordinate, np.float32(0)), np.float32(1)) * np.float32(cells)
    cell = min(np.int32(scaled), cells - 1)
    return cell, scaled - np.float32(cell)


@njit(cache=True, inline="always")
def _corner_terms(ix, iy, iz, cells, dense):
    """Per axis, what the lower and the upper vertex contribute to the row: summed when dense, else combined by xor."""
    if dense:
        n = cells + 1
        return (
            np.uint32(ix), np.uint32(ix + 1), np.uint32(n * iy), np.uint32(n * (iy + 1)),
            np.uint32(n * n * iz), np.uint32(n * n * (iz + 1)),
        )  # fmt: skip
    p1, p2 = np.uint32(2654435761), np.uint32(805459861)
    return (
        np.uint32(ix), np.uint32(ix + 1), np.uint32(iy) * p1, np.uint32(iy + 1) * p1,
        np.uint32(iz) * p2, np.uint32(iz + 1) * p2,
    )  # fmt: skip


@lru_cache
def _kernels(features: int) -> tuple[Callable[..., None], Callable[..., None]]:
    """Forward and backward kernels for a number of features a level, which the compiler unrolls."""

    @njit(cache=True, parallel=True, fastmath=True, nogil=True)
    def encode(point, table, resolution, first_row, encoded):
        for block in prange((len(point) + _BLOCK - 1) // _BLOCK):
            for level in range(len(resolution)):
                cells = resolution[level]
                start, rows = first_row[level], first_row[level + 1] - first_row[level]
                dense = (cells + 1) ** 3 <= rows
                mask = np.uint32(rows - 1)
                for i in range(block * _BLOCK, min(len(point), (block + 1) * _BLOCK)):
                    ix, fx = _cell(point[i, 0], cells)
                    iy, fy = _cell(point[i, 1], cells)
                    iz, fz = _cell(point[i, 2], cells)
                    x0, x1, y0, y1, z0, z1 = _corner_terms(ix, iy, iz, cells, dense)
                    for f in range(features):
                        encoded[i, level * features + f] = 0
                    for corner in range(8):
                        cx, wx = (x1, fx) if corner & 1 else (x0, 1 - fx)
                        cy, wy = (y1, fy) if corner & 2 else (y0, 1 - fy)
                        cz, wz = (z1, fz) if corner & 4 else (z0, 1 - fz)
                        row = start + np.int64((cx + cy + cz) if dense else ((cx ^ cy ^ cz) & mask))
                        weight = wx * wy * wz
                        for f in range(features):
                            encoded[i, level * features + f] += weight * table[row, f]

    @njit(cache=True, parallel=True, fastmath=True, nogil=True)
    def encode_backward(point, table, resolution, first_row, gradient, table_gradient, point_gradient):
        with_points = point_gradient.shape[1] > 0
        levels = len(resolution)
        for k in prange(levels):
            # Threads take runs of k: alternate ends, so that each gets cheap coarse and costly fine levels.
            level = k // 2 if k % 2 == 0 else levels - 1 - k // 2
            cells = resolution[level]
            start, rows = first_row[level], first_row[level + 1] - first_row[level]
            dense = (cells + 1) ** 3 <= rows
            mask = np.uint32(rows - 1)
            for i in range(len(point)):
                ix, fx = _cell(point[i, 0], cells)
                iy, fy = _cell(point[i, 1], cells)
                iz, fz = _cell(point[i, 2], cells)
                x0, x1, y0, y1, z0, z1 = _corner_terms(ix, iy, iz, cells, dense)
                gx, gy, gz = np.float32(0), np.float32(0), np.float32(0)
                for corner in range(8):
                    cx, wx, sx = (x1, fx, np.float32(1)) if corner & 1 else (x0, 1 - fx, np.float32(-1))
                    cy, wy, sy = (y1, fy, np.float32(1)) if corner & 2 else (y0, 1 - fy, np.float32(-1))
                    cz, wz, sz = (z1, fz, np.float32(1)) if corner & 4 else (z0, 1 - fz, np.float32(-1))
                    row = start + np.int64((cx + cy + cz) if dense else ((cx ^ cy ^ cz) & mask))
                    weight = wx * wy * wz
                    along = np.float32(0)
                    for f in range(features):
                        g = gradient[i, level * features + f]
                        table_gradient[row, f] += weight * g
                        along += g * table[row, f]
                    gx += along * sx * wy * wz
                    gy += along * sy * wx * wz
                    gz += along * sz * wx * wy
                if with_points:
                    inside_x = point[i, 0] >= 0 and point[i, 0] <= 1
                    inside_y = point[i, 1] >= 0 and point[i, 1] <= 1
                    inside_z = point[i, 2] >= 0 and point[i, 2] <= 1
                    point_gradient[level, i, 0] = gx * cells if inside_x else np.float32(0)
                    point_gradient[level, i, 1] = gy * cells if inside_y else np.float32(0)
                    point_gradient[level, i, 2] = gz * cells if inside_z else np.float32(0)

    return encode, encode_backward
