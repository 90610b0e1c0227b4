"""The renderer: sample placement along rays and volume rendering of the field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor, nn

from ebarf_ns.radiance import ray_sampling_numba
from ebarf_ns.radiance.field import RadianceField
from ebarf_ns.radiance.ray_sampling import (
    DensityGrid,
    Rays,
    Rendered,
    coarse_edges,
    composite,
    importance_edges,
    leave_box,
    resample,
)

if TYPE_CHECKING:
    from jaxtyping import Float

# For unbounded scenes, 400 times the trajectory's radius; the contracted space beyond is 1/100 of a cell thick.
_FAR_UNBOUNDED = 100.0
_BACKGROUND = 0.5
_WARM_UP, _REFRESH_EVERY = 16, 8


@dataclass(frozen=True)
class Sampling:
    """Placement of samples along rays."""

    samples: int = 24
    """Field evaluations per ray."""
    near: float = 0.05
    """Distance at which rays begin."""
    kind: Literal["importance", "uniform"] = "importance"
    """By cached density, or evenly."""
    coarse_samples: int = 128
    """Lookups of the cached density per ray."""
    uniform_share: float = 0.125
    """Share of the importance samples that is spread evenly, so that no region is missed."""
    most_hidden: float = 0.15
    """Largest share of what is behind it that an interval may occlude in sample placement; 1: all of it."""
    density_cells: int = 96
    """Cells per side of the density cache."""


class Renderer(nn.Module):
    """A field and, for importance sampling, a density cache that makes empty space cheap.

    A bounded scene lies in the box [-h, h] with h = ``half_sides``.
    """

    def __init__(self, field: RadianceField, sampling: Sampling, half_sides: Float[Tensor, "3"] | None = None):
        super().__init__()
        self.field, self.sampling = field, sampling
        self.register_buffer("half_sides", torch.ones(3) if half_sides is None else half_sides, persistent=False)
        self.half_sides: Tensor
        self.density_grid = (
            DensityGrid(sampling.density_cells, field.bounded) if sampling.kind == "importance" else None
        )

    def begin_step(self, step: int, random: torch.Generator) -> None:
        """Refresh the density cache: in every step at first, then every few steps."""
        if self.density_grid and (step < _WARM_UP or step % _REFRESH_EVERY == 0):
            self.density_grid.refresh(self.field, step if step < _WARM_UP else step // _REFRESH_EVERY, random)

    def forward(self, rays: Rays, pairs_random: torch.Generator | None = None) -> Rendered:
        """Render rays; with ``pairs_random``, samples are jittered, and rays k and k + n/2 share them.

        The loss uses the difference between the two rays of a pair: any other difference than the pose is noise in it.
        """
        edges = self.sample_edges(rays, pairs_random)
        return composite(self.field, rays, edges, _BACKGROUND, self.density_grid if pairs_random else None)

    @torch.no_grad()
    def sample_edges(self, rays: Rays, pairs_random: torch.Generator | None) -> Float[Tensor, "rays samples+1"]:
        """Edges of the intervals whose midpoints are sampled."""
        sampling, bounded = self.sampling, self.field.bounded
        far = leave_box(rays, self.half_sides) if bounded else torch.full_like(rays.origin[:, 0], _FAR_UNBOUNDED)
        jitter = torch.zeros(len(far), 1, device=far.device)
        if pairs_random:
            far = far.view(2, -1).amax(0).repeat(2)
            jitter = torch.rand(len(far) // 2, 1, generator=pairs_random).to(far.device).repeat(2, 1) - 0.5
        if self.density_grid is None:
            edges = coarse_edges(sampling.near, far, sampling.samples, bounded)
            return resample(edges, torch.ones_like(edges[:, 1:]), sampling.samples, jitter)
        on_cpu = far.device.type == "cpu" and far.dtype == torch.float32
        place = ray_sampling_numba.importance_edges if on_cpu else importance_edges
        return place(
            self.density_grid,
            rays,
            sampling.near,
            far,
            sampling.coarse_samples,
            sampling.uniform_share,
            sampling.most_hidden,
            sampling.samples,
            jitter,
            pairs_random is not None,
        )
