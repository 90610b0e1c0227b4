"""The hash encoding on a CPU: no temporaries per corner, and no atomics since each thread owns whole levels."""

from __future__ import annotations

import sys
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from numba import prange
from torch import Tensor

from ebarf_ns.compiled import njit

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float

    from ebarf_ns.radiance.lattice import Lattice

# All fastmath flags except those that assume no infinities and no NaN.
_FAST = {"nsz", "arcp", "contract", "afn", "reassoc"}
_BLOCK = 128
# Values of a level that fit into a core's private cache; larger levels are prefetched.
_CACHED = 1 << 17
_gradients: dict[tuple[int, ...], np.ndarray] = {}


def _recycled(shape: tuple[int, ...]) -> Tensor:
    """Memory for a table's gradient, reused from the previous step if nothing refers to it any more.

    Fresh memory costs more than the computation; numpy also requests huge pages.
    """
    array = _gradients.get(shape)
    # Three references are the pool, the local name and the call argument; every tensor on the array adds one.
    if array is None or sys.getrefcount(array) > 3:
        array = _gradients[shape] = np.empty(shape, np.float32)
    return torch.from_numpy(array)


def encode(
    point: Float[Tensor, "points 3"], table: Float[Tensor, "rows features"], lattice: Lattice
) -> Float[Tensor, "points width"]:
    """Features of float32 points on a CPU, differentiable in points and table."""
    levels = (lattice.stretch, lattice.resolution, lattice.first_row)
    encoded: Tensor = _Encoding.apply(point, table, *levels)  # pyright: ignore[reportAssignmentType]
    return encoded


class _Encoding(torch.autograd.Function):
    @staticmethod
    def forward(ctx, point: Tensor, table: Tensor, *levels: Tensor) -> Tensor:
        point = point.contiguous()
        ctx.save_for_backward(point, table, *levels)
        encoded = torch.empty(len(point), len(levels[0]) * table.shape[1])
        forward, _ = _kernels(table.shape[1])
        forward(*(tensor.detach().numpy() for tensor in (point, table, *levels, encoded)))
        return encoded

    @staticmethod
    def backward(ctx, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        point, table, *levels = ctx.saved_tensors
        table_gradient = _recycled(tuple(table.shape))
        # Each level writes its own plane, so that levels can run in parallel.
        point_gradient = torch.empty(len(levels[0]), len(point) if ctx.needs_input_grad[0] else 0, 3)
        _, backward = _kernels(table.shape[1])
        tensors = (point, table, *levels, gradients[0].contiguous(), table_gradient, point_gradient)
        backward(*(tensor.detach().numpy() for tensor in tensors))
        along = point_gradient.sum(0) if ctx.needs_input_grad[0] else None
        return along, table_gradient, *(None for _ in levels)


@njit(cache=True, inline="always")
def _cell(coordinate, stretch, vertices):
    """Cell index along one axis and the fraction within the cell; points outside are clamped.

    NaN gets the last cell and a NaN fraction, so that it propagates to the features.
    """
    inside = np.float32(0) if coordinate < 0 else np.float32(1) if coordinate > 1 else coordinate
    place = inside * stretch + np.float32(0.5)
    cell = np.uint32(place) if place < np.float32(vertices - 1) else np.uint32(vertices - 2)
    return cell, place - np.float32(cell)


@njit(cache=True, inline="always")
def _corner_rows(ix, iy, iz, vertices, rows):
    """Rows of a cell's eight vertices within the level, x fastest: dense if the whole level fits, else hashed."""
    if vertices * vertices * vertices <= rows:
        n, nn = np.uint32(vertices), np.uint32(vertices * vertices)
        r = ix + n * iy + nn * iz
        one = np.uint32(1)
        return r, r + one, r + n, r + n + one, r + nn, r + nn + one, r + nn + n, r + nn + n + one
    p1, p2, mask = np.uint32(2654435761), np.uint32(805459861), np.uint32(rows - 1)
    x0, x1 = ix, ix + np.uint32(1)
    y0, y1 = iy * p1, (iy + np.uint32(1)) * p1
    z0, z1 = iz * p2, (iz + np.uint32(1)) * p2
    return (
        (x0 ^ y0 ^ z0) & mask, (x1 ^ y0 ^ z0) & mask, (x0 ^ y1 ^ z0) & mask, (x1 ^ y1 ^ z0) & mask,
        (x0 ^ y0 ^ z1) & mask, (x1 ^ y0 ^ z1) & mask, (x0 ^ y1 ^ z1) & mask, (x1 ^ y1 ^ z1) & mask,
    )  # fmt: skip


@njit(cache=True, inline="always")
def _level(k, levels):
    """Threads get contiguous k: alternating ends give each thread both cheap coarse and expensive fine levels."""
    return k // 2 if k % 2 == 0 else levels - 1 - k // 2


@njit(cache=True, fastmath=_FAST, nogil=True, error_model="numpy")
def _touch(point, array, begin, end, scale, vertices, rows):
    """Prefetch all rows that a block of points will need.

    Independent loads overlap their memory latency; loads between arithmetic wait one by one.
    """
    total = np.float32(0)
    for i in range(begin, end):
        ix, _ = _cell(point[i, 0], scale, vertices)
        iy, _ = _cell(point[i, 1], scale, vertices)
        iz, _ = _cell(point[i, 2], scale, vertices)
        r0, r1, r2, r3, r4, r5, r6, r7 = _corner_rows(ix, iy, iz, vertices, rows)
        total += array[r0, 0] + array[r1, 0] + array[r2, 0] + array[r3, 0]
        total += array[r4, 0] + array[r5, 0] + array[r6, 0] + array[r7, 0]
    return total


@lru_cache
def _kernels(features: int) -> tuple[Callable[..., None], Callable[..., None]]:
    """Forward and backward kernels for a number of features per level, which the compiler unrolls.

    The eight corners are unrolled by hand to keep the sums in registers; a loop would go through memory.
    """

    @njit(cache=True, parallel=True, fastmath=_FAST, nogil=True, error_model="numpy")
    def forward(point, table, stretch, resolution, first_row, encoded):
        levels, blocks = len(resolution), (len(point) + _BLOCK - 1) // _BLOCK
        touched = np.empty(levels * blocks, np.float32)
        for task in prange(levels * blocks):
            # Process all blocks of a level in succession, so that its rows stay in cache.
            level, block = _level(task // blocks, levels), task % blocks
            begin, end = block * _BLOCK, min(len(point), (block + 1) * _BLOCK)
            vertices, scale = resolution[level], stretch[level]
            start, rows = first_row[level], first_row[level + 1] - first_row[level]
            first = level * features
            values = table[start : start + rows]
            if rows * features > _CACHED:
                touched[task] = _touch(point, values, begin, end, scale, vertices, rows)
            for i in range(begin, end):
                ix, fx = _cell(point[i, 0], scale, vertices)
                iy, fy = _cell(point[i, 1], scale, vertices)
                iz, fz = _cell(point[i, 2], scale, vertices)
                r0, r1, r2, r3, r4, r5, r6, r7 = _corner_rows(ix, iy, iz, vertices, rows)
                gx, gy, gz = 1 - fx, 1 - fy, 1 - fz
                w00, w10, w01, w11 = gx * gy, fx * gy, gx * fy, fx * fy
                for f in range(features):
                    encoded[i, first + f] = gz * (
                        w00 * values[r0, f] + w10 * values[r1, f] + w01 * values[r2, f] + w11 * values[r3, f]
                    ) + fz * (w00 * values[r4, f] + w10 * values[r5, f] + w01 * values[r6, f] + w11 * values[r7, f])

    @njit(cache=True, parallel=True, fastmath=_FAST, nogil=True, error_model="numpy")
    def backward(point, table, stretch, resolution, first_row, gradient, table_gradient, point_gradient):
        with_points = point_gradient.shape[1] > 0
        levels = len(resolution)
        touched = np.zeros(levels, np.float32)
        for k in prange(levels):
            level = _level(k, levels)
            vertices, scale = resolution[level], stretch[level]
            start, rows = first_row[level], first_row[level + 1] - first_row[level]
            first = level * features
            values, sums = table[start : start + rows], table_gradient[start : start + rows]
            sums[:] = 0
            for begin in range(0, len(point), _BLOCK):
                end = min(len(point), begin + _BLOCK)
                if rows * features > _CACHED:
                    touched[k] += _touch(point, values, begin, end, scale, vertices, rows)
                    touched[k] += _touch(point, sums, begin, end, scale, vertices, rows)
                for i in range(begin, end):
                    ix, fx = _cell(point[i, 0], scale, vertices)
                    iy, fy = _cell(point[i, 1], scale, vertices)
                    iz, fz = _cell(point[i, 2], scale, vertices)
                    r0, r1, r2, r3, r4, r5, r6, r7 = _corner_rows(ix, iy, iz, vertices, rows)
                    gx, gy, gz = 1 - fx, 1 - fy, 1 - fz
                    w00, w10, w01, w11 = gx * gy, fx * gy, gx * fy, fx * fy
                    a0 = a1 = a2 = a3 = a4 = a5 = a6 = a7 = np.float32(0)
                    for f in range(features):
                        g = gradient[i, first + f]
                        a0 += g * values[r0, f]
                        a1 += g * values[r1, f]
                        a2 += g * values[r2, f]
                        a3 += g * values[r3, f]
                        a4 += g * values[r4, f]
                        a5 += g * values[r5, f]
                        a6 += g * values[r6, f]
                        a7 += g * values[r7, f]
                        lower, upper = gz * g, fz * g
                        sums[r0, f] += w00 * lower
                        sums[r1, f] += w10 * lower
                        sums[r2, f] += w01 * lower
                        sums[r3, f] += w11 * lower
                        sums[r4, f] += w00 * upper
                        sums[r5, f] += w10 * upper
                        sums[r6, f] += w01 * upper
                        sums[r7, f] += w11 * upper
                    if with_points:
                        b0, b1, b2, b3 = gz * a0 + fz * a4, gz * a1 + fz * a5, gz * a2 + fz * a6, gz * a3 + fz * a7
                        along_x = scale * (gy * (b1 - b0) + fy * (b3 - b2))
                        along_y = scale * (gx * (b2 - b0) + fx * (b3 - b1))
                        along_z = scale * (w00 * (a4 - a0) + w10 * (a5 - a1) + w01 * (a6 - a2) + w11 * (a7 - a3))
                        # Clamped coordinates have no gradient.
                        point_gradient[level, i, 0] = along_x if 0 <= point[i, 0] <= 1 else np.float32(0)
                        point_gradient[level, i, 1] = along_y if 0 <= point[i, 1] <= 1 else np.float32(0)
                        point_gradient[level, i, 2] = along_z if 0 <= point[i, 2] <= 1 else np.float32(0)

    return forward, backward
