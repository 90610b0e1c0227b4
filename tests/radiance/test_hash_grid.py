"""Every backend of the encoding against the torch reference in float64: values and both gradients."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
import torch
from torch import nn

from ebarf_ns.radiance.hash_grid import Backend, HashGrid, encode_reference, fastest_backend
from ebarf_ns.radiance.lattice import HashGridShape

SHAPES = [
    HashGridShape(levels=4, features=2, coarsest=4, finest=64, table_size_log2=10),
    HashGridShape(levels=3, features=4, coarsest=3, finest=9, table_size_log2=12),
    HashGridShape(levels=1, features=1, coarsest=5, finest=5, table_size_log2=7),
]
INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
BACKENDS = ["triton"] if INTERPRETED else ["numba"]


def random_points(count: int) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(0))


def special_points() -> torch.Tensor:
    """Points at corners, on faces and cell borders, and outside the cube."""
    steps = torch.tensor([-0.5, 0.0, 0.25, 0.5, 1.0, 1.5])
    return torch.cartesian_prod(steps, steps, steps)


def made(shape: HashGridShape, backend: Backend | None = None, seed: int = 1) -> HashGrid:
    torch.manual_seed(seed)
    grid = HashGrid(shape, backend)
    nn.init.normal_(grid.table)
    return grid


def both(grid: HashGrid, point: torch.Tensor) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Values, table gradient and position gradient of the grid, and of the reference in float64."""
    torch.manual_seed(2)
    weight = torch.randn(len(point), grid.shape.width)
    poison(len(point), grid.shape.width)
    point = point.clone().requires_grad_()
    encoded = grid(point)
    ours = [encoded.detach(), *torch.autograd.grad((encoded * weight.to(encoded)).sum(), [grid.table, point])]
    exact_point = point.detach().double().cpu().requires_grad_()
    exact_table = grid.table.detach().double().cpu().requires_grad_()
    exact = encode_reference(exact_point, exact_table, grid.lattice.cpu())
    theirs = [exact.detach(), *torch.autograd.grad((exact * weight).sum(), [exact_table, exact_point])]
    return [one.cpu() for one in ours], theirs


def poison(*shape: int) -> None:
    """Fill freed memory with NaN where the next arrays are likely to be placed, to reveal unwritten values."""
    for _ in range(3):
        torch.full(shape, torch.nan)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: f"{shape.levels}x{shape.features}")
def test_values_and_gradients_agree_with_the_reference(backend: Backend, shape: HashGridShape):
    for ours, theirs in zip(*both(made(shape, backend), random_points(300 if INTERPRETED else 2000)), strict=True):
        assert (ours - theirs).abs().max() < 1e-4 * theirs.abs().max()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: f"{shape.levels}x{shape.features}")
def test_values_and_table_gradients_agree_on_borders_and_outside(backend: Backend, shape: HashGridShape):
    # Position gradients are discontinuous at cell borders, where either side is right.
    for ours, theirs in list(zip(*both(made(shape, backend), special_points()), strict=True))[:2]:
        assert (ours - theirs).abs().max() < 1e-4 * theirs.abs().max()


def test_gradients_in_use_are_never_overwritten():
    grid, point = made(SHAPES[0], "numba"), random_points(200)
    first, second = (torch.autograd.grad(k * grid(point).sum(), grid.table)[0] for k in (1, 2))
    assert torch.allclose(2 * first, second) and first.data_ptr() != second.data_ptr()
    (3 * grid(point)).sum().backward()
    (3 * grid(point)).sum().backward()
    assert grid.table.grad is not None and torch.allclose(6 * first, grid.table.grad, rtol=1e-5)
    kept = second.data_ptr()
    del first, second
    grid.zero_grad()
    (third,) = torch.autograd.grad(grid(point).sum(), grid.table)
    assert third.data_ptr() == kept or third.abs().sum() > 0


@pytest.mark.parametrize("backend", BACKENDS)
def test_position_gradients_vanish_outside_the_cube(backend: Backend):
    point = torch.tensor([[1.5, 0.3, -0.2]], requires_grad=True)
    (gradient,) = torch.autograd.grad(made(SHAPES[0], backend)(point).sum(), point)
    assert gradient[0, 0] == 0 and gradient[0, 2] == 0 and gradient[0, 1] != 0


@pytest.mark.parametrize("backend", BACKENDS)
def test_nan_points_give_nan_features_and_affect_nothing_else(backend: Backend):
    point = random_points(300)
    point[7, 1], point[11, 0], point[12, 2] = torch.nan, torch.inf, -torch.inf
    encoded = made(SHAPES[0], backend)(point.requires_grad_())
    assert encoded[7].isnan().all()
    others = torch.arange(300) != 7
    assert encoded[others].isfinite().all()
    (gradient,) = torch.autograd.grad(encoded[others].sum(), point)
    assert gradient[others].isfinite().all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_points_give_no_features(backend: Backend):
    assert HashGrid(SHAPES[0], backend)(torch.zeros(0, 3)).shape == (0, 8)


def test_position_gradient_matches_finite_differences():
    grid = made(SHAPES[0]).double()
    assert torch.autograd.gradcheck(grid, [random_points(5).double().requires_grad_()], eps=1e-7, atol=1e-5)


def test_levels_grow_from_coarsest_to_finest_and_small_ones_are_dense():
    shape = HashGridShape(levels=5, coarsest=4, finest=64, table_size_log2=12)
    assert shape.resolutions == [4, 8, 16, 32, 64]
    assert shape.rows == [64, 512, 4096, 4096, 4096]


def test_every_cell_in_the_cube_has_both_vertices():
    shape = HashGridShape(levels=6, coarsest=3, finest=50)
    stretch = HashGrid(shape).lattice.stretch.tolist()
    assert all(
        along + 0.5 <= resolution - 1 + 1e-4 for along, resolution in zip(stretch, shape.resolutions, strict=True)
    )


def test_the_backend_follows_device_precision_and_what_is_importable(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    on_cuda = SimpleNamespace(dtype=torch.float32, device=torch.device("cuda"), is_cuda=True)
    present = {"triton"}
    monkeypatch.setattr(
        "ebarf_ns.radiance.hash_grid.why_not", lambda name: "" if name in present else f"no {name} on this machine"
    )
    assert fastest_backend(torch.zeros(1, 3)) == "numba"
    assert fastest_backend(torch.zeros(1, 3).double()) == "torch"
    assert fastest_backend(on_cuda) == "triton"  # pyright: ignore[reportArgumentType]
    present.add("tinycudann")
    assert fastest_backend(on_cuda) == "tcnn"  # pyright: ignore[reportArgumentType]
    assert capsys.readouterr().err == ""
    present.clear()
    for _ in range(3):
        assert fastest_backend(on_cuda) == "torch"  # pyright: ignore[reportArgumentType]
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "200 times slower" in said and "no triton on this machine" in said


class StandInEncoding(nn.Module):
    """tiny-cuda-nn's HashGrid from its published formulas: scale, resolution, offsets, index, interpolation."""

    def __init__(self, inputs: int, configuration: dict, dtype: torch.dtype):
        super().__init__()
        assert inputs == 3 and configuration["otype"] == "HashGrid" and dtype == torch.float32
        self.configuration = configuration
        self.params = nn.Parameter(torch.zeros(1))

    def forward(self, point: torch.Tensor) -> torch.Tensor:
        c, offset, encoded = self.configuration, 0, []
        features, largest = c["n_features_per_level"], 1 << c["log2_hashmap_size"]
        for level in range(c["n_levels"]):
            scale = 2.0 ** (level * torch.tensor(c["per_level_scale"]).log2().item()) * c["base_resolution"] - 1
            resolution = int(torch.tensor(scale).ceil()) + 1
            rows = min((resolution**3 + 7) // 8 * 8, largest)
            place = point * scale + 0.5
            low = place.detach().floor()
            total = 0
            for corner in range(8):
                bits = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2])
                weight = torch.where(bits > 0, place - low, 1 - (place - low)).prod(-1, keepdim=True)
                x, y, z = (low.long() + bits).unbind(-1)
                dense = x + y * resolution + z * resolution**2
                index = (dense if resolution**3 <= rows else x ^ y * 2654435761 ^ z * 805459861) % rows
                total = total + weight * self.params.view(-1, features)[offset + index]
            encoded.append(total)
            offset += rows
        assert self.params.numel() == offset * features
        return torch.cat(encoded, -1)


@pytest.mark.parametrize("shape", SHAPES[:2], ids=lambda shape: f"{shape.levels}x{shape.features}")
def test_our_table_works_with_tiny_cuda_nn(shape: HashGridShape, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "tinycudann", SimpleNamespace(Encoding=StandInEncoding))
    monkeypatch.setattr("ebarf_ns.radiance.hash_grid._encodings", {})
    grid = made(shape, "tcnn")
    for ours, theirs in zip(*both(grid, random_points(500)), strict=True):
        assert (ours - theirs).abs().max() < 1e-4 * theirs.abs().max()


def test_triton_kernels_through_the_interpreter():
    if INTERPRETED:
        pytest.skip("this is the run inside")
    pytest.importorskip("triton")
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    words = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", __file__, "-k", "triton"]
    inner = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=600, check=False)
    assert inner.returncode == 0, inner.stdout[-3000:] + inner.stderr[-2000:]
    assert "9 passed" in inner.stdout


@pytest.mark.skipif(INTERPRETED, reason="nothing is compiled where the interpreter runs")
@pytest.mark.parametrize("compute_capability", [80, 90])
def test_triton_kernels_compile_to_machine_code_without_a_gpu(compute_capability: int):
    pytest.importorskip("triton")
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from ebarf_ns.radiance import hash_grid_triton

    integers = {"resolution": "*i64", "first_row": "*i64", "count": "i32"}
    fixed = {"levels": 8, "features": 4, "block": 128}
    for kernel in (hash_grid_triton._forward, hash_grid_triton._backward):
        types = {name: "constexpr" if name in fixed else integers.get(name, "*fp32") for name in kernel.arg_names}
        compiled = triton.compile(ASTSource(kernel, types, fixed), target=GPUTarget("cuda", compute_capability, 32))
        assert len(compiled.asm["cubin"]) > 1000


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: f"{shape.levels}x{shape.features}")
def test_cuda_agrees_with_the_reference(shape: HashGridShape):
    grid = made(shape).cuda()
    assert fastest_backend(random_points(1).cuda()) in ("triton", "tcnn")
    for ours, theirs in zip(*both(grid, random_points(5000).cuda()), strict=True):
        assert (ours - theirs).abs().max() < 1e-4 * theirs.abs().max()
