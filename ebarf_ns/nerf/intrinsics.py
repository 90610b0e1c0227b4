"""Learned intrinsics: focal length, principal point, and two radial distortion coefficients."""

from __future__ import annotations

from dataclasses import replace
from math import exp
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from ebarf_ns.geometry.cameras import distort_radtan, equidistant_radius

if TYPE_CHECKING:
    from jaxtyping import Float, Int64

    from ebarf_ns.geometry.cameras import Camera

_NEWTON_STEPS = 2


class Intrinsics(nn.Module):
    """A learned correction to a camera's intrinsics, initially zero, in pixels at an image corner.

    The ratio of the focal lengths is fixed. The first two radial distortion coefficients are learned if the camera
    model has any.
    """

    def __init__(self, camera: Camera):
        super().__init__()
        self.camera = camera
        bearing = camera.bearings(camera.pixel_grid()).flatten(0, 1)
        if camera.model == "equidistant":
            sine = bearing[:, :2].norm(dim=-1, keepdim=True)
            lens = bearing[:, :2] / sine.clamp_min(1e-12) * torch.atan2(sine, bearing[:, 2:])
        else:
            lens = bearing[:, :2] / bearing[:, 2:]
        self.corner_px = max(camera.width, camera.height) / 2
        # Scale each coefficient so that 1 moves a corner by one pixel.
        reach = self.corner_px / camera.fx
        radial = [1 / (camera.fx * reach**power) for power in (3, 5)] if camera.distortion else []
        tables = {
            "lens": lens,
            "inverse_slope": torch.linalg.inv(_slope(camera, lens)),
            "pixel": camera.pixel_grid().flatten(0, 1),
            "unit": torch.tensor([1 / self.corner_px, 1.0, 1.0, *radial]),
        }
        for name, table in tables.items():
            self.register_buffer(name, table.float(), persistent=False)
        self.lens: Tensor
        self.inverse_slope: Tensor
        self.pixel: Tensor
        self.unit: Tensor
        self.correction = nn.Parameter(torch.zeros(1, len(self.unit)))

    def bearings(self, number: Int64[Tensor, "rays"]) -> Float[Tensor, "rays 3"]:
        """Unit ray directions in the camera frame, for pixels given by row-major index.

        Newton's method, with starting points and fixed Jacobians from the given intrinsics.
        """
        camera, change = self.camera, (self.unit * self.correction)[0]
        centre = change.new_tensor([camera.cx, camera.cy]) + change[1:3]
        focal = change.new_tensor([camera.fx, camera.fy]) * change[0].exp()
        goal = (self.pixel[number] - centre) / focal
        lens, inverse_slope = self.lens[number], self.inverse_slope[number]
        for _ in range(_NEWTON_STEPS):
            missed = goal - _distort(camera, lens, change[3:])
            lens = lens + (inverse_slope @ missed[:, :, None])[:, :, 0]
        if camera.model == "equidistant":
            squared = lens.square().sum(dim=-1, keepdim=True)
            # sin(a) / a, whose gradient is finite at 0.
            angle = squared.clamp_min(1e-12).sqrt()
            return torch.cat([lens * (angle.sin() / angle), angle.cos()], dim=-1)
        return torch.nn.functional.normalize(torch.cat([lens, torch.ones_like(lens[:, :1])], dim=-1), dim=-1)

    def refined(self) -> Camera:
        """The camera with the corrections learned so far."""
        change = (self.unit * self.correction.detach())[0].double().tolist()
        camera, stretch, radial = self.camera, exp(change[0]), change[3:]
        distortion = [given + more for given, more in zip(camera.distortion, radial, strict=False)]
        return replace(
            camera,
            fx=camera.fx * stretch,
            fy=camera.fy * stretch,
            cx=camera.cx + change[1],
            cy=camera.cy + change[2],
            distortion=(*distortion, *camera.distortion[len(radial) :]),
        )


def _distort(camera: Camera, lens: Float[Tensor, "rays 2"], radial: Float[Tensor, "n"]) -> Float[Tensor, "rays 2"]:
    changes = [*radial, *[0.0] * len(camera.distortion)]
    coefficients = [given + change for given, change in zip(camera.distortion, changes, strict=False)]
    if camera.model == "radtan":
        return distort_radtan(lens, coefficients)
    if camera.model == "equidistant":
        angle = lens.square().sum(dim=-1, keepdim=True).clamp_min(1e-12).sqrt()
        return lens * (equidistant_radius(angle, coefficients) / angle)
    return lens


def _slope(camera: Camera, lens: Float[Tensor, "rays 2"]) -> Float[Tensor, "rays 2 2"]:
    point = lens.detach().requires_grad_()
    image = _distort(camera, point, lens.new_zeros(0))
    rows = [torch.autograd.grad(image[:, i].sum(), point, retain_graph=True)[0] for i in range(2)]
    return torch.stack(rows, dim=-2)
