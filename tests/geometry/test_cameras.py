import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ebarf_ns.geometry.cameras import Camera

CAMERAS = [
    Camera("pinhole", 64, 48, 50, 51, 31, 24),
    Camera("radtan", 240, 180, 335.4, 335.3, 129.9, 99.2, (-0.1386, 0.0934, -0.00034, 0.00017, 0.0)),
    Camera("radtan", 240, 180, 197.3, 197.2, 128.2, 110.9, (-0.3687, 0.1635, 0.00068, -0.0014)),
    Camera("equidistant", 1280, 720, 1049.6, 1049.1, 633.6, 337.4, (-0.034, -0.027, 0.045, -0.024)),
]


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: f"{camera.model}{camera.width}")
def test_every_pixel_projects_back_onto_itself(camera: Camera):
    grid = camera.pixel_grid()
    bearings = camera.bearings(grid)
    assert torch.allclose(bearings.norm(dim=-1), torch.ones(camera.height, camera.width).double(), atol=1e-12)
    assert (camera.project(7 * bearings) - grid).abs().max() < 1e-6


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: f"{camera.model}{camera.width}")
@given(st.tuples(st.floats(-0.4, 0.4), st.floats(-0.3, 0.3), st.floats(0.5, 5)))
def test_projection_agrees_with_opencv(camera: Camera, direction: tuple[float, float, float]):
    x, y, z = direction
    point = np.array([[[x * z, y * z, z]]])
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    if camera.model == "equidistant":
        expected, _ = cv2.fisheye.projectPoints(point, np.zeros(3), np.zeros(3), matrix, np.array(camera.distortion))
    else:
        expected, _ = cv2.projectPoints(
            point, np.zeros(3), np.zeros(3), matrix, np.array(camera.distortion or (0.0,) * 4)
        )
    found = camera.project(torch.from_numpy(point[0, 0]))
    assert np.allclose(found.numpy(), expected.ravel(), atol=1e-6)


def test_pixel_centres_are_at_integers():
    camera = CAMERAS[0]
    assert torch.allclose(camera.bearings(torch.tensor([31.0, 24.0])), torch.tensor([0.0, 0, 1]).double())
