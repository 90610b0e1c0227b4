from dataclasses import replace

import pytest
import torch

from ebarf_ns.geometry.cameras import Camera
from ebarf_ns.nerf.intrinsics import Intrinsics

CAMERAS = {
    "pinhole": Camera("pinhole", 32, 24, 30.0, 31.0, 15.0, 12.5),
    "radtan": Camera("radtan", 32, 24, 30.0, 31.0, 15.0, 12.5, (-0.3, 0.1, 1e-3, -1e-3)),
    "equidistant": Camera("equidistant", 32, 24, 12.0, 12.5, 15.0, 12.5, (0.05, -0.01, 0.0, 0.0)),
}
EVERY_PIXEL = torch.arange(32 * 24)


@pytest.mark.parametrize("model", CAMERAS)
def test_initial_intrinsics_are_the_given_ones(model: str):
    camera = CAMERAS[model]
    fresh = Intrinsics(camera)
    given = camera.bearings(camera.pixel_grid()).flatten(0, 1).float()
    assert torch.allclose(fresh.bearings(EVERY_PIXEL), given, atol=1e-6)
    assert fresh.refined() == camera


@pytest.mark.parametrize("model", CAMERAS)
def test_the_refined_camera_has_the_bearings_that_are_trained_on(model: str):
    learned = Intrinsics(CAMERAS[model])
    with torch.no_grad():
        learned.correction.copy_(torch.tensor([[0.8, -0.5, 0.4, 0.3, -0.2]])[:, : learned.correction.shape[1]])
    refined = learned.refined()
    assert refined.fx > 1.02 * CAMERAS[model].fx and refined.fx / refined.fy == pytest.approx(
        CAMERAS[model].fx / CAMERAS[model].fy
    )
    expected = refined.bearings(refined.pixel_grid()).flatten(0, 1).float()
    assert (learned.bearings(EVERY_PIXEL) - expected).norm(dim=-1).max() < 0.02 / refined.fx


@pytest.mark.parametrize("model", CAMERAS)
def test_a_wrong_camera_is_learned_back_from_the_bearings_of_the_true_one(model: str):
    true = CAMERAS[model]
    first = [1.3 * true.distortion[0]] if true.distortion else []
    wrong = replace(true, fx=1.05 * true.fx, fy=1.05 * true.fy, cx=true.cx + 1)
    wrong = replace(wrong, distortion=(*first, *true.distortion[1:]))
    learned = Intrinsics(wrong)
    goal = true.bearings(true.pixel_grid()).flatten(0, 1).float()
    optimizer = torch.optim.LBFGS(learned.parameters(), max_iter=100, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimizer.zero_grad()
        error = (learned.bearings(EVERY_PIXEL) - goal).mul(100).square().sum()
        error.backward()
        return error

    optimizer.step(loss)  # pyright: ignore[reportArgumentType]
    assert learned.refined().fx == pytest.approx(true.fx, rel=3e-3)
    assert learned.refined().cx == pytest.approx(true.cx, abs=0.05)
    if true.distortion:
        assert learned.refined().distortion[0] == pytest.approx(true.distortion[0], rel=0.05, abs=0.01)


def test_gradients_are_finite_in_the_centre_of_a_fisheye():
    camera = replace(CAMERAS["equidistant"], cx=15.0, cy=12.0)
    learned = Intrinsics(camera)
    learned.bearings(torch.tensor([12 * 32 + 15])).sum().backward()
    assert learned.correction.grad is not None and bool(learned.correction.grad.isfinite().all())
