"""Roofline model of the field on the current machine (Williams, Waterman and Patterson 2009).

The limits are measured in the same run: a large matrix product, a copy in memory, and a copy of the size of the hash
table, which mostly stays in cache. The least time of a part is that of its operations at the product's rate or of its
bytes at a copy's rate, whichever is longer.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from ebarf_ns.benchmarks.engine_step import device, median_seconds, renderer
from ebarf_ns.benchmarks.figures import Figure

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

_LEVELS, _SAMPLES = 8, 24
_BYTES = 4
_AT_MOST = 3.0


def roofline(rays: int, side: int, large: int, repetitions: int) -> Iterator[Figure]:
    """Measure the limits with matrices of ``side`` and copies of ``large`` numbers, then the field with ``rays`` rays.

    Passes are forward and backward, with gradients of the parameters and the points.
    """
    field = renderer(_SAMPLES, _LEVELS).field
    # Processors without bfloat16 emulate it, a hundred times slower.
    product = {
        name: _operations_per_s(side, getattr(torch, name), repetitions)
        for name in dict.fromkeys(("float32", field.precision))
    }
    in_memory, in_cache = (_copied_bytes_per_s(count, repetitions) for count in (large, field.grid.table.numel()))
    for name, rate in product.items():
        yield Figure(f"limit: matrix product in {name}", rate / 1e9, "GFLOP/s")
    yield Figure("limit: copy in memory", in_memory / 1e9, "GB/s")
    yield Figure("limit: copy of the size of the hash table", in_cache / 1e9, "GB/s")

    points, width = rays * _SAMPLES, field.grid.shape.width
    place = torch.rand(points, 3, device=device()).requires_grad_()
    # Eight corners of each level are read in the forward pass, and read and written in the backward pass.
    grid_least_s = points * 8 * 3 * width * _BYTES / in_cache
    weights = sum(layer.weight.numel() for layer in field.modules() if isinstance(layer, nn.Linear))
    # Features and outputs are read or written once, and so are their gradients.
    mlps_least_s = max(6 * points * weights / product[field.precision], points * 2 * (width + 2) * _BYTES / in_memory)
    grid_s = _both_ways_s(lambda: field.grid(place), (place, field.grid.table), repetitions)
    field_s = _both_ways_s(lambda: torch.stack(field(place, None)), (place, *field.parameters()), repetitions)
    for name, seconds, least_s, at_most in (
        ("hash grid", grid_s, grid_least_s, None),
        (f"MLPs in {field.precision}, activations", field_s - grid_s, mlps_least_s, None),
        ("field", field_s, grid_least_s + mlps_least_s, _AT_MOST),
    ):
        yield Figure(f"{name}, {points:,} points", 1e3 * seconds, "ms")
        yield Figure(f"{name}: its limit", 1e3 * least_s, "ms")
        yield Figure(f"{name}: measured over its limit", seconds / least_s, "times", at_most=at_most)


def _operations_per_s(side: int, dtype: torch.dtype, repetitions: int) -> float:
    left, right = (torch.rand(side, side, device=device()).to(dtype) for _ in range(2))
    return 2 * side**3 / median_seconds(lambda: left @ right, repetitions)


def _copied_bytes_per_s(numbers: int, repetitions: int) -> float:
    source = torch.rand(numbers, device=device())
    target = torch.empty_like(source)
    times = max(1, (1 << 22) // numbers)

    def copies() -> None:
        for _ in range(times):
            target.copy_(source)

    return 2 * numbers * _BYTES * times / median_seconds(copies, repetitions)


def _both_ways_s(once: Callable[[], Tensor], inputs: Sequence[Tensor], repetitions: int) -> float:
    weight = torch.rand_like(once().detach())
    return median_seconds(lambda: torch.autograd.grad(once(), inputs, weight), repetitions)
