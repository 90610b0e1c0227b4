from typing import Any

import pytest
import torch

from ebarf_ns.nerf.keyframe_adam import KeyframeAdam


def descend(optimizer: torch.optim.Optimizer, rows: torch.Tensor, stiffness: torch.Tensor, steps: int) -> float:
    """Noisy gradients of an ill-conditioned quadratic bowl."""
    generator = torch.Generator().manual_seed(0)
    root = torch.linalg.cholesky(stiffness)
    for _ in range(steps):
        noise = 0.1 * torch.randn(rows.shape, generator=generator) @ root.mT
        rows.grad = rows.detach() @ stiffness + noise
        optimizer.step()
    return float(rows.detach().norm())


def rows_of(value: torch.Tensor) -> torch.Tensor:
    return torch.nn.Parameter(value.clone())


def test_without_stretches_for_rows_of_one_number_it_is_adam():
    start = torch.linspace(-1, 1, 5)[:, None]
    ours, theirs = rows_of(start), rows_of(start)
    one = KeyframeAdam([ours], lr=0.05, betas=(0.9, 0.99), eps=0.0, stretches=False)
    other = torch.optim.Adam([theirs], lr=0.05, betas=(0.9, 0.99), eps=1e-12)
    for optimizer, rows in ((one, ours), (other, theirs)):
        descend(optimizer, rows, torch.eye(1), 50)
    assert torch.allclose(ours, theirs, atol=1e-5)


def test_without_coupling_parameters_are_independent():
    gradients = torch.randn(20, 3, 6, generator=torch.Generator().manual_seed(2))
    rows, alone = rows_of(torch.zeros(3, 6)), rows_of(torch.zeros(18, 1))
    # With eps = 0, since it is a share of the mean over all six.
    one = KeyframeAdam([rows], eps=0.0, coupled=False, stretches=False)
    other = KeyframeAdam([alone], eps=0.0, stretches=False)
    for gradient in gradients:
        rows.grad, alone.grad = gradient, gradient.reshape(18, 1)
        one.step()
        other.step()
    assert torch.allclose(rows.reshape(18, 1), alone, atol=1e-5)


def test_a_soft_direction_is_followed_faster_than_by_adam():
    # The sum of the two is constrained a thousand times better than their difference.
    stiffness = torch.tensor([[1.0, 0.999], [0.999, 1.0]])
    start = torch.tensor([[1.0, -1.0]])
    way = {}
    for kind, make in (("ours", KeyframeAdam), ("adam", torch.optim.Adam)):
        rows = rows_of(start)
        way[kind] = 2**0.5 - descend(make([rows], lr=0.02, betas=(0.9, 0.99)), rows, stiffness, 150)
    assert way["ours"] > 10 * way["adam"]


@pytest.mark.parametrize("count", [40, 41])
def test_a_bend_of_the_trajectory_is_followed_below_the_noise_of_each_row(count: int):
    # The noise of each row's gradient is ten times the bend.
    bend = 0.1 * torch.linspace(-1, 1, count)[:, None].expand(-1, 6)
    gained = {}
    for stretches in (True, False):
        generator = torch.Generator().manual_seed(0)
        rows = rows_of(torch.zeros(count, 6))
        optimizer = KeyframeAdam([rows], lr=0.01, stretches=stretches)
        for _ in range(100):
            rows.grad = bend + torch.randn(rows.shape, generator=generator)
            optimizer.step()
        gained[stretches] = -float((rows.detach() * bend).sum() / bend.square().sum().sqrt())
    assert gained[True] > 3 * gained[False]


@pytest.mark.parametrize("count", [1, 2, 5, 8, 41])
def test_a_common_gradient_moves_all_rows_alike(count: int):
    rows = rows_of(torch.zeros(count, 6))
    optimizer = KeyframeAdam([rows], lr=0.1)
    gradient = torch.randn(1, 6, generator=torch.Generator().manual_seed(3))
    for _ in range(5):
        rows.grad = gradient.expand(count, -1)
        optimizer.step()
    moved = rows.detach()
    assert (moved @ gradient.T < 0).all() and torch.allclose(moved, moved[:1].expand(count, -1), atol=1e-4)


@pytest.mark.parametrize("count", [3, 10])
def test_turning_the_axes_turns_the_path(count: int):
    turn = torch.linalg.qr(torch.randn(6, 6, generator=torch.Generator().manual_seed(1)))[0]
    gradients = torch.randn(20, count, 6, generator=torch.Generator().manual_seed(2))
    plain, turned = rows_of(torch.zeros(count, 6)), rows_of(torch.zeros(count, 6))
    one, other = KeyframeAdam([plain]), KeyframeAdam([turned])
    for gradient in gradients:
        plain.grad, turned.grad = gradient, gradient @ turn
        one.step()
        other.step()
    assert torch.allclose(plain @ turn, turned, atol=1e-4)


@pytest.mark.parametrize(("stretches", "steps", "unmoved"), [(False, 4, [7]), (True, 6, [])])
def test_rows_without_a_gradient_move_with_their_neighbours_alone_and_many_rows_all_move(
    stretches: bool, steps: int, unmoved: list[int]
):
    rows = rows_of(torch.zeros(600, 6))
    optimizer = KeyframeAdam([rows], stretches=stretches)
    rows.grad = torch.randn(600, 6, generator=torch.Generator().manual_seed(0))
    rows.grad[7] = 0
    for _ in range(steps):
        optimizer.step()
    moved = rows.detach().abs().sum(dim=1)
    assert torch.isfinite(rows).all() and torch.nonzero(moved == 0)[:, 0].tolist() == unmoved


@pytest.mark.parametrize("count", [3, 10])
@pytest.mark.parametrize("size", [1e-15, 1e12])
def test_the_size_of_the_loss_does_not_matter(size: float, count: int):
    gradients = torch.randn(20, count, 6, generator=torch.Generator().manual_seed(2))
    ends = []
    for factor in (1.0, size):
        rows = rows_of(torch.zeros(count, 6))
        optimizer = KeyframeAdam([rows])
        for gradient in gradients:
            rows.grad = factor * gradient
            optimizer.step()
        ends.append(rows.detach())
    assert torch.allclose(*ends, atol=1e-4)


@pytest.mark.parametrize("count", [3, 10])
def test_its_state_resumes_exactly(count: int):
    gradients = torch.randn(8, count, 6, generator=torch.Generator().manual_seed(2))
    whole, stopped = rows_of(torch.zeros(count, 6)), rows_of(torch.zeros(count, 6))
    one, other = KeyframeAdam([whole]), KeyframeAdam([stopped])
    for k, gradient in enumerate(gradients):
        whole.grad, stopped.grad = gradient, gradient
        one.step()
        other.step()
        if k == 3:
            state: dict[str, Any] = other.state_dict()
            other = KeyframeAdam([stopped])
            other.load_state_dict(state)
    assert torch.equal(whole, stopped)


@pytest.mark.parametrize("power", [0.5, 0.25])
def test_many_rows_whose_gradients_grow_tenfold_in_every_step_do_not_run_away(power: float):
    """Their inverse roots are computed in turn, and are out of date for ten steps and more."""
    generator = torch.Generator().manual_seed(0)
    few, many = rows_of(torch.zeros(40, 6)), rows_of(torch.zeros(2000, 6))
    furthest = []
    for rows in (few, many):
        optimizer = KeyframeAdam([rows], lr=0.01, power=power)
        for step in range(30):
            rows.grad = 10.0 ** min(step - 10, 5) * torch.randn(rows.shape, generator=generator)
            optimizer.step()
        furthest.append(float(rows.detach().abs().max()))
    assert furthest[1] < 10 * furthest[0] < 10


@pytest.mark.parametrize("coupled", [True, False])
@pytest.mark.parametrize("power", [0.5, 0.25, 0.0])
def test_no_step_of_a_row_with_a_current_root_is_cut_short(
    power: float, coupled: bool, monkeypatch: pytest.MonkeyPatch
):
    ends = []
    for _ in range(2):
        generator = torch.Generator().manual_seed(0)
        rows = rows_of(torch.zeros(30, 6))
        optimizer = KeyframeAdam([rows], power=power, eps=1e-6, coupled=coupled)
        for step in range(60):
            rows.grad = (1 + step % 20) ** 3 * torch.randn(rows.shape, generator=generator).cumsum(dim=-1)
            optimizer.step()
        ends.append(rows.detach().clone())
        monkeypatch.setattr("ebarf_ns.nerf.keyframe_adam._longest", lambda *betas: 1e30)
    assert torch.equal(*ends)
