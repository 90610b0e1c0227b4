import math

import torch

from ebarf_ns.photometry.brightness import log_brightness


def test_lin_log_is_equation_two():
    intensity = torch.tensor([10.0, 19.999, 20.001, 200.0]) / 255
    expected = torch.tensor([10 * math.log(20) / 20, 19.999 * math.log(20) / 20, math.log(20.001), math.log(200)])
    assert torch.allclose(log_brightness(intensity, "lin_log"), expected, atol=1e-5)
