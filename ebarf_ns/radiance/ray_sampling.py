"""Where along a ray the field is asked, and how the answers add up (Max 1995; Mildenhall et al. 2020)."""

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
_DARKEST = 1e-9


class Rays(NamedTuple):
    """World rays with unit directions."""

    origin: Float[Tensor, "rays 3"]
    direction: Float[Tensor, "rays 3"]


class Rendered(NamedTuple):
    """What a ray sees."""

    intensity: Float[Tensor, "rays"]
    depth: Float[Tensor, "rays"]
    accumulation: Float[Tensor, "rays"]
    """Share of the light that comes from within the scene."""
    weights: Float[Tensor, "rays samples"]
    """Share of the light that comes from each interval."""
    edges: Float[Tensor, "rays samples+1"]
    """Distances between which the intervals lie."""

    def distance_before(self, share: float) -> Float[Tensor, "rays"]:
        """Distance before which that share of the light comes from, of what comes from within the scene."""
        total = torch.nn.functional.pad(self.weights.cumsum(-1), (1, 0))
        total = total / total[:, -1:].clamp_min(_DARKEST)
        upper = (total < share).sum(-1, keepdim=True).clamp(1, total.shape[-1] - 1)
        below, above = total.gather(-1, upper - 1), total.gather(-1, upper)
        start, end = self.edges.gather(-1, upper - 1), self.edges.gather(-1, upper)
        return (start + (share - below) / (above - below).clamp_min(_DARKEST) * (end - start))[:, 0]


def leave_box(rays: Rays, half_sides: Float[Tensor, "3"]) -> Float[Tensor, "rays"]:
    """Distance at which each ray leaves the box [-h, h] (its far side, also for origins outside)."""
    away = torch.where(rays.direction.abs() < 1e-9, torch.full_like(rays.direction, 1e-9), rays.direction)
    return torch.maximum((half_sides - rays.origin) / away, (-half_sides - rays.origin) / away).amin(-1)


def coarse_edges(near: float, far: Float[Tensor, "rays"], count: int, bounded: bool) -> Float[Tensor, "rays count+1"]:
    """Interval edges from near to far: even in distance within bounds, else even in its logarithm."""
    u = torch.linspace(0, 1, count + 1, device=far.device, dtype=far.dtype)
    far = far[:, None].clamp_min(2 * near)
    return near + u * (far - near) if bounded else near * (far / near) ** u


def weights_of(
    density: Float[Tensor, "rays samples"], edges: Float[Tensor, "rays samples+1"]
) -> Float[Tensor, "rays samples"]:
    """Share of a ray's light that comes from each interval: T_i (1 - exp(-density_i * length_i))."""
    optical = density * edges.diff(dim=-1)
    transmitted = torch.exp(-(optical.cumsum(-1) - optical))
    return transmitted * -torch.expm1(-optical)


def resample(
    edges: Float[Tensor, "rays coarse+1"],
    weights: Float[Tensor, "rays coarse"],
    count: int,
    jitter: Float[Tensor, "rays 1"],
) -> Float[Tensor, "rays count+1"]:
    """Edges of ``count`` intervals, as dense as the weights are heavy; ``jitter`` in [-0.5, 0.5) shifts them all."""
    cumulative = torch.nn.functional.pad((weights / weights.sum(-1, keepdim=True)).cumsum(-1), (1, 0))
    inner = ((torch.arange(1, count, device=edges.device) + jitter) / count).contiguous()
    upper = torch.searchsorted(cumulative, inner, right=True).clamp(1, edges.shape[-1] - 1)
    c0, c1 = cumulative.gather(-1, upper - 1), cumulative.gather(-1, upper)
    e0, e1 = edges.gather(-1, upper - 1), edges.gather(-1, upper)
    fraction = ((inner - c0) / (c1 - c0).clamp_min(1e-12)).clamp(0, 1)
    return torch.cat([edges[:, :1], e0 + fraction * (e1 - e0), edges[:, -1:]], dim=-1)


class DensityGrid(nn.Module):
    """A coarse memory of the field's density, so that finding out where to look costs no pass through the field."""

    def __init__(self, cells: int, bounded: bool):
        super().__init__()
        self.cells, self.half_side = cells, 1.0 if bounded else 2.0
        # So that keeping it up to date costs no more than some 65,536 points at a time.
        self.refresh_share = max(16, cells**3 >> 16)
        self.register_buffer("density", torch.ones(cells**3))
        self.density: Tensor

    @torch.no_grad()
    def refresh(self, field: RadianceField, round_number: int, generator: torch.Generator) -> None:
        """Look up the field at a jittered place in every ``refresh_share``-th cell, other cells in each round."""
        cell = torch.arange(round_number % self.refresh_share, self.cells**3, self.refresh_share)
        cell = cell.to(self.density.device)
        index = torch.stack([cell % self.cells, cell // self.cells % self.cells, cell // self.cells**2], dim=-1)
        jitter = torch.rand(index.shape, generator=generator).to(index.device)
        unit = (index + jitter) / self.cells
        found = field.density_in_unit_cube(unit)
        # A density that is not finite would be remembered for ever.
        self.density[cell] = torch.maximum(0.7 * self.density[cell], found.where(found.isfinite(), 0.0))

    @torch.no_grad()
    def remember(self, point: Float[Tensor, "points 3"], density: Float[Tensor, "points"]) -> None:
        """Keep up with what rays come across, which is where it matters."""
        # Pieces so small that a CPU writes them in order: of several points in a cell, always the last one counts.
        piece = max(len(point), 1) if point.is_cuda else _IN_ORDER
        cells, densities = self._cell(point).split(piece), density.to(self.density).split(piece)
        for cell, seen in zip(cells, densities, strict=True):
            known = self.density[cell]
            self.density[cell] = known.lerp(seen.where(seen.isfinite(), known), _SHARE_OF_SEEN)

    def lookup(self, point: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """The remembered density."""
        return self.density[self._cell(point)]

    def _cell(self, point: Float[Tensor, "*batch 3"]) -> Int64[Tensor, "*batch"]:
        """Number of the cell that holds each point; for contracted scenes, points are contracted here."""
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
    """Edges of intervals as dense as the remembered density makes a ray's light come from them.

    The memory's cells are coarser than silhouettes, and a ray past an object's edge must find what is behind it: an
    interval hides no more than the share ``most_hidden`` of that. ``uniform_share`` of all are spread evenly. With
    ``pairs``, rays k and k + n/2 share edges, by their mean weights, and have the same ``far`` and ``jitter``.
    """
    edges = coarse_edges(near, far, coarse, grid.half_side == 1)
    middle = (edges[:, 1:] + edges[:, :-1]) / 2
    point = rays.origin[:, None] + middle[..., None] * rays.direction[:, None]
    most = -math.log1p(-most_hidden) if most_hidden < 1 else math.inf
    weights = weights_of(torch.minimum(grid.lookup(point), most / edges.diff(dim=-1).clamp_min(1e-9)), edges)
    if pairs:
        weights = weights.unflatten(0, (2, -1)).mean(0).repeat(2, 1)
    # What passes through the scene is spread evenly too.
    spread = uniform_share + (1 - weights.sum(-1, keepdim=True)).clamp_min(0)
    return resample(edges, weights + spread / coarse, samples, jitter)


def composite(
    field: RadianceField,
    rays: Rays,
    edges: Float[Tensor, "rays samples+1"],
    background: Float[Tensor, ""] | float,
    memory: DensityGrid | None = None,
) -> Rendered:
    """Ask the field at the middle of each interval, and sum up (Eq. 4); ``memory`` is told the densities."""
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
