"""Sample placement along rays and volume rendering (Max 1995; Mildenhall et al. 2020)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

from ebarf_ns.radiance.field import RadianceField, contract

if TYPE_CHECKING:
    from jaxtyping import Float, Int64

_SHARE_OF_SEEN = 0.5
_IN_ORDER = 16384
_LEAST_WEIGHT = 1e-9


class Rays(NamedTuple):
    """Rays in world coordinates with unit directions."""

    origin: Float[Tensor, "rays 3"]
    direction: Float[Tensor, "rays 3"]


class Rendered(NamedTuple):
    """Volume-rendered ray values."""

    intensity: Float[Tensor, "rays"]
    depth: Float[Tensor, "rays"]
    accumulation: Float[Tensor, "rays"]
    """Opacity: share of the light that comes from the scene, not the background."""
    weights: Float[Tensor, "rays samples"]
    """Compositing weight of each interval."""
    edges: Float[Tensor, "rays samples+1"]
    """Distances of the interval edges."""

    def depth_quantile(self, share: float) -> Float[Tensor, "rays"]:
        """Distance before which this share of the compositing weight lies, the background's left out."""
        total = torch.nn.functional.pad(self.weights.cumsum(-1), (1, 0))
        total = total / total[:, -1:].clamp_min(_LEAST_WEIGHT)
        upper = (total < share).sum(-1, keepdim=True).clamp(1, total.shape[-1] - 1)
        below, above = total.gather(-1, upper - 1), total.gather(-1, upper)
        start, end = self.edges.gather(-1, upper - 1), self.edges.gather(-1, upper)
        return (start + (share - below) / (above - below).clamp_min(_LEAST_WEIGHT) * (end - start))[:, 0]


def leave_box(rays: Rays, half_sides: Float[Tensor, "3"]) -> Float[Tensor, "rays"]:
    """Distance at which each ray leaves the box [-h, h] (the far side, also for origins outside)."""
    nonzero = torch.where(rays.direction.abs() < 1e-9, torch.full_like(rays.direction, 1e-9), rays.direction)
    return torch.maximum((half_sides - rays.origin) / nonzero, (-half_sides - rays.origin) / nonzero).amin(-1)


def coarse_edges(near: float, far: Float[Tensor, "rays"], count: int, bounded: bool) -> Float[Tensor, "rays count+1"]:
    """Interval edges from near to far: linear in distance for bounded scenes, else logarithmic."""
    u = torch.linspace(0, 1, count + 1, device=far.device, dtype=far.dtype)
    far = far[:, None].clamp_min(2 * near)
    return near + u * (far - near) if bounded else near * (far / near) ** u


def weights_of(
    density: Float[Tensor, "rays samples"], edges: Float[Tensor, "rays samples+1"]
) -> Float[Tensor, "rays samples"]:
    """Rendering weight of each interval: T_i (1 - exp(-density_i * length_i))."""
    optical_depth = density * edges.diff(dim=-1)
    transmittance = torch.exp(-(optical_depth.cumsum(-1) - optical_depth))
    return transmittance * -torch.expm1(-optical_depth)


def resample(
    edges: Float[Tensor, "rays coarse+1"],
    weights: Float[Tensor, "rays coarse"],
    count: int,
    jitter: Float[Tensor, "rays 1"],
) -> Float[Tensor, "rays count+1"]:
    """Edges of ``count`` intervals by inverse transform sampling; ``jitter`` in [-0.5, 0.5) shifts all of them."""
    cumulative = torch.nn.functional.pad((weights / weights.sum(-1, keepdim=True)).cumsum(-1), (1, 0))
    inner = ((torch.arange(1, count, device=edges.device) + jitter) / count).contiguous()
    upper = torch.searchsorted(cumulative, inner, right=True).clamp(1, edges.shape[-1] - 1)
    c0, c1 = cumulative.gather(-1, upper - 1), cumulative.gather(-1, upper)
    e0, e1 = edges.gather(-1, upper - 1), edges.gather(-1, upper)
    fraction = ((inner - c0) / (c1 - c0).clamp_min(1e-12)).clamp(0, 1)
    return torch.cat([edges[:, :1], e0 + fraction * (e1 - e0), edges[:, -1:]], dim=-1)


class DensityGrid(nn.Module):
    """A coarse cache of the field's density, so that sample placement needs no field evaluation."""

    def __init__(self, cells: int, bounded: bool):
        super().__init__()
        self.cells, self.half_side = cells, 1.0 if bounded else 2.0
        # Limits a refresh to about 65,536 points.
        self.refresh_share = max(16, cells**3 >> 16)
        self.register_buffer("density", torch.ones(cells**3))
        self.density: Tensor

    @torch.no_grad()
    def refresh(self, field: RadianceField, round_number: int, generator: torch.Generator) -> None:
        """Evaluate the field at a jittered point in every ``refresh_share``-th cell; each round covers other cells."""
        cell = torch.arange(round_number % self.refresh_share, self.cells**3, self.refresh_share)
        cell = cell.to(self.density.device)
        index = torch.stack([cell % self.cells, cell // self.cells % self.cells, cell // self.cells**2], dim=-1)
        jitter = torch.rand(index.shape, generator=generator).to(index.device)
        unit = (index + jitter) / self.cells
        found = field.density_in_unit_cube(unit)
        # A non-finite density would stay forever.
        self.density[cell] = torch.maximum(0.7 * self.density[cell], found.where(found.isfinite(), 0.0))

    @torch.no_grad()
    def remember(self, point: Float[Tensor, "points 3"], density: Float[Tensor, "points"]) -> None:
        """Update the cells that rays pass through, where accuracy matters."""
        # Chunks small enough that a CPU writes them in order: the last of several points in a cell always wins.
        piece = max(len(point), 1) if point.is_cuda else _IN_ORDER
        cells, densities = self._cell(point).split(piece), density.to(self.density).split(piece)
        for cell, seen in zip(cells, densities, strict=True):
            known = self.density[cell]
            self.density[cell] = known.lerp(seen.where(seen.isfinite(), known), _SHARE_OF_SEEN)

    def lookup(self, point: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """The cached density."""
        return self.density[self._cell(point)]

    def _cell(self, point: Float[Tensor, "*batch 3"]) -> Int64[Tensor, "*batch"]:
        """Index of the cell that contains each point; for unbounded scenes, points are contracted first."""
        point = contract(point) if self.half_side > 1 else point
        scaled = ((point / self.half_side + 1) * (self.cells / 2)).long().clamp(0, self.cells - 1)
        x, y, z = scaled.unbind(-1)
        return x + self.cells * (y + self.cells * z)


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
    """Interval edges, importance-sampled from the rendering weights of the cached density.

    The cached cells are coarser than silhouettes, and a ray that just misses an object must find what is behind it: an
    interval occludes at most the share ``most_hidden`` of that. ``uniform_share`` of the samples is spread evenly. With
    ``pairs``, rays k and k + n/2 share edges from their mean weights, and must have equal ``far`` and ``jitter``.
    """
    edges = coarse_edges(near, far, coarse, grid.half_side == 1)
    middle = (edges[:, 1:] + edges[:, :-1]) / 2
    point = rays.origin[:, None] + middle[..., None] * rays.direction[:, None]
    most = -math.log1p(-most_hidden) if most_hidden < 1 else math.inf
    weights = weights_of(torch.minimum(grid.lookup(point), most / edges.diff(dim=-1).clamp_min(1e-9)), edges)
    if pairs:
        weights = weights.unflatten(0, (2, -1)).mean(0).repeat(2, 1)
    # Light from the background is spread evenly too.
    spread = uniform_share + (1 - weights.sum(-1, keepdim=True)).clamp_min(0)
    return resample(edges, weights + spread / coarse, samples, jitter)


def composite(
    field: RadianceField,
    rays: Rays,
    edges: Float[Tensor, "rays samples+1"],
    background: Float[Tensor, ""] | float,
    memory: DensityGrid | None = None,
) -> Rendered:
    """Evaluate the field at the middle of each interval and composite (Eq. 4); ``memory`` receives the densities."""
    middle = (edges[:, 1:] + edges[:, :-1]) / 2
    point = rays.origin[:, None] + middle[..., None] * rays.direction[:, None]
    direction = rays.direction[:, None].expand_as(point).flatten(0, 1) if field.view_dependent else None
    density, intensity = field(point.flatten(0, 1), direction)
    if memory:
        memory.remember(point.detach().flatten(0, 1), density.detach())
    weights = weights_of(density.view_as(middle), edges)
    accumulation = weights.sum(-1)
    return Rendered(
        (weights * intensity.view_as(middle)).sum(-1) + (1 - accumulation) * background,
        (weights * middle).sum(-1) + (1 - accumulation) * edges[:, -1],
        accumulation,
        weights,
        edges,
    )
