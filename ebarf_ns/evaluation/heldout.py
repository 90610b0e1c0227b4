"""How well a render predicts the events that it was not trained on."""

import numpy as np
from jaxtyping import Float


def unexplained_share(
    change: Float[np.ndarray, "pairs"], reported: Float[np.ndarray, "pairs"], variance: Float[np.ndarray, "pairs"]
) -> float:
    """Share of the reported brightness changes that the rendered ones leave unexplained: 0 is perfect, 1 is nothing.

    min over a of sum w (r - a c)² / sum w r², w = 1 / variance (of a pair, its number of events): one gain is fitted,
    since events leave the scale of log brightness open where the threshold is unknown, so that the number compares
    methods and sensors.
    """
    weight = 1 / variance
    total = float((weight * reported**2).sum())
    if total == 0:
        return float("nan")
    energy = float((weight * change**2).sum())
    shared = float((weight * change * reported).sum())
    # A render that moves against the events explains nothing of them.
    return 1 - max(shared, 0.0) ** 2 / (energy * total) if energy > 0 else 1.0


def implied_thresholds(
    change: Float[np.ndarray, "pairs"],
    polarity_sum: Float[np.ndarray, "pairs"],
    event_count: Float[np.ndarray, "pairs"],
) -> tuple[float | None, float | None]:
    """The contrast thresholds, on and off, in log brightness, by which the events say what the render shows.

    Least squares of change ~ on * (brighter events) - off * (darker events), each pair weighted by one over its
    events. None for both where the pairs cannot tell them apart.
    """
    weight = 1 / np.sqrt(event_count)
    brighter = (event_count + polarity_sum) / 2
    counts = np.stack([brighter, brighter - event_count], axis=1) * weight[:, None]
    (on, off), _, rank, _ = np.linalg.lstsq(counts, change * weight, rcond=1e-6)
    return (float(on), float(off)) if rank == 2 else (None, None)
