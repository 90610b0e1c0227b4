import pytest
import torch

from ebarf_ns.photometry.event_loss import normalized_loss, reported_change, target_change, threshold_loss


def batch(count: int, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    events = torch.randint(1, 10, (count,))
    total = (events - 2 * torch.randint(0, 10, (count,)) % (events + 1)).long()
    return torch.randn(count, dtype=dtype), reported_change(total, events, 0.2, 0.3).to(dtype), events


def test_reported_change_counts_each_polarity_with_its_threshold():
    change = reported_change(torch.tensor([3, -2, 0]), torch.tensor([3, 2, 4]), 0.2, 0.3)
    assert torch.allclose(change, torch.tensor([0.6, -0.6, 2 * 0.2 - 2 * 0.3]))


def test_only_cancelling_events_have_a_gradient_to_the_thresholds():
    thresholds = torch.tensor([0.2, 0.3], requires_grad=True)
    polarity_sum, event_count = torch.tensor([3, -2, 0, 1, -2]), torch.tensor([3, 2, 4, 3, 6])
    for one, cancelled in zip(reported_change(polarity_sum, event_count, *thresholds), [0, 0, 2, 1, 2], strict=True):
        (gradient,) = torch.autograd.grad(one, thresholds, retain_graph=True)
        assert gradient.tolist() == [cancelled, -cancelled]


def test_threshold_loss_is_equation_five_in_thresholds():
    change = torch.tensor([0.5, -0.2])
    loss = threshold_loss(change, torch.tensor([0.25, -0.25]), torch.tensor([1, 1]), 0.25)
    assert float(loss) == pytest.approx((1.0 + 0.04) / 2)
    longer = threshold_loss(change, torch.tensor([0.25, -0.25]), torch.tensor([4, 4]), 0.25)
    assert float(longer) == pytest.approx(float(loss) / 4)


def test_silent_pixels_allow_half_of_a_change_within_the_thresholds():
    change = torch.tensor([0.1, 0.5, -0.25, -0.35, 0.1], requires_grad=True)
    silent = torch.tensor([True, True, True, True, False])
    allowed = target_change(change, torch.zeros(5), silent, torch.tensor(0.2), torch.tensor(0.3))
    assert torch.allclose(allowed, torch.tensor([0.05, 0.1, -0.125, -0.15, 0.0]))
    assert not allowed.requires_grad
    reported = torch.tensor([1.0, 1.0], requires_grad=True)
    allowed = target_change(torch.tensor([1.1, 3.0]), reported, torch.tensor([True, False]), 0.2, 0.3)
    assert torch.autograd.grad(allowed.sum(), reported)[0].tolist() == [1.0, 1.0]


def test_render_variance_makes_long_pairs_weigh_little_less_than_short_ones():
    change, reported = torch.tensor([0.5]), torch.tensor([0.25])
    of_one, of_four = (threshold_loss(change, reported, torch.tensor([n]), 0.25, render_variance=5.0) for n in (1, 4))
    assert float(of_one) == pytest.approx(1.0)
    assert float(of_four) == pytest.approx(6 / 9)


def test_pairs_without_events_have_finite_losses_without_render_variance():
    change = torch.tensor([0.0, 0.5], requires_grad=True)
    loss = threshold_loss(change, torch.zeros(2), torch.zeros(2), 0.25, 0.3, render_variance=0.0)
    (gradient,) = torch.autograd.grad(loss, change)
    assert gradient.isfinite().all() and gradient[0] == 0 < gradient[1]


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_normalized_loss_does_not_depend_on_the_threshold(factor: float):
    change, reported, _ = batch(64)
    assert torch.allclose(normalized_loss(factor * change, reported), normalized_loss(change, reported), rtol=1e-4)
    assert torch.allclose(normalized_loss(change, factor * reported), normalized_loss(change, reported))


def test_huber_loss_is_linear_for_outliers_and_quadratic_for_small_errors():
    reported, variance = torch.zeros(3, dtype=torch.float64), torch.tensor([1.0, 1.0, 4.0], dtype=torch.float64)
    change = torch.tensor([0.001, 5.0, 10.0], dtype=torch.float64, requires_grad=True)

    def gradient(huber_delta: float | None) -> torch.Tensor:
        return torch.autograd.grad(threshold_loss(change, reported, variance, 0.25, huber_delta), change)[0]

    plain, robust = gradient(None), gradient(0.3)
    assert robust[0] == pytest.approx(float(plain[0]))
    # Both errors are 20 standard deviations, and act on the gradient like 0.3.
    assert torch.allclose(robust[1:], plain[1:] * 0.3 / 20)
