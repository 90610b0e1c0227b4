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
) -> Prediction:
    """min over on, off >= 0 of sum w (c - r)² / sum w c², w = 1 / variance, r = on * brighter - off * darker events.

    Both thresholds are fitted, since events leave their scale open and nominal ones are seldom those in force, so that
    the number compares methods and sensors. c are the rendered changes of log brightness.
    """
    if not polarity_sum.any():
        return Prediction(float("nan"), None, None)
    weight = 1 / np.sqrt(variance)
    brighter = (event_count + polarity_sum) / 2
    counts = np.stack([brighter, brighter - event_count], axis=1) * weight[:, None]
    (on, off), left = nnls(counts, change * weight)
    apart = np.linalg.matrix_rank(counts, tol=1e-6 * np.linalg.norm(counts)) == 2
    # A render that shows no change, or moves against the events, explains nothing of them.
    unexplained = float(left / np.linalg.norm(change * weight)) ** 2 if on or off else 1.0
    return Prediction(unexplained, *((float(on), float(off)) if apart else (None, None)))
