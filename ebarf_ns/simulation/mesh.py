"""A textured mesh from a file, placed in a room."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

from ebarf_ns.errors import SimulationError
from ebarf_ns.simulation.room import Room

_BLACK = 0.02


@dataclass(frozen=True)
class RoomWithMesh:
    """A mesh of any format that Open3D reads, scaled to ``size_m`` and centred at ``middle``."""

    room: Room
    path: Path
    size_m: float
    middle: tuple[float, float, float]

    def cast(
        self, origin: Float[np.ndarray, "rays 3"], direction: Float[np.ndarray, "rays 3"]
    ) -> tuple[Float[np.ndarray, "rays"], Float[np.ndarray, "rays"]]:
        """Radiance and distance [m] along unit directions; raises :class:`SimulationError` for unusable files."""
        from open3d import core

        radiance, distance = self.room.cast(origin, direction)
        hits = self._caster.cast_rays(core.Tensor.from_numpy(np.hstack([origin, direction]).astype(np.float32)))
        found = hits["t_hit"].numpy().astype(float)
        (nearer,) = np.nonzero(found < distance)
        triangle, uv = hits["primitive_ids"].numpy()[nearer], hits["primitive_uvs"].numpy()[nearer]
        share = np.stack([1 - uv.sum(axis=1), uv[:, 0], uv[:, 1]], axis=1)
        distance[nearer] = found[nearer]
        radiance[nearer] = _BLACK + self._reflected(triangle, share)
        return radiance, distance

    def _reflected(self, triangle: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Linear grey value from the vertex colours or the texture."""
        corners, texture = self._colours
        value = np.einsum("nk,nkc->nc", share, corners[triangle])
        if texture is None:
            return value[:, 0]
        height, width = texture.shape
        # Texture coordinates wrap around, with the origin at the lower left.
        x, y = (value % 1).T
        return map_coordinates(texture, [(1 - y) * (height - 1), x * (width - 1)], order=1)

    @cached_property
    def _caster(self) -> Any:
        from open3d import core, t

        vertex = self._mesh.vertex.positions.numpy().astype(float)
        lowest, highest = vertex.min(axis=0), vertex.max(axis=0)
        scale = self.size_m / max((highest - lowest).max(), 1e-30)
        placed = (vertex - (lowest + highest) / 2) * scale + np.asarray(self.middle)
        caster = t.geometry.RaycastingScene()
        triangles = self._mesh.triangle.indices.numpy().astype(np.uint32)
        caster.add_triangles(core.Tensor.from_numpy(placed.astype(np.float32)), core.Tensor.from_numpy(triangles))
        return caster

    @cached_property
    def _mesh(self) -> Any:
        from open3d import t, utility

        if not self.path.is_file():
            raise SimulationError(f"{self.path}: no such file, expected a mesh")
        try:
            with utility.VerbosityContextManager(utility.VerbosityLevel.Error):
                mesh = t.io.read_triangle_mesh(str(self.path))
            triangles = len(mesh.triangle.indices)
        except (IndexError, KeyError):
            # Open3D raises these for files without triangles or vertices.
            triangles = 0
        if not triangles:
            raise SimulationError(f"{self.path}: holds no triangles, expected a mesh of a format that Open3D reads")
        return mesh

    @cached_property
    def _colours(self) -> tuple[np.ndarray, np.ndarray | None]:
        """Grey value per triangle corner and None, or texture coordinates per corner and the texture."""
        mesh = self._mesh
        if "texture_uvs" in mesh.triangle and "albedo" in mesh.material.texture_maps:
            return mesh.triangle.texture_uvs.numpy(), _linear(mesh.material.texture_maps["albedo"].as_tensor().numpy())
        if "colors" in mesh.vertex:
            grey = _linear(mesh.vertex.colors.numpy()[None])[0]
            return grey[mesh.triangle.indices.numpy()][..., None], None
        raise SimulationError(f"{self.path}: has neither texture nor vertex colours, expected a textured mesh")


def _linear(srgb: np.ndarray) -> np.ndarray:
    grey = srgb[..., :3].astype(np.float32).mean(axis=-1)
    return (grey / 255 if srgb.dtype == np.uint8 else grey) ** np.float32(2.2)
