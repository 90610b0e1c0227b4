"""Rendered intensity to log brightness, with finite values and gradients for every intensity from 0 up."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

BrightnessKind = Literal["lin_log", "log"]
LIN_LOG_KNEE = 20.0
_EIGHT_BIT = 255.0
_DARKEST = 1e-3


def lin_log(intensity: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Eq. 2 with B = 20 on 255 times the intensity: linear below the knee, logarithmic above.

    Its slope is 255 ln(20)/20 below the knee, and at most 255/20 above.
    """
    value = intensity * _EIGHT_BIT
    linear = value < LIN_LOG_KNEE
    safe = torch.where(linear, torch.full_like(value, LIN_LOG_KNEE), value)
    return torch.where(linear, value * (math.log(LIN_LOG_KNEE) / LIN_LOG_KNEE), safe.log())


def log_brightness(intensity: Float[Tensor, "*batch"], kind: BrightnessKind) -> Float[Tensor, "*batch"]:
    """Log brightness of an intensity; ``log`` is ln(intensity + 0.001), with slope at most 1000."""
    return lin_log(intensity) if kind == "lin_log" else (intensity + _DARKEST).log()
