import pytest
import torch

from ebarf_ns.radiance.field import BroadBrightness, RadianceField, contract
from ebarf_ns.radiance.lattice import HashGridShape

SHAPE = HashGridShape(levels=4, features=2, coarsest=4, finest=32, table_size_log2=10)


def test_contraction_keeps_the_inside_and_squeezes_the_rest():
    inside = torch.rand(100, 3) * 2 - 1
    assert torch.equal(contract(inside), inside)
    far = contract(torch.tensor([[1e9, 0, 0], [0, -3.0, 1.5]]))
    assert far.abs().max() <= 2 and torch.allclose(far[0], torch.tensor([2.0, 0, 0]))
    point = torch.tensor([[0.0, 0, 0], [1, 1, 1], [50, 2, 3]], requires_grad=True)
    (gradient,) = torch.autograd.grad(contract(point).sum(), point)
    assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("bounded", [True, False])
@pytest.mark.parametrize("view_dependent", [True, False])
@pytest.mark.parametrize("intensity_range", ["unit", "positive"])
def test_density_and_intensity_are_in_range(bounded: bool, view_dependent: bool, intensity_range: str):
    torch.manual_seed(0)
    field = RadianceField(SHAPE, bounded, view_dependent, intensity_range)  # pyright: ignore[reportArgumentType]
    torch.nn.init.normal_(field.grid.table)
    point = (torch.rand(20_000, 3) * 4 - 2).requires_grad_()
    direction = torch.nn.functional.normalize(torch.randn(20_000, 3), dim=-1)
    density, intensity = field(point, direction if view_dependent else None)
    assert density.shape == intensity.shape == (20_000,)
    assert (density > 0).all() and (intensity > 0).all()
    assert intensity_range == "positive" or (intensity < 1).all()
    (gradient,) = torch.autograd.grad(density.sum() + intensity.sum(), point)
    assert torch.isfinite(gradient).all() and gradient.abs().sum() > 0
    turned, _ = field(point, -direction if view_dependent else None)
    assert torch.equal(turned, density)


def test_view_dependence_changes_only_intensity():
    torch.manual_seed(0)
    field = RadianceField(SHAPE, bounded=True, view_dependent=True)
    point = torch.rand(10, 3)
    axes = torch.eye(3)
    assert not torch.equal(field(point, axes[:1].expand(10, 3))[1], field(point, axes[1:2].expand(10, 3))[1])


def test_huge_raw_density_stays_finite():
    field = RadianceField(SHAPE, bounded=True)
    with torch.no_grad():
        field.trunk[-1].bias[0] = 500.0  # pyright: ignore[reportIndexIssue]
    density, _ = field(torch.rand(10, 3), None)
    assert torch.isfinite(density).all()


def test_bfloat16_changes_values_and_gradients_little():
    torch.manual_seed(0)
    field = RadianceField(SHAPE, bounded=True)
    torch.nn.init.normal_(field.grid.table)
    point = (torch.rand(20_000, 3) * 2 - 1).requires_grad_()
    found = {}
    for precision in ("float32", "bfloat16"):
        field.precision = precision
        density, intensity = field(point, None)
        assert density.dtype == intensity.dtype == torch.float32
        (gradient,) = torch.autograd.grad((density + intensity).sum(), point)
        found[precision] = density.log(), intensity.log(), gradient
    # Eight bits of mantissa, through four products and, for gradients, four more.
    for exact, rounded, tolerance in zip(*found.values(), (0.02, 0.02, 0.05), strict=True):
        assert not torch.equal(exact, rounded)
        assert (exact - rounded).norm() < tolerance * exact.norm()


def test_chunks_give_the_same_result_as_the_whole(monkeypatch: pytest.MonkeyPatch):
    torch.manual_seed(0)
    field = RadianceField(SHAPE, bounded=True, view_dependent=True)
    point, direction = torch.rand(1000, 3), torch.nn.functional.normalize(torch.randn(1000, 3), dim=-1)
    whole = field(point, direction)
    monkeypatch.setattr("ebarf_ns.radiance.field._CHUNK", 300)
    for one, other in zip(whole, field(point, direction), strict=True):
        assert torch.allclose(one, other, atol=1e-6)


@pytest.mark.parametrize("cells", [1, 2, 3, 16])
def test_each_low_frequency_lattice_contributes_between_its_nodes(cells: int):
    torch.manual_seed(0)
    broad, point = BroadBrightness(cells), torch.rand(1000, 3, requires_grad=True)
    lattices = [*broad.coarser, broad.finest.table]
    assert broad(point).abs().max() < 1e-3, "all begin with next to nothing"
    for lattice in lattices:
        for each in lattices:
            torch.nn.init.zeros_(each)
        torch.nn.init.ones_(lattice)
        assert torch.allclose(broad(point), torch.ones(1000))
    broad(point).sum().backward()
    assert point.grad is None and all(lattice.grad is not None for lattice in lattices)


def test_low_frequency_brightness_does_not_affect_density():
    field, point = RadianceField(SHAPE, bounded=False, broad_cells=4), torch.randn(100, 3)
    density, intensity = field(point, None)
    assert field.broad is not None
    torch.nn.init.constant_(field.broad.coarser[0], 0.5)
    brighter_density, brighter = field(point, None)
    assert torch.equal(density, brighter_density)
    assert torch.allclose(brighter.log() - intensity.log(), torch.full((100,), 0.5), atol=1e-3)
