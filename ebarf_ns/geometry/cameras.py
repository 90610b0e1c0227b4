"""The camera models of the datasets: projection and unprojection to bearing vectors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    from jaxtyping import Float

CameraModel = Literal["pinhole", "radtan", "equidistant"]
Crop = tuple[int, int, int, int]
"""(left, top, right, bottom) in pixels; right and bottom are exclusive."""
COEFFICIENTS: dict[str, tuple[int, ...]] = {"pinhole": (0,), "radtan": (4, 5), "equidistant": (4,)}


@dataclass(frozen=True)
class Camera:
    """Intrinsics and distortion; pixel centres are at integer coordinates.

    ``distortion`` is () for ``pinhole``, (k1, k2, p1, p2[, k3]) for ``radtan`` (Brown), (k1, k2, k3, k4) for
    ``equidistant`` (Kannala-Brandt).
    """

    model: CameraModel
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def pixel_grid(self) -> Float[Tensor, "height width 2"]:
        """The coordinates (x, y) of every pixel centre, float64."""
        y, x = torch.meshgrid(torch.arange(self.height), torch.arange(self.width), indexing="ij")
        return torch.stack([x, y], dim=-1).double()

    def bearings(self, pixel: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
        """Unit viewing directions of pixels in the camera's OpenCV frame, float64."""
        distorted = (pixel.double() - self._centre) / self._focal
        if self.model == "equidistant":
            return _equidistant_bearings(distorted, self.distortion)
        plane = _undistort_radtan(distorted, self.distortion) if self.model == "radtan" else distorted
        ray = torch.cat([plane, torch.ones_like(plane[..., :1])], dim=-1)
        return ray / ray.norm(dim=-1, keepdim=True)

    def project(self, point: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """Pixel coordinates of points in the camera frame (z > 0), float64."""
        plane = point.double()[..., :2] / point.double()[..., 2:]
        if self.model == "radtan":
            plane = distort_radtan(plane, self.distortion)
        if self.model == "equidistant":
            radius = plane.norm(dim=-1, keepdim=True).clamp_min(1e-12)
            plane = plane / radius * equidistant_radius(radius.atan(), self.distortion)
        return plane * self._focal + self._centre

    @property
    def _focal(self) -> Float[Tensor, "2"]:
        return torch.tensor([self.fx, self.fy], dtype=torch.float64)

    @property
    def _centre(self) -> Float[Tensor, "2"]:
        return torch.tensor([self.cx, self.cy], dtype=torch.float64)


def cropped(camera: Camera, crop: Crop) -> Camera:
    """The camera of the cropped image."""
    left, top, right, bottom = crop
    return replace(camera, width=right - left, height=bottom - top, cx=camera.cx - left, cy=camera.cy - top)


def distort_radtan(plane: Float[Tensor, "*batch 2"], coefficients: Sequence[Any]) -> Float[Tensor, "*batch 2"]:
    """Apply Brown's model with (k1, k2, p1, p2[, k3]), numbers or tensors, to normalised image coordinates."""
    k1, k2, p1, p2, k3 = (*coefficients, 0.0)[:5]
    x, y = plane.unbind(-1)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return torch.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
        ],
        dim=-1,
    )


def _undistort_radtan(distorted: Tensor, coefficients: tuple[float, ...], iterations: int = 20) -> Tensor:
    """Invert the distortion by Newton's method; the 2x2 Jacobian comes from autograd."""
    plane = distorted.clone()
    for _ in range(iterations):
        with torch.enable_grad():
            point = plane.detach().requires_grad_()
            image = distort_radtan(point, coefficients)
            rows = [torch.autograd.grad(image[..., i].sum(), point, retain_graph=True)[0] for i in range(2)]
        plane = plane - torch.linalg.solve(torch.stack(rows, dim=-2), image.detach() - distorted)
    return plane


def equidistant_radius(angle_rad: Float[Tensor, "*batch"], coefficients: Sequence[Any]) -> Float[Tensor, "*batch"]:
    """Kannala and Brandt's image radius for (k1, k2, k3, k4), numbers or tensors."""
    k1, k2, k3, k4 = coefficients
    a2 = angle_rad * angle_rad
    return angle_rad * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))


def _equidistant_bearings(distorted: Tensor, coefficients: tuple[float, ...], iterations: int = 20) -> Tensor:
    radius = distorted.norm(dim=-1, keepdim=True)
    angle_rad = radius.clone()
    k1, k2, k3, k4 = coefficients
    for _ in range(iterations):
        a2 = angle_rad * angle_rad
        slope = 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)))
        angle_rad = angle_rad - (equidistant_radius(angle_rad, coefficients) - radius) / slope
    direction = distorted / radius.clamp_min(1e-12)
    return torch.cat([direction * angle_rad.sin(), angle_rad.cos()], dim=-1)
