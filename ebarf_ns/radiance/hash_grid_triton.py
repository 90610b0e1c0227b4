"""The hash encoding on a GPU: one program per block of points, which loops over levels with its sums in registers.

Triton comes with torch and compiles at first use, its launcher with the system's C compiler; nothing has to be built
beforehand. With ``TRITON_INTERPRET=1`` set before the import, the same kernels run slowly on a CPU, for tests without a
GPU.
"""

# Triton's language is not Python to a type checker.
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false

# No postponed annotations: Triton 3.0's interpreter needs tl.constexpr itself, not a string.
from typing import TYPE_CHECKING

import torch
import triton
import triton.language as tl
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

    from ebarf_ns.radiance.lattice import Lattice

_BLOCK = 128  # points per program


def encode(
    point: "Float[Tensor, 'points 3']", table: "Float[Tensor, 'rows features']", lattice: "Lattice"
) -> "Float[Tensor, 'points width']":
    """Features of float32 points on a GPU, differentiable in points and table."""
    levels = (lattice.stretch, lattice.resolution, lattice.first_row)
    encoded: Tensor = _Encoding.apply(point, table, *levels)  # pyright: ignore[reportAssignmentType]
    return encoded


class _Encoding(torch.autograd.Function):
    @staticmethod
    def forward(ctx, point: Tensor, table: Tensor, *levels: Tensor) -> Tensor:
        point = point.contiguous()
        ctx.save_for_backward(point, table, *levels)
        count, features = len(point), table.shape[1]
        encoded = torch.empty(count, len(levels[0]) * features, device=point.device)
        if count:
            grid = (triton.cdiv(count, _BLOCK),)
            with torch.cuda.device_of(point):
                _forward[grid](point, table, *levels, encoded, count, len(levels[0]), features, _BLOCK)
        return encoded

    @staticmethod
    def backward(ctx, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        point, table, *levels = ctx.saved_tensors
        count, features = len(point), table.shape[1]
        # Programs accumulate into the table atomically, so that only this array must start at zero.
        table_gradient, point_gradient = torch.zeros_like(table), torch.empty_like(point)
        if count:
            grid = (triton.cdiv(count, _BLOCK),)
            outputs = (gradients[0].contiguous(), table_gradient, point_gradient)
            with torch.cuda.device_of(point):
                _backward[grid](point, table, *levels, *outputs, count, len(levels[0]), features, _BLOCK)
        return point_gradient if ctx.needs_input_grad[0] else None, table_gradient, *(None for _ in levels)


@triton.jit
def _cell(coordinate, stretch, vertices):
    """As in the numba kernels: NaN gets the last cell and a NaN fraction."""
    inside = tl.where(coordinate < 0, 0.0, tl.where(coordinate > 1, 1.0, coordinate))
    place = inside * stretch + 0.5
    known = place < (vertices - 1).to(tl.float32)
    cell = tl.where(known, tl.where(known, place, 0.0).to(tl.int32), (vertices - 2).to(tl.int32))
    return cell, place - cell.to(tl.float32)


@triton.jit
def _row(ix, iy, iz, vertices, rows):
    """Row of a vertex within its level: dense if all vertices fit, else hashed, in wrapping 32-bit arithmetic."""
    n = vertices.to(tl.int32)
    dense = ix + n * (iy + n * iz)
    # 2654435761 as a signed 32-bit integer.
    hashed = (ix ^ (iy * -1640531535) ^ (iz * 805459861)) & (rows - 1).to(tl.int32)
    return tl.where(vertices * vertices * vertices <= rows, dense, hashed).to(tl.int64)


@triton.jit
def _forward(
    point, table, stretch, resolution, first_row, encoded,
    count, levels: tl.constexpr, features: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    here = i < count
    x = tl.load(point + 3 * i, here, 0.0)
    y = tl.load(point + 3 * i + 1, here, 0.0)
    z = tl.load(point + 3 * i + 2, here, 0.0)
    for level in range(levels):
        scale, vertices = tl.load(stretch + level), tl.load(resolution + level)
        start = tl.load(first_row + level)
        rows = tl.load(first_row + level + 1) - start
        ix, fx = _cell(x, scale, vertices)
        iy, fy = _cell(y, scale, vertices)
        iz, fz = _cell(z, scale, vertices)
        for f in tl.static_range(features):
            total = tl.zeros((block,), tl.float32)
            for corner in tl.static_range(8):
                ox, oy, oz = corner & 1, (corner >> 1) & 1, corner >> 2
                share = (fx if ox else 1 - fx) * (fy if oy else 1 - fy) * (fz if oz else 1 - fz)
                row = start + _row(ix + ox, iy + oy, iz + oz, vertices, rows)
                total += share * tl.load(table + row * features + f, here, 0.0)
            tl.store(encoded + i * (levels * features) + level * features + f, total, here)


@triton.jit
def _backward(
    point, table, stretch, resolution, first_row, gradient, table_gradient, point_gradient,
    count, levels: tl.constexpr, features: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    here = i < count
    x = tl.load(point + 3 * i, here, 0.0)
    y = tl.load(point + 3 * i + 1, here, 0.0)
    z = tl.load(point + 3 * i + 2, here, 0.0)
    gx = tl.zeros((block,), tl.float32)
    gy = tl.zeros((block,), tl.float32)
    gz = tl.zeros((block,), tl.float32)
    for level in range(levels):
        scale, vertices = tl.load(stretch + level), tl.load(resolution + level)
        start = tl.load(first_row + level)
        rows = tl.load(first_row + level + 1) - start
        ix, fx = _cell(x, scale, vertices)
        iy, fy = _cell(y, scale, vertices)
        iz, fz = _cell(z, scale, vertices)
        for corner in tl.static_range(8):
            ox, oy, oz = corner & 1, (corner >> 1) & 1, corner >> 2
            wx, wy, wz = fx if ox else 1 - fx, fy if oy else 1 - fy, fz if oz else 1 - fz
            row = start + _row(ix + ox, iy + oy, iz + oz, vertices, rows)
            along = tl.zeros((block,), tl.float32)
            for f in tl.static_range(features):
                g = tl.load(gradient + i * (levels * features) + level * features + f, here, 0.0)
                along += g * tl.load(table + row * features + f, here, 0.0)
                tl.atomic_add(table_gradient + row * features + f, wx * wy * wz * g, here, sem="relaxed")
            gx += scale * along * wy * wz * (1.0 if ox else -1.0)
            gy += scale * along * wx * wz * (1.0 if oy else -1.0)
            gz += scale * along * wx * wy * (1.0 if oz else -1.0)
    # Clamped coordinates have no gradient.
    tl.store(point_gradient + 3 * i, tl.where((x >= 0) & (x <= 1), gx, 0.0), here)
    tl.store(point_gradient + 3 * i + 1, tl.where((y >= 0) & (y <= 1), gy, 0.0), here)
    tl.store(point_gradient + 3 * i + 2, tl.where((z >= 0) & (z <= 1), gz, 0.0), here)
