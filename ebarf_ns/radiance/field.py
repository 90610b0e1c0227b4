"""The radiance field: position (and, where the scene needs it, direction) to density and one-channel intensity."""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ebarf_ns.radiance.hash_grid import HashGrid, HashGridShape

IntensityRange = Literal["unit", "positive"]
# Points per pass through the MLPs: their activations stay in a core's cache.
_CHUNK = 8192
_MAX_LOG_DENSITY = 12.0


def contract(point: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Squeeze all of space into the cube [-2, 2]³, leaving [-1, 1]³ as it is (mip-NeRF 360, with the maximum norm)."""
    size = point.abs().amax(dim=-1, keepdim=True)
    outside = size.clamp_min(1)
    return torch.where(size > 1, (2 - 1 / outside) * (point / outside), point)


def _harmonics(direction: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 8"]:
    """Real spherical harmonics of degree 1 and 2, without their constant factors."""
    x, y, z = direction.unbind(-1)
    return torch.stack([x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1], dim=-1)


class RadianceField(nn.Module):
    """Hash grid, a density MLP and an intensity head.

    ``bounded``: the scene lies in [-1, 1]³; else space is contracted. ``intensity_range``: ``unit`` is a sigmoid
    (the reference implementation's), ``positive`` an exponential, for scenes of any dynamic range.
    """

    def __init__(
        self,
        shape: HashGridShape,
        bounded: bool,
        view_dependent: bool = False,
        intensity_range: IntensityRange = "positive",
        hidden: int = 64,
        density_bias: float = 0.0,
    ):
        super().__init__()
        self.bounded = bounded
        self.view_dependent = view_dependent
        self.intensity_range = intensity_range
        self.density_bias = density_bias
        self.grid = HashGrid(shape)
        self.trunk = nn.Sequential(nn.Linear(self.grid.width, hidden), nn.ReLU(), nn.Linear(hidden, 16))
        inputs = 15 + (8 if view_dependent else 0)
        self.head = nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, 1))

    def reset(self) -> None:
        """Forget everything learned."""
        self.grid.reset()
        for module in (*self.trunk, *self.head):
            if isinstance(module, nn.Linear):
                module.reset_parameters()

    def _unit_cube(self, point: Float[Tensor, "points 3"]) -> Float[Tensor, "points 3"]:
        return (point + 1) / 2 if self.bounded else (contract(point) + 2) / 4

    def _activate_density(self, raw: Float[Tensor, "points"]) -> Float[Tensor, "points"]:
        return (raw + self.density_bias).clamp(max=_MAX_LOG_DENSITY).exp()

    def density_in_unit_cube(self, point: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """Volume density per unit of length, at points of the grid's own unit cube."""
        features = self.grid(point)
        return torch.cat([self._activate_density(self.trunk(chunk)[:, 0]) for chunk in features.split(_CHUNK)])

    def forward(
        self, point: Float[Tensor, "points 3"], direction: Float[Tensor, "points 3"] | None
    ) -> tuple[Float[Tensor, "points"], Float[Tensor, "points"]]:
        """Density and intensity; ``direction`` (unit vectors) is needed only when ``view_dependent``."""
        features = self.grid(self._unit_cube(point))
        densities, intensities = [], []
        for start in range(0, len(features), _CHUNK):
            trunk = self.trunk(features[start : start + _CHUNK])
            inputs = trunk[:, 1:]
            if self.view_dependent:
                assert direction is not None
                inputs = torch.cat([inputs, _harmonics(direction[start : start + _CHUNK])], dim=-1)
            densities.append(self._activate_density(trunk[:, 0]))
            intensities.append(self._activate_intensity(self.head(inputs)[:, 0]))
        return torch.cat(densities), torch.cat(intensities)

    def _activate_intensity(self, raw: Float[Tensor, "points"]) -> Float[Tensor, "points"]:
        if self.intensity_range == "unit":
            return raw.sigmoid()
        return raw.clamp(-10, 10).exp()
