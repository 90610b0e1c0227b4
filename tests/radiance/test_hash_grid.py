"""The numba kernels against the torch reference in float64, values and both gradients."""

import pytest
import torch

from ebarf_ns.radiance.hash_grid import HashGrid, HashGridShape, encode_reference

SHAPES = [
    HashGridShape(levels=4, features=2, coarsest=4, finest=64, table_size_log2=10),
    HashGridShape(levels=3, features=4, coarsest=2, finest=9, table_size_log2=12),
    HashGridShape(levels=1, features=1, coarsest=5, finest=5, table_size_log2=4),
]


def random_points(count: int) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(0))


def special_points() -> torch.Tensor:
    """Corners, faces, cell borders, and outside the cube."""
    steps = torch.tensor([-0.5, 0.0, 0.25, 0.5, 1.0, 1.5])
    return torch.cartesian_prod(steps, steps, steps)


def both(shape: HashGridShape, point: torch.Tensor) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    torch.manual_seed(1)
    grid = HashGrid(shape)
    torch.nn.init.normal_(grid.table)
    weight = torch.randn(len(point), grid.width)
    point = point.clone().requires_grad_()
    encoded = grid(point)
    ours = [encoded.detach(), *torch.autograd.grad((encoded * weight).sum(), [grid.table, point])]
    exact_point = point.detach().double().requires_grad_()
    exact_table = grid.table.detach().double().requires_grad_()
    exact = encode_reference(exact_point, exact_table, grid.resolution, grid.first_row)
    theirs = [exact.detach(), *torch.autograd.grad((exact * weight).sum(), [exact_table, exact_point])]
    return ours, theirs


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: f"{shape.levels}x{shape.features}")
def test_values_and_gradients_agree_with_the_reference(shape: HashGridShape):
    for ours, theirs in zip(*both(shape, random_points(5000)), strict=True):
        scale = theirs.abs().max()
        assert (ours - theirs).abs().max() < 1e-4 * scale


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: f"{shape.levels}x{shape.features}")
def test_values_and_table_gradients_agree_on_borders_and_outside(shape: HashGridShape):
    # Position gradients jump on cell borders, where either side's is right.
    for ours, theirs in list(zip(*both(shape, special_points()), strict=True))[:2]:
        assert (ours - theirs).abs().max() < 1e-4 * theirs.abs().max()


def test_outside_the_cube_nothing_pulls():
    grid = HashGrid(SHAPES[0])
    torch.nn.init.normal_(grid.table)
    point = torch.tensor([[1.5, 0.3, -0.2]], requires_grad=True)
    (gradient,) = torch.autograd.grad(grid(point).sum(), point)
    assert gradient[0, 0] == 0 and gradient[0, 2] == 0 and gradient[0, 1] != 0


def test_position_gradient_is_the_slope():
    grid = HashGrid(SHAPES[0]).double()
    torch.nn.init.normal_(grid.table)
    assert torch.autograd.gradcheck(grid, [random_points(5).double().requires_grad_()], eps=1e-7, atol=1e-5)


def test_levels_grow_from_coarsest_to_finest_and_small_ones_are_dense():
    shape = HashGridShape(levels=5, coarsest=4, finest=64, table_size_log2=12)
    assert shape.resolutions == [4, 8, 16, 32, 64]
    assert shape.rows == [125, 729, 4096, 4096, 4096]


def test_no_points_are_no_features():
    assert HashGrid(SHAPES[0])(torch.zeros(0, 3)).shape == (0, 8)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_agrees_with_cpu():
    grid = HashGrid(SHAPES[0])
    torch.nn.init.normal_(grid.table)
    point = random_points(1000)
    assert torch.allclose(grid(point), grid.cuda()(point.cuda()).cpu(), atol=1e-4)
