"""How well a render predicts the events that it was not trained on."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls


class Prediction(NamedTuple):
    """How a render and the events of some pairs go together."""

    unexplained: float
    """Share of one that the other leaves unexplained: 0 is perfect, 1 is nothing, NaN where nothing was reported."""
    threshold_on: float | None
    """The contrast threshold, in log brightness, by which the events say what the render shows; None where the pairs
    cannot tell on and off apart."""
    threshold_off: float | None


def prediction(
    change: Float[np.ndarray, "pairs"],
    polarity_sum: Float[np.ndarray, "pairs"],
    event_count: Float[np.ndarray, "pairs"],
    variance: Float[np.ndarray, "pairs"],
    threshold_ratio: float,
) -> Prediction:
    """min over C >= 0 of sum w (c - C r)² / sum w c², w = 1 / variance, r = sqrt(q) brighter - darker / sqrt(q) events.

    c are the rendered changes of log brightness and q is ``threshold_ratio``, C_on / C_off as the recording has it.
    Only the thresholds' scale is fitted, as events leave it open. Were their ratio fitted too, a render that brightens
    all along the camera's way would explain what it has itself made up. The thresholds returned are both fitted, to be
    looked at.
    """
    if not polarity_sum.any():
        return Prediction(float("nan"), None, None)
    weight = 1 / np.sqrt(variance)
    brighter = (event_count + polarity_sum) / 2
    counts = np.stack([brighter, brighter - event_count], axis=1) * weight[:, None]
    seen, told = change * weight, counts @ np.array([threshold_ratio**0.5, threshold_ratio**-0.5])
    scale = max(float(seen @ told), 0.0) / max(float(told @ told), 1e-300)
    # A render that shows no change, or moves against the events, explains nothing of them.
    unexplained = float(np.linalg.norm(seen - scale * told) / np.linalg.norm(seen)) ** 2 if scale else 1.0
    (on, off), _ = nnls(counts, seen)
    apart = np.linalg.matrix_rank(counts, tol=1e-6 * np.linalg.norm(counts)) == 2
    return Prediction(unexplained, *((float(on), float(off)) if apart else (None, None)))
