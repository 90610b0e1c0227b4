"""Importance sampling on a CPU in one pass: each ray marches through the cached density and places its samples."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from numba import prange

from ebarf_ns.compiled import njit
from ebarf_ns.radiance.hash_grid_numba import _FAST

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float
    from torch import Tensor

    from ebarf_ns.radiance.ray_sampling import DensityGrid, Rays


def importance_edges(
    grid: DensityGrid,
    rays: Rays,
    near: float,
    far: Float[Tensor, "rays"],
    coarse: int,
    uniform_share: float,
    most_hidden: float,
    samples: int,
    jitter: Float[Tensor, "rays 1"],
    pairs: bool,
) -> Float[Tensor, "rays samples+1"]:
    """:func:`ebarf_ns.radiance.ray_sampling.importance_edges` for float32 on a CPU."""
    edges = torch.empty(len(far), samples + 1)
    sharing = 2 if pairs else 1
    columns = (rays.origin.contiguous(), rays.direction.contiguous(), far, jitter[:, 0], grid.density)
    origin, direction, ends, shift, density = (column.detach().numpy() for column in columns)
    settings = np.float32(near), grid.half_side, grid.cells, np.float32(uniform_share), np.float32(1 - most_hidden)
    scratch = np.empty((len(far) // sharing, coarse + 1), np.float32)
    place: Callable[..., None] = _place
    place(origin, direction, ends, shift, density, *settings, scratch, edges.numpy())
    return edges


@njit(cache=True, inline="always")
def _along(coordinate, half_side, cells):
    """Cell index along one axis; NaN goes to the first cell, like coordinates below it."""
    place = (coordinate + np.float32(half_side)) * np.float32(cells / (2 * half_side))
    if place > 0:
        return np.int64(place) if place < cells else np.int64(cells - 1)
    return np.int64(0)


@njit(cache=True, inline="always")
def _cell(x, y, z, half_side, cells):
    """Index of the cell that contains a point; space is contracted if the grid reaches beyond 1."""
    if half_side > 1:
        size = max(abs(x), abs(y), abs(z))
        if size > 1:
            squeeze = (2 - 1 / size) / size
            x, y, z = x * squeeze, y * squeeze, z * squeeze
    ix, iy, iz = _along(x, half_side, cells), _along(y, half_side, cells), _along(z, half_side, cells)
    return ix + cells * (iy + cells * iz)


@njit(cache=True, parallel=True, fastmath=_FAST, nogil=True, error_model="numpy")
def _place(
    origin, direction, far, jitter, density, near, half_side, cells, uniform_share, least_passed, cumulative, edges
):
    groups, coarse = len(cumulative), cumulative.shape[1] - 1
    sharing, samples = len(far) // max(groups, 1), edges.shape[1] - 1
    for group in prange(groups):
        end = max(far[group], 2 * near)
        step = (end - near) / coarse
        ratio = (end / near) ** (np.float32(1) / coarse)
        weights = cumulative[group]
        weights[:] = 0
        for k in range(sharing):
            ray = group + k * groups
            lower, transmitted = near, np.float32(1)
            for i in range(coarse):
                upper = near + (i + 1) * step if half_side == 1 else lower * ratio
                middle = (lower + upper) / 2
                x = origin[ray, 0] + middle * direction[ray, 0]
                y = origin[ray, 1] + middle * direction[ray, 1]
                z = origin[ray, 2] + middle * direction[ray, 2]
                passed = np.exp(-density[_cell(x, y, z, half_side, cells)] * (upper - lower))
                passed = max(passed, least_passed)
                weights[i + 1] += transmitted * (1 - passed) / sharing
                transmitted *= passed
                lower = upper
        seen = np.float32(0)
        for i in range(coarse):
            seen += weights[i + 1]
        # Light from the background is spread evenly too.
        spread = (uniform_share + max(1 - seen, np.float32(0))) / coarse
        total = seen + spread * coarse
        for i in range(coarse):
            weights[i + 1] = weights[i] + (weights[i + 1] + spread) / total
        i, lower = 0, near
        upper = near + step if half_side == 1 else near * ratio
        first = edges[group]
        first[0], first[samples] = near, end
        for j in range(1, samples):
            wanted = (j + jitter[group]) / samples
            while i < coarse - 1 and weights[i + 1] <= wanted:
                i += 1
                lower = upper
                upper = near + (i + 1) * step if half_side == 1 else lower * ratio
            share = (wanted - weights[i]) / max(weights[i + 1] - weights[i], np.float32(1e-12))
            first[j] = lower + min(max(share, np.float32(0)), np.float32(1)) * (upper - lower)
        # Copy element by element: assigning a row adds a shape check whose message takes seconds to compile.
        for k in range(1, sharing):
            for j in range(samples + 1):
                edges[group + k * groups, j] = first[j]
