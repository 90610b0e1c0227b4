"""The event losses (Eq. 5 and Eq. 6) and their targets for the change of log brightness."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_SILENT_SHARE = 0.5


def reported_change(
    polarity_sum: Float[Tensor, "pairs"],
    event_count: Float[Tensor, "pairs"],
    threshold_on: Tensor | float,
    threshold_off: Tensor | float,
) -> Float[Tensor, "pairs"]:
    """Change of log brightness that the events in a pair report: C_on per ON event, -C_off per OFF event.

    Only cancelling events (an ON and an OFF event, as brightness returns) have a gradient to the thresholds, since they
    determine the threshold ratio. The net sum has none: otherwise, contrast that renders still lack in bright and dark
    regions would be mistaken for a threshold ratio.
    """
    cancelled = (event_count - polarity_sum.abs()) / 2
    net = polarity_sum.clamp(min=0) * threshold_on + polarity_sum.clamp(max=0) * threshold_off
    return net.detach() + cancelled * (threshold_on - threshold_off)


def target_change(
    change: Float[Tensor, "pairs"],
    reported: Float[Tensor, "pairs"],
    silent: Bool[Tensor, "pairs"],
    threshold_on: Tensor | float,
    threshold_off: Tensor | float,
) -> Float[Tensor, "pairs"]:
    """Target for the rendered change, clamped to what the events allow; no gradient to ``change``.

    A pair that ends at an event changed by what was reported. At a ``silent`` pixel, brightness has since risen by less
    than C_on and fallen by less than C_off (the no-event loss of E-NeRF, Klenk et al. 2023). Most likely it did not
    change at all: errors within those limits count half, so that no fog builds up in regions without events.
    """
    most, least = (torch.as_tensor(threshold).detach().to(change) for threshold in (threshold_on, threshold_off))
    return reported + _SILENT_SHARE * silent * (change - reported).detach().clamp(-least, most)


def threshold_loss(
    change: Float[Tensor, "pairs"],
    reported: Float[Tensor, "pairs"],
    variance: Float[Tensor, "pairs"],
    threshold: float,
    huber_delta: float | None = None,
    render_variance: float = 0.0,
) -> Float[Tensor, ""]:
    """Eq. 5 in units of the threshold, each pair weighted by its inverse variance (1 for one event); 0 for no pairs.

    Threshold errors add up over the events of a pair, so its variance grows with their number. ``render_variance``, in
    units of one event's variance, adds the render error, which is independent of that number. Long pairs, which
    constrain low-frequency brightness, then weigh little less than short ones. Errors beyond ``huber_delta`` standard
    deviations count linearly (Huber 1964), so that render errors at silhouettes do not distort the trajectory. Pairs
    without events weigh no more than those with one.
    """
    deviations = ((render_variance + variance).clamp_min(1) / (render_variance + 1)).sqrt()
    error = (change - reported) / (threshold * deviations)
    if huber_delta is None:
        cost = error * error
    else:
        cost = 2 * torch.nn.functional.huber_loss(error, torch.zeros_like(error), reduction="none", delta=huber_delta)
    return cost.sum() / max(len(change), 1)


def normalized_loss(
    change: Float[Tensor, "pairs"], reported: Float[Tensor, "pairs"], threshold: float = 0.25
) -> Float[Tensor, ""]:
    """Eq. 6 for unknown thresholds: both changes are normalised to unit length over the batch and compared.

    The paper writes the norm per event, which would leave only the sign; its implementation, and what works, uses the
    norm over the batch. It is smoothed by delta = 0.001 sqrt(N) C, so that the gradient stays below 2 / delta at zero
    change. Fewer than two pairs or no net polarity carry no information and give 0.
    """
    if len(change) < 2 or not bool(reported.any()):
        return 0 * change.sum()
    delta = 1e-3 * len(change) ** 0.5 * threshold
    unit = change / (change.square().sum() + delta**2).sqrt()
    difference = unit - reported / torch.linalg.vector_norm(reported)
    return difference.square().sum()
