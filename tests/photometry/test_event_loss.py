import pytest
import torch

from ebarf_ns.photometry.event_loss import normalized_loss, reported_change, threshold_loss

DTYPES = (torch.float32, torch.float64)


def batch(count: int, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    events = torch.randint(1, 10, (count,))
    total = (events - 2 * torch.randint(0, 10, (count,)) % (events + 1)).long()
    return torch.randn(count, dtype=dtype), reported_change(total, events, 0.2, 0.3).to(dtype), events


def test_reported_change_counts_each_polarity_with_its_threshold():
    change = reported_change(torch.tensor([3, -2, 0]), torch.tensor([3, 2, 4]), 0.2, 0.3)
    assert torch.allclose(change, torch.tensor([0.6, -0.6, 2 * 0.2 - 2 * 0.3]))


def test_threshold_loss_is_equation_five_in_thresholds():
    change = torch.tensor([0.5, -0.2])
    loss = threshold_loss(change, torch.tensor([0.25, -0.25]), torch.tensor([1, 1]), 0.25)
    assert float(loss) == pytest.approx((1.0 + 0.04) / 2)
    longer = threshold_loss(change, torch.tensor([0.25, -0.25]), torch.tensor([4, 4]), 0.25)
    assert float(longer) == pytest.approx(float(loss) / 4)


@pytest.mark.parametrize("dtype", DTYPES)
def test_losses_do_not_care_which_end_comes_first(dtype: torch.dtype):
    change, reported, events = batch(50, dtype)
    assert torch.allclose(
        threshold_loss(-change, -reported, events, 0.25), threshold_loss(change, reported, events, 0.25)
    )
    assert torch.allclose(normalized_loss(-change, -reported), normalized_loss(change, reported))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-10, 1e-6, 1.0, 1e6])
def test_normalized_loss_has_a_bounded_gradient_at_any_size(dtype: torch.dtype, size: float):
    change, reported, _ = batch(64, dtype)
    change = (size * change).requires_grad_()
    loss = normalized_loss(change, reported)
    (gradient,) = torch.autograd.grad(loss, change)
    delta = 1e-3 * 64**0.5 * 0.25
    assert torch.isfinite(loss) and torch.isfinite(gradient).all() and gradient.norm() <= 4 / delta


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_normalized_loss_does_not_know_the_threshold(factor: float):
    change, reported, _ = batch(64)
    assert torch.allclose(normalized_loss(factor * change, reported), normalized_loss(change, reported), rtol=1e-4)
    assert torch.allclose(normalized_loss(change, factor * reported), normalized_loss(change, reported))


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_pairs_move_nothing(count: int):
    change = torch.randn(count, requires_grad=True)
    for loss in (
        normalized_loss(change, torch.ones(count)),
        threshold_loss(change, torch.ones(count), torch.ones(count, dtype=torch.long), 0.25) if count == 0 else None,
    ):
        if loss is not None:
            (gradient,) = torch.autograd.grad(loss, change)
            assert loss == 0 and (gradient == 0).all()


def test_cancelling_polarities_carry_no_direction():
    change = torch.randn(8, requires_grad=True)
    loss = normalized_loss(change, torch.zeros(8))
    (gradient,) = torch.autograd.grad(loss, change)
    assert loss == 0 and (gradient == 0).all()


def test_all_polarities_equal_is_fine():
    change = torch.full((8,), 0.3, requires_grad=True)
    loss = normalized_loss(change, torch.ones(8))
    assert float(loss) == pytest.approx(0, abs=1e-4)
