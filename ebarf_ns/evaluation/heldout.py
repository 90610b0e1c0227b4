"""How well a render predicts held-out events."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls


class Prediction(NamedTuple):
    """Agreement of a render with the events of some pairs."""

    unexplained: float
    """Share of the rendered change that events leave unexplained: 0: perfect, 1: nothing explained, NaN: no events."""
    threshold_on: float | None
    """The contrast threshold, in log brightness, with which the events match the render best; None if the pairs cannot
    separate on and off."""
    threshold_off: float | None


def prediction(
    change: Float[np.ndarray, "pairs"],
    polarity_sum: Float[np.ndarray, "pairs"],
    event_count: Float[np.ndarray, "pairs"],
    variance: Float[np.ndarray, "pairs"],
    threshold_ratio: float,
) -> Prediction:
    """min over C >= 0 of sum w (c - C r)² / sum w c², w = 1 / variance, r = sqrt(q) brighter - darker / sqrt(q) events.

    c are the rendered changes of log brightness, and q is ``threshold_ratio``, C_on / C_off of the recording. Only the
    scale of the thresholds is fitted, since events do not determine it. If their ratio were fitted too, it would hide
    a render that wrongly brightens along the camera's path. The returned thresholds are both fitted, for information.
    """
    if not polarity_sum.any():
        return Prediction(float("nan"), None, None)
    weight = 1 / np.sqrt(variance)
    brighter = (event_count + polarity_sum) / 2
    counts = np.stack([brighter, brighter - event_count], axis=1) * weight[:, None]
    seen, told = change * weight, counts @ np.array([threshold_ratio**0.5, threshold_ratio**-0.5])
    scale = max(float(seen @ told), 0.0) / max(float(told @ told), 1e-300)
    # A render without change, or with changes against the events, explains nothing.
    unexplained = float(np.linalg.norm(seen - scale * told) / np.linalg.norm(seen)) ** 2 if scale else 1.0
    (on, off), _ = nnls(counts, seen)
    apart = np.linalg.matrix_rank(counts, tol=1e-6 * np.linalg.norm(counts)) == 2
    return Prediction(unexplained, *((float(on), float(off)) if apart else (None, None)))
