import math

import pytest
import torch

from ebarf_ns.photometry.brightness import LIN_LOG_KNEE, log_brightness

KINDS = ("lin_log", "log")
STEEPEST = {"lin_log": 255 * math.log(20) / 20, "log": 1000.0}
KNEE = LIN_LOG_KNEE / 255


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_finite_monotone_with_bounded_slope_from_black_to_blinding(kind: str, dtype: torch.dtype):
    values = [0.0, 1e-45, 1e-30, 1e-8, KNEE * (1 - 1e-6), KNEE, KNEE * (1 + 1e-6), 1.0, 1e4, 1e36]
    intensity = torch.tensor(values, dtype=dtype, requires_grad=True)
    brightness = log_brightness(intensity, kind)  # pyright: ignore[reportArgumentType]
    (slope,) = torch.autograd.grad(brightness.sum(), intensity)
    assert torch.isfinite(brightness).all() and (brightness.diff() >= 0).all()
    assert torch.isfinite(slope).all() and (slope >= 0).all()
    assert slope.max() <= STEEPEST[kind] * 1.0001 and slope[0] > 0


def test_lin_log_is_equation_two():
    intensity = torch.tensor([10.0, 19.999, 20.001, 200.0]) / 255
    expected = torch.tensor([10 * math.log(20) / 20, 19.999 * math.log(20) / 20, math.log(20.001), math.log(200)])
    assert torch.allclose(log_brightness(intensity, "lin_log"), expected, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_swapping_the_two_ends_flips_the_change(kind: str):
    a, b = torch.rand(10), torch.rand(10)
    forth = log_brightness(b, kind) - log_brightness(a, kind)  # pyright: ignore[reportArgumentType]
    back = log_brightness(a, kind) - log_brightness(b, kind)  # pyright: ignore[reportArgumentType]
    assert torch.equal(forth, -back) and forth.abs().max() > 0
