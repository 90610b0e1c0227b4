"""Normals of what a renderer remembers."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch.nn.functional import normalize

from ebarf_ns.radiance.normals import SurfaceNormals
from ebarf_ns.radiance.ray_sampling import DensityGrid, Rays


@pytest.mark.parametrize("bounded", [True, False])
@pytest.mark.parametrize("normal", [[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [-0.6, 0.6, -0.5]])
def test_a_wall_faces_the_viewer(normal: list[float], bounded: bool):
    facing = normalize(torch.tensor(normal), dim=0)
    grid = DensityGrid(64, bounded)
    index = torch.arange(64**3)
    cell = torch.stack([index % 64, index // 64 % 64, index // 64**2], dim=-1)
    centre = ((cell + 0.5) / 32 - 1) * grid.half_side
    # A wall half a unit away from the origin, solid behind.
    grid.density.copy_(torch.where(centre @ -facing > 0.5, 200.0, 0.01))
    renderer: Any = SimpleNamespace(density_grid=grid)
    aside = 0.2 * torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    direction = normalize(-facing + aside, dim=-1)
    depth = 0.5 / (direction @ -facing)
    found = SurfaceNormals(renderer)(Rays(torch.zeros(50, 3), direction), depth)
    angle_deg = torch.rad2deg(torch.atan2(torch.linalg.cross(found, facing.expand(50, 3)).norm(dim=-1), found @ facing))
    assert float(angle_deg.max()) < 10
