import math

import pytest
import torch

from ebarf_ns.radiance import ray_sampling_numba
from ebarf_ns.radiance.field import RadianceField
from ebarf_ns.radiance.lattice import HashGridShape
from ebarf_ns.radiance.ray_sampling import (
    DensityGrid,
    Rays,
    coarse_edges,
    composite,
    importance_edges,
    leave_box,
    resample,
    weights_of,
)
from ebarf_ns.radiance.renderer import Renderer, Sampling


class Slab(torch.nn.Module):
    """A dense wall from x = 0.5 on; intensity 0.7."""

    view_dependent = False

    def forward(self, point: torch.Tensor, direction: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.where(point[:, 0] > 0.5, 1e4, 0.0), torch.full_like(point[:, 0], 0.7)

    def density_in_unit_cube(self, unit: torch.Tensor) -> torch.Tensor:
        return torch.where(unit[:, 0] > 0.75, 100.0, 0.0)


def along_x(count: int = 1) -> Rays:
    return Rays(torch.zeros(count, 3), torch.tensor([[1.0, 0, 0]]).expand(count, 3))


def test_rays_leave_the_box_where_they_should():
    direction = torch.nn.functional.normalize(torch.tensor([[1.0, 0, 0], [1, 1, 0], [0, 0, -1]]), dim=-1)
    rays = Rays(torch.tensor([[0.5, 0, 0], [0, 0, 0], [0, 0, 0.25]]), direction)
    assert torch.allclose(leave_box(rays, torch.ones(3)), torch.tensor([0.5, math.sqrt(2), 1.25]))
    flat = torch.tensor([1.0, 0.5, 0.3])
    assert torch.allclose(leave_box(rays, flat), torch.tensor([0.5, 0.5 * math.sqrt(2), 0.55]))


@pytest.mark.parametrize("bounded", [True, False])
def test_coarse_edges_grow_from_near_to_far(bounded: bool):
    edges = coarse_edges(0.1, torch.tensor([2.0, 100.0, 0.0]), 32, bounded)
    assert torch.allclose(edges[:, 0], torch.tensor(0.1)) and (edges.diff(dim=-1) > 0).all()
    assert torch.allclose(edges[:2, -1], torch.tensor([2.0, 100.0]))


def test_weights_are_those_of_the_quadrature():
    density, edges = torch.rand(4, 9) * 5, torch.cat([torch.zeros(4, 1), torch.rand(4, 9).cumsum(-1)], dim=-1)
    alpha = 1 - torch.exp(-density * edges.diff(dim=-1))
    transmitted = torch.cat([torch.ones(4, 1), (1 - alpha).cumprod(-1)], dim=-1)
    assert torch.allclose(weights_of(density, edges), alpha * transmitted[:, :-1], atol=1e-6)
    assert torch.allclose(weights_of(density, edges).sum(-1), 1 - transmitted[:, -1], atol=1e-6)


def test_weights_of_nothing_and_of_a_wall_are_finite():
    edges = torch.linspace(0, 1, 9)[None]
    for density in (0.0, 1e12):
        raw = torch.full((1, 8), density, requires_grad=True)
        weights = weights_of(raw, edges)
        (gradient,) = torch.autograd.grad(weights.sum(), raw)
        assert torch.isfinite(weights).all() and torch.isfinite(gradient).all()


@pytest.mark.parametrize("jitter", [-0.5, 0.0, 0.499])
def test_resampled_edges_are_ordered_span_everything_and_follow_the_weights(jitter: float):
    edges = torch.linspace(0, 1, 11)[None]
    weights = torch.full((1, 10), 0.01)
    weights[0, 6] = 1.0
    fine = resample(edges, weights, 40, torch.tensor([[jitter]]))
    assert fine.shape == (1, 41) and (fine.diff(dim=-1) >= 0).all()
    assert fine[0, 0] == 0 and fine[0, -1] == 1
    inside = ((fine > 0.6) & (fine < 0.7)).float().mean()
    assert inside > 0.8


def test_even_weights_give_even_samples_with_zero_mean_jitter():
    edges = torch.linspace(2, 4, 9)[None]
    jitters = torch.linspace(-0.5, 0.5, 101)[:-1, None]
    fine = resample(edges.expand(100, 9), torch.ones(100, 8), 16, jitters)
    expected = torch.linspace(2, 4, 17)[1:-1]
    assert torch.allclose(fine.mean(0)[1:-1], expected, atol=2e-3)


def test_a_wall_is_seen_at_its_depth():
    edges = torch.linspace(0.0, 1.0, 201)[None]
    rendered = composite(Slab(), along_x(), edges, background=0.0)  # pyright: ignore[reportArgumentType]
    assert float(rendered.depth) == pytest.approx(0.5, abs=0.01)
    assert float(rendered.intensity) == pytest.approx(0.7, abs=1e-4)
    assert float(rendered.accumulation) == pytest.approx(1.0, abs=1e-6)


def test_empty_space_shows_the_background_at_the_far_end():
    edges = torch.linspace(0.0, 0.4, 11)[None]
    rendered = composite(Slab(), along_x(), edges, background=0.25)  # pyright: ignore[reportArgumentType]
    assert float(rendered.intensity) == pytest.approx(0.25) and float(rendered.depth) == pytest.approx(0.4)


def test_density_grid_caches_the_wall():
    grid = DensityGrid(16, bounded=True)
    generator = torch.Generator().manual_seed(0)
    for k in range(3 * grid.refresh_share):
        grid.refresh(Slab(), k, generator)  # pyright: ignore[reportArgumentType]
    seen = grid.lookup(torch.tensor([[0.9, 0.1, -0.3], [-0.2, 0.5, 0.5]]))
    assert seen[0] > 10 and seen[1] < 1


@pytest.mark.parametrize("bounded", [True, False])
def test_density_grid_is_updated_along_rays(bounded: bool):
    grid = DensityGrid(16, bounded)
    point = torch.tensor([[0.9, 0.1, -0.3], [-0.2, 0.5, 0.5], [-0.2, 0.5, 0.5]])
    for _ in range(10):
        grid.remember(point, torch.tensor([30.0, 7.0, 0.0]))
    assert grid.lookup(point[:2]).tolist() == pytest.approx([30, 0], abs=0.1)
    assert (grid.density != 1).sum() == 2


def test_only_training_rays_update_the_density_grid():
    torch.manual_seed(0)
    field = RadianceField(HashGridShape(4, 2, 4, 32, 10), bounded=True)
    with torch.no_grad():
        field.trunk[-1].bias[0] = 3.0  # pyright: ignore[reportIndexIssue]
    renderer = Renderer(field, Sampling(samples=8, density_cells=16))
    rays = Rays(torch.zeros(4, 3), torch.nn.functional.normalize(torch.randn(4, 3), dim=-1))
    assert renderer.density_grid is not None
    renderer(rays)
    assert (renderer.density_grid.density == 1).all()
    renderer(rays, torch.Generator().manual_seed(0))
    assert (renderer.density_grid.density > 5).any()


def test_density_grid_of_an_unbounded_scene_reaches_everywhere():
    grid = DensityGrid(16, bounded=False)
    assert torch.isfinite(grid.lookup(torch.tensor([[1e9, -1e9, 3.0], [0, 0, 0]]))).all()


def test_gradient_moves_the_ray_towards_the_light():
    torch.manual_seed(0)
    field = RadianceField(HashGridShape(4, 2, 4, 32, 10), bounded=True)
    torch.nn.init.normal_(field.grid.table)
    origin = torch.zeros(2, 3, requires_grad=True)
    rays = Rays(origin, torch.nn.functional.normalize(torch.ones(2, 3), dim=-1))
    rendered = composite(field, rays, coarse_edges(0.05, leave_box(rays, torch.ones(3)), 16, True), 0.5)
    (gradient,) = torch.autograd.grad(rendered.intensity.sum(), origin)
    assert torch.isfinite(gradient).all() and gradient.abs().sum() > 0


@pytest.mark.parametrize("bounded", [True, False])
@pytest.mark.parametrize("pairs", [True, False])
def test_samples_placed_in_one_pass_are_those_of_the_reference(bounded: bool, pairs: bool):
    torch.manual_seed(0)
    grid = DensityGrid(16, bounded)
    grid.density.copy_(torch.rand(16**3) ** 6 * 50)
    rays = Rays(torch.rand(40, 3) - 0.5, torch.nn.functional.normalize(torch.randn(40, 3), dim=-1))
    far = leave_box(rays, torch.ones(3)) if bounded else torch.full((40,), 50.0)
    far[3] = far[23] = 0.0
    jitter = torch.rand(40, 1) - 0.5
    if pairs:
        far, jitter = far.view(2, -1).amax(0).repeat(2), jitter[:20].repeat(2, 1)
    ours = ray_sampling_numba.importance_edges(grid, rays, 0.05, far, 64, 0.1, 0.3, 24, jitter, pairs)
    theirs = importance_edges(grid, rays, 0.05, far, 64, 0.1, 0.3, 24, jitter, pairs)
    # A point on a cell border may fall on either side.
    assert ((ours - theirs).abs() < 2e-3 * far[:, None].clamp_min(0.1)).float().mean() > 0.98
    assert (ours.diff(dim=-1) >= 0).all() and (not pairs or torch.equal(ours[:20], ours[20:]))


@pytest.mark.parametrize("place", [importance_edges, ray_sampling_numba.importance_edges])
def test_the_wall_behind_a_grazed_cell_is_sampled_too(place):
    grid = DensityGrid(16, bounded=True)
    near_object, wall = (torch.tensor([[x, 0.01, 0.01]]) for x in (0.3, 0.97))
    grid.density.zero_()
    cells = ((torch.cat([near_object, wall]) + 1) * 8).long() @ torch.tensor([1, 16, 256])
    grid.density[cells] = 1e4
    rays = Rays(torch.full((1, 3), 0.01), torch.tensor([[1.0, 0, 0]]))
    seen = []
    far = leave_box(rays, torch.ones(3))
    for most_hidden in (0.3, 1.0):
        edges = place(grid, rays, 0.05, far, 16, 0.1, most_hidden, 16, torch.zeros(1, 1), False)
        middle = (edges[0, 1:] + edges[0, :-1]) / 2
        assert ((middle > 0.2) & (middle < 0.4)).sum() >= 4
        seen.append(int((middle > 0.86).sum()))
    assert seen[0] >= 2 and seen[1] == 0


def test_no_rays_give_no_samples():
    rays, grid = Rays(torch.zeros(0, 3), torch.zeros(0, 3)), DensityGrid(16, bounded=True)
    for place in (importance_edges, ray_sampling_numba.importance_edges):
        assert place(grid, rays, 0.05, torch.zeros(0), 64, 0.1, 0.3, 24, torch.zeros(0, 1), False).shape == (0, 25)


def test_a_density_that_is_not_finite_is_not_cached():
    grid = DensityGrid(8, bounded=True)
    point = torch.tensor([[0.1, 0.1, 0.1], [0.6, 0.1, 0.1], [-0.6, 0.1, 0.1]])
    grid.remember(point, torch.tensor([torch.nan, torch.inf, 5.0]))
    assert grid.lookup(point).tolist() == [1.0, 1.0, 3.0]

    class Poisoned:
        def density_in_unit_cube(self, unit: torch.Tensor) -> torch.Tensor:
            return torch.full((len(unit),), torch.nan)

    for round_number in range(grid.refresh_share):
        grid.refresh(Poisoned(), round_number, torch.Generator())  # pyright: ignore[reportArgumentType]
    assert grid.density.isfinite().all()
