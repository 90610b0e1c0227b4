"""Brightness and losses from black to blinding: cases 16 to 21."""

import math

import numpy as np
import pytest
import torch

from ebarf_ns.events.indexing import index_pairs
from ebarf_ns.events.recording import Recording
from ebarf_ns.photometry.brightness import LIN_LOG_KNEE, log_brightness
from ebarf_ns.photometry.event_loss import normalized_loss, reported_change, threshold_loss

F32, F64 = torch.float32, torch.float64
STEEPEST = {"lin_log": 255 * math.log(20) / 20, "log": 1000.0}
DELTA = 1e-3 * 64**0.5 * 0.25
STEEPEST_LOSS = 4 / DELTA
SCALE_FREE = 1e-5
ANTISYMMETRY = 1e-6
HOT_SHARE = 0.05
DTYPES = pytest.mark.parametrize("dtype", [F32, F64], ids=["float32", "float64"])
KINDS = pytest.mark.parametrize("kind", ["lin_log", "log"])


def batch(dtype: torch.dtype, count: int = 64) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rendered change, polarity sums, numbers of events, reported change."""
    random = torch.Generator().manual_seed(0)
    events = torch.randint(1, 10, (count,), generator=random)
    brighter = (torch.rand(count, generator=random) * (events + 1)).long()
    polarity = 2 * brighter - events
    change = torch.randn(count, generator=random, dtype=F64).to(dtype)
    return change, polarity, events, reported_change(polarity, events, 0.2, 0.3).to(dtype)


@DTYPES
@KINDS
def test_case_16_brightness_is_finite_rising_and_of_bounded_slope(dtype: torch.dtype, kind: str):
    knee = LIN_LOG_KNEE / 255
    around = [math.nextafter(knee, 0), knee, math.nextafter(knee, 1)] if dtype is F64 else [knee * 0.9999999, knee]
    values = [0.0, 1e-45, 1e-30, 1e-8, *around, 1.0, 1e4, 1e36]
    intensity = torch.tensor(values, dtype=dtype, requires_grad=True)
    brightness = log_brightness(intensity, kind)  # pyright: ignore[reportArgumentType]
    (slope,) = torch.autograd.grad(brightness.sum(), intensity)
    assert torch.isfinite(brightness).all() and (brightness.diff() >= -1e-6).all()
    assert torch.isfinite(slope).all() and (slope >= 0).all() and slope[0] > 0
    assert slope.max() <= STEEPEST[kind] * 1.0001


@DTYPES
@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-10, 1e-6, 1.0, 1e6])
def test_case_17_the_normalised_loss_is_smooth_at_any_size(dtype: torch.dtype, size: float):
    direction, _, _, reported = batch(dtype)
    change = (size * direction / direction.norm()).requires_grad_()
    loss = normalized_loss(change, reported)
    (gradient,) = torch.autograd.grad(loss, change)
    assert torch.isfinite(loss) and torch.isfinite(gradient).all() and gradient.norm() <= STEEPEST_LOSS
    if size == 0:
        assert float(loss.detach()) == pytest.approx(1.0, abs=1e-6)


@DTYPES
@pytest.mark.parametrize("factor", [0.1, 0.5, 3.0, 10.0])
def test_case_17_the_normalised_loss_does_not_know_the_scale(dtype: torch.dtype, factor: float):
    change, _, _, reported = batch(dtype)
    change = change / change.norm() * 10_000 * DELTA
    here, there = normalized_loss(change, reported), normalized_loss(factor * change, reported)
    assert float(there) == pytest.approx(float(here), rel=SCALE_FREE)


@DTYPES
@KINDS
def test_case_18_which_end_comes_first_does_not_matter(dtype: torch.dtype, kind: str):
    first, second = torch.rand(2, 64, dtype=dtype, generator=torch.Generator().manual_seed(3))
    _, polarity, events, _ = batch(dtype)
    forth, back = (
        log_brightness(b, kind) - log_brightness(a, kind)  # pyright: ignore[reportArgumentType]
        for a, b in ((first, second), (second, first))
    )
    assert torch.equal(forth, -back) and forth.abs().min() > 0
    # Played backwards, an event that said brighter says darker.
    reported, reverse = (reported_change(sign * polarity, events, 0.25, 0.25).to(dtype) for sign in (1, -1))
    for one, other in (
        (threshold_loss(forth, reported, events, 0.25), threshold_loss(back, reverse, events, 0.25)),
        (normalized_loss(forth, reported), normalized_loss(back, reverse)),
    ):
        assert float(one) == pytest.approx(float(other), rel=ANTISYMMETRY)


@DTYPES
def test_case_19_batches_without_information_change_nothing(dtype: torch.dtype):
    for count in (0, 1):
        change = torch.ones(count, dtype=dtype, requires_grad=True)
        loss = normalized_loss(change, torch.ones(count, dtype=dtype))
        (gradient,) = torch.autograd.grad(loss, change)
        assert loss == 0 and (gradient == 0).all()
    empty = torch.zeros(0, dtype=dtype, requires_grad=True)
    assert threshold_loss(empty, empty.detach(), torch.zeros(0, dtype=torch.long), 0.25) == 0
    cancelling = torch.randn(8, dtype=dtype, requires_grad=True)
    loss = normalized_loss(cancelling, torch.zeros(8, dtype=dtype))
    (gradient,) = torch.autograd.grad(loss, cancelling)
    assert loss == 0 and (gradient == 0).all()
    alike = torch.full((8,), 0.3, dtype=dtype, requires_grad=True)
    loss = normalized_loss(alike, torch.ones(8, dtype=dtype))
    (gradient,) = torch.autograd.grad(loss, alike)
    assert float(loss) < 1e-4 and torch.isfinite(gradient).all()


def test_case_20_a_hot_pixel_with_a_million_events_has_no_more_than_its_share_of_a_batch():
    random = np.random.default_rng(0)
    pixels, each, hot = 100 * 80, 200, 1_000_000
    count = pixels * each
    pixel = np.r_[np.repeat(np.arange(pixels), each), np.full(hot, 17)]
    t_us = np.sort(random.integers(0, 1_000_000, count + hot))
    pixel = pixel[random.permutation(len(pixel))]
    polarity = random.choice(np.array([-1, 1], np.int8), len(pixel))
    recording = Recording((pixel % 100).astype(np.uint16), (pixel // 100).astype(np.uint16), t_us, polarity)
    index = index_pairs(lambda: [recording], 100, 80)
    drawn = index.draw_accepted(20_000, 30, random, lambda pairs: np.ones(len(pairs), bool))
    assert (drawn.pixel == 17).mean() <= HOT_SHARE


@DTYPES
@pytest.mark.parametrize("span_us", [1, 10_000_000])
def test_case_21_pairs_of_any_length_have_finite_losses(dtype: torch.dtype, span_us: int):
    t_us = np.array([0, span_us], np.int64)
    zeros = np.zeros(2, np.uint16)
    recording = Recording(zeros, zeros, t_us, np.array([1, 1], np.int8))
    pairs = index_pairs(lambda: [recording], 1, 1).draw(np.full(4, 30), np.random.default_rng(0))
    assert (pairs.t1_us - pairs.t0_us == span_us).all() and (pairs.event_count == 1).all()
    reported = reported_change(
        torch.from_numpy(pairs.polarity_sum), torch.from_numpy(pairs.event_count), 0.25, 0.25
    ).to(dtype)
    change = torch.zeros(4, dtype=dtype, requires_grad=True)
    for loss in (threshold_loss(change, reported, torch.ones(4).long(), 0.25), normalized_loss(change, reported)):
        (gradient,) = torch.autograd.grad(loss, change)
        assert torch.isfinite(loss) and torch.isfinite(gradient).all()
