"""Surface normals from the density gradient in front of surfaces."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch.nn.functional import conv3d, grid_sample, normalize

from ebarf_ns.radiance.field import contract
from ebarf_ns.radiance.ray_sampling import DensityGrid

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from ebarf_ns.radiance.ray_sampling import Rays
    from ebarf_ns.radiance.renderer import Renderer

# Density behind a surface is arbitrary, so the gradient is taken at 0.9 of the depth. Median errors in the demo room:
# 30 degrees, 39 at the surface itself, 46 without the blur.
_IN_FRONT = 0.9
_BLUR_CELLS = 2.0
_CELLS = 64


class SurfaceNormals:
    """Normals from the gradient of the blurred log density in a trained renderer's density cache."""

    @torch.no_grad()
    def __init__(self, renderer: Renderer):
        grid = renderer.density_grid or _sampled_density(renderer)
        self.contracted, self.half_side = grid.half_side > 1, grid.half_side
        self.step = 2 * grid.half_side / grid.cells
        self.log_density = _blurred(grid.density.log1p().view(1, 1, *[grid.cells] * 3))

    def __call__(self, rays: Rays, depth: Float[Tensor, "rays"]) -> Float[Tensor, "rays 3"]:
        """Unit normals, in world axes, of the surface at each ray's depth, facing the viewer."""
        point = rays.origin + _IN_FRONT * depth[:, None] * rays.direction
        # Cells of contracted space grow with distance.
        step = self.step * point.norm(dim=-1, keepdim=True).clamp_min(1).square() if self.contracted else self.step
        moves = torch.eye(3, device=point.device)
        rise = [self._lookup(point + step * move) - self._lookup(point - step * move) for move in moves]
        normal = -normalize(torch.stack(rise, dim=-1), dim=-1)
        facing = (normal * rays.direction).sum(dim=-1, keepdim=True) <= 0
        return torch.where(facing, normal, -normal)

    def _lookup(self, point: Float[Tensor, "rays 3"]) -> Float[Tensor, "rays"]:
        place = (contract(point) if self.contracted else point) / self.half_side
        found = grid_sample(self.log_density, place[None, None, None], padding_mode="border", align_corners=False)
        return found.view(-1)


def _sampled_density(renderer: Renderer) -> DensityGrid:
    """A density cache for a renderer without one."""
    grid = DensityGrid(_CELLS, renderer.field.bounded).to(renderer.half_sides.device)
    grid.density.zero_()
    random = torch.Generator().manual_seed(0)
    for number in range(grid.refresh_share):
        grid.refresh(renderer.field, number, random)
    return grid


def _blurred(volume: Float[Tensor, "1 1 z y x"]) -> Float[Tensor, "1 1 z y x"]:
    reach = round(3 * _BLUR_CELLS)
    weight = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, device=volume.device) / _BLUR_CELLS).square())
    for axis in range(3):
        shape, padding = [1] * 3, [0] * 3
        shape[axis], padding[axis] = len(weight), reach
        volume = conv3d(volume, (weight / weight.sum()).view(1, 1, *shape), padding=tuple(padding))
    return volume
