"""The radiance field: position and, optionally, direction to density and one-channel intensity."""

from __future__ import annotations

from math import ceil, log2
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.functional import interpolate

from ebarf_ns.radiance.hash_grid import HashGrid
from ebarf_ns.radiance.lattice import HashGridShape

if TYPE_CHECKING:
    from jaxtyping import Float

IntensityRange = Literal["unit", "positive"]
Precision = Literal["float32", "bfloat16"]
# Points per pass through the MLPs on a CPU: their activations stay in cache.
_CHUNK = 16384
_HIDDEN = 64
_MAX_LOG_DENSITY = 12.0


def fastest_precision(device: torch.device | str) -> Precision:
    """bfloat16 if the processor supports it natively, else float32."""
    if torch.device(device).type == "cuda":
        # Before torch 2.5, is_bf16_supported raises without a GPU.
        return "bfloat16" if torch.cuda.is_available() and torch.cuda.is_bf16_supported() else "float32"
    # Before torch 2.11, get_capabilities does not exist.
    able = getattr(torch.cpu, "get_capabilities", dict)()
    return "bfloat16" if able.get("avx512_bf16") or able.get("amx_bf16") else "float32"


def contract(point: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Contract all of space into [-2, 2]³, leaving [-1, 1]³ unchanged (mip-NeRF 360, with the maximum norm)."""
    size = point.abs().amax(dim=-1, keepdim=True)
    outside = size.clamp_min(1)
    return torch.where(size > 1, (2 - 1 / outside) * (point / outside), point)


def _harmonics(direction: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 8"]:
    """Real spherical harmonics of degree 1 and 2, without their constant factors."""
    x, y, z = direction.unbind(-1)
    return torch.stack([x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1], dim=-1)


class BroadBrightness(nn.Module):
    """Low-frequency log brightness: the sum of lattices with ``cells``, half as many, ... and 2 cells per side.

    An event constrains a local gradient; a gradient across a room is the sum of thousands, and each loss term only
    changes its own place. Parameters with large support let the optimizer correct such sums directly (the multilevel
    preconditioner of Bramble, Pasciak & Xu 1990); hash grid and MLP learn them last.
    """

    def __init__(self, cells: int):
        super().__init__()
        side = cells + 1
        self.finest = HashGrid(HashGridShape(1, 1, side, side, ceil(log2(side**3))))
        coarser = [(1 << power) + 1 for power in range(1, ceil(log2(cells)))]
        self.coarser = nn.ParameterList(nn.Parameter(torch.zeros(1, 1, *[nodes] * 3)) for nodes in coarser)

    def forward(self, point: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """Term added to the raw intensity at points in the unit cube; no gradient to the points."""
        side, rows = self.finest.shape.coarsest, self.finest.table
        finest, beyond = rows.split([side**3, len(rows) - side**3])
        total, *finer = *self.coarser, finest.view(1, 1, side, side, side)
        for lattice in finer:
            total = interpolate(total, lattice.shape[2:], mode="trilinear", align_corners=True) + lattice
        table = torch.cat([total.view(-1, 1), beyond])
        return functional_call(self.finest, {"table": table}, (point.detach(),))[:, 0]


class RadianceField(nn.Module):
    """Hash grid, density MLP and intensity head; with ``broad_cells``, also lattices for low-frequency brightness.

    ``bounded``: the scene lies in [-1, 1]³; else space is contracted. ``intensity_range``: ``unit`` is a sigmoid
    (as in the reference implementation), ``positive`` an exponential, for scenes of any dynamic range. ``precision``
    applies to the MLPs' inputs, weights and outputs; parameters, sums and everything else are float32.
    """

    def __init__(
        self,
        shape: HashGridShape,
        bounded: bool,
        view_dependent: bool = False,
        intensity_range: IntensityRange = "positive",
        precision: Precision = "float32",
        broad_cells: int = 0,
    ):
        super().__init__()
        self.bounded = bounded
        self.view_dependent = view_dependent
        self.intensity_range = intensity_range
        self.precision = precision
        self.grid = HashGrid(shape)
        self.broad = BroadBrightness(broad_cells) if broad_cells else None
        self.trunk = nn.Sequential(nn.Linear(shape.width, _HIDDEN), nn.ReLU(), nn.Linear(_HIDDEN, 16))
        inputs = 15 + (8 if view_dependent else 0)
        self.head = nn.Sequential(nn.Linear(inputs, _HIDDEN), nn.ReLU(), nn.Linear(_HIDDEN, 1))

    def _unit_cube(self, point: Float[Tensor, "points 3"]) -> Float[Tensor, "points 3"]:
        return (point + 1) / 2 if self.bounded else (contract(point) + 2) / 4

    def _activate_density(self, raw: Float[Tensor, "points"]) -> Float[Tensor, "points"]:
        return raw.clamp(max=_MAX_LOG_DENSITY).exp()

    def _half(self, device: torch.device) -> torch.autocast:
        return torch.autocast(device.type, torch.bfloat16, enabled=self.precision == "bfloat16")

    def density_in_unit_cube(self, point: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """Volume density per unit length at points in the grid's unit cube."""
        with self._half(point.device):
            raw = torch.cat([self.trunk(chunk)[:, 0] for chunk in _chunks(self.grid(point))])
        return self._activate_density(raw.to(point.dtype))

    def forward(
        self, point: Float[Tensor, "points 3"], direction: Float[Tensor, "points 3"] | None
    ) -> tuple[Float[Tensor, "points"], Float[Tensor, "points"]]:
        """Density and intensity; ``direction`` (unit vectors) is needed only when ``view_dependent``."""
        # Split, do not slice: the gradient of a slice allocates a full array of zeros.
        point = self._unit_cube(point)
        chunks = _chunks(self.grid(point))
        view = [None] * len(chunks)
        if self.view_dependent:
            assert direction is not None
            view = _chunks(_harmonics(direction))
        densities, intensities = [], []
        with self._half(point.device):
            for features, harmonics in zip(chunks, view, strict=True):
                density, inputs = self.trunk(features).split([1, 15], dim=-1)
                inputs = inputs if harmonics is None else torch.cat([inputs, harmonics.to(inputs)], dim=-1)
                densities.append(density)
                intensities.append(self.head(inputs))
        density, intensity = (torch.cat(raw)[:, 0].to(point.dtype) for raw in (densities, intensities))
        if self.broad:
            intensity = intensity + self.broad(point)
        return self._activate_density(density), self._activate_intensity(intensity)

    def _activate_intensity(self, raw: Float[Tensor, "points"]) -> Float[Tensor, "points"]:
        if self.intensity_range == "unit":
            return raw.sigmoid()
        return raw.clamp(-10, 10).exp()


def _chunks(rows: Tensor) -> tuple[Tensor, ...]:
    return rows.split(_CHUNK) if rows.device.type == "cpu" else (rows,)
