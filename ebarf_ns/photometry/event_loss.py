"""What the rendered change of log brightness should have been: the losses of Eq. 5 and Eq. 6."""

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
    """Change of log brightness that the events in a pair report: C_on for each brighter, -C_off for each darker one.

    To the thresholds, the gradient is of events that cancel one another alone: an on and an off event, that brightness
    comes back, tell the ratio of the thresholds. The sum that is left does not: were its events to tell it, contrast
    that renders still lack in bright and in dark places would pass for a ratio.
    """
    cancelled = (event_count - polarity_sum.abs()) / 2
    left = polarity_sum.clamp(min=0) * threshold_on + polarity_sum.clamp(max=0) * threshold_off
    return left.detach() + cancelled * (threshold_on - threshold_off)


def nearest_allowed(
    change: Float[Tensor, "pairs"],
    reported: Float[Tensor, "pairs"],
    silent: Bool[Tensor, "pairs"],
    threshold_on: Tensor | float,
    threshold_off: Tensor | float,
) -> Float[Tensor, "pairs"]:
    """The change that events allow and that is nearest to the rendered one, as a target: no gradient to ``change``.

    A pair that ends with an event changed by what was reported. While its pixel is ``silent`` since, it rose by less
    than C_on beyond that, and fell by less than C_off (the no-event loss of E-NeRF, Klenk et al. 2023). Most likely it
    did not change at all: within those limits an error counts by half, lest fog gather where nothing is reported.
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
    """Eq. 5 in units of the threshold, each pair weighted by one over its variance, for one event 1; 0 for no pairs.

    The errors of the single thresholds add up over the events of a pair, so its variance grows with their number. To
    that comes ``render_variance``, in variances of one event: what renders are wrong by however many events there are.
    So long pairs, which tell brightness at large, weigh little less than short ones. Errors beyond ``huber_delta``
    standard deviations count by their size, no longer by its square (Huber 1964): what a render gets wrong at
    silhouettes must not bend the trajectory. Pairs without any event weigh no more than those of one.
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
    """Eq. 6 for unknown thresholds: both changes scaled to unit length over the batch before they are compared.

    The paper writes the norm per event, where it would leave nothing but the sign; what its implementation computes,
    and what works, is the norm over the batch. Smoothed by delta = 0.001 sqrt(N) C so that the gradient stays below
    2 / delta at zero change. Fewer than two pairs or no net polarity carry no information: 0.
    """
    if len(change) < 2 or not bool(reported.any()):
        return 0 * change.sum()
    delta = 1e-3 * len(change) ** 0.5 * threshold
    unit = change / (change.square().sum() + delta**2).sqrt()
    difference = unit - reported / torch.linalg.vector_norm(reported)
    return difference.square().sum()
