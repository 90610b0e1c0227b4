"""From rays to what they see: where to ask the field, and the sum of its answers."""

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

# Without bounds, 400 times the trajectory's radius; beyond it contracted space is a hundredth of a cell thick.
_FAR_UNBOUNDED = 100.0
_BACKGROUND = 0.5
_WARM_UP, _REFRESH_EVERY = 16, 8


@dataclass(frozen=True)
class Sampling:
    """Where along a ray the field is asked."""

    samples: int = 24
    """Points per ray at which the field is asked."""
    near: float = 0.05
    """Distance at which rays begin."""
    kind: Literal["importance", "uniform"] = "importance"
    """Where the remembered density is, or everywhere evenly."""
    coarse_samples: int = 128
    """Points per ray at which the remembered density is looked up."""
    uniform_share: float = 0.125
    """Share of the importance samples that is spread evenly, so that nothing stays unseen."""
    most_hidden: float = 0.15
    """Share of what is behind it that an interval remembered as dense may hide from the samples; 1: all of it."""
    density_cells: int = 96
    """Cells per side of the remembered density."""


class Renderer(nn.Module):
    """A field, and with importance sampling a memory of where it is dense, so that empty space costs little.

    A bounded scene lies in the box [-h, h], h the ``half_sides``.
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
        """Keep the memory up with the field: often at first, then every so many steps."""
        if self.density_grid and (step < _WARM_UP or step % _REFRESH_EVERY == 0):
            self.density_grid.refresh(self.field, step if step < _WARM_UP else step // _REFRESH_EVERY, random)

    def forward(self, rays: Rays, pairs_random: torch.Generator | None = None) -> Rendered:
        """What each ray sees; with ``pairs_random``, jittered, and ray k shares its samples with ray k + n/2.

        The loss looks at the difference between the two rays of a pair: whatever differs between them but the pose is
        noise in exactly that.
        """
        edges = self.sample_edges(rays, pairs_random)
        return composite(self.field, rays, edges, _BACKGROUND, self.density_grid if pairs_random else None)

    @torch.no_grad()
    def sample_edges(self, rays: Rays, pairs_random: torch.Generator | None) -> Float[Tensor, "rays samples+1"]:
        """Edges of the intervals whose middles are asked for."""
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
