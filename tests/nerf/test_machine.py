"""Threads by what other programs leave."""

import numba
import psutil
import pytest
import torch

from ebarf_ns.nerf.machine import Threads, free_threads, use_threads


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)


@pytest.mark.parametrize(
    "shares, count", [([0.0, 3.0], 2), ([30.0, 10.0], 2), ([90.0, 5.0], 1), ([100.0, 100.0], 1), ([60.0, 60.0], 1)]
)
def test_a_busy_core_is_left_to_others(monkeypatch: pytest.MonkeyPatch, shares: list[float], count: int):
    monkeypatch.setattr(psutil, "cpu_percent", lambda interval, percpu: shares)
    found = free_threads()
    assert found.count == count and f"{sum(shares) / 100:.1f} of them busy" in found.reason


def test_what_the_environment_says_stands(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.setattr(psutil, "cpu_percent", lambda interval, percpu: [100.0, 100.0])
    assert free_threads() == Threads(2, "OMP_NUM_THREADS says so")


def test_torch_and_numba_follow(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.undo()
    before = torch.get_num_threads(), numba.get_num_threads()
    try:
        use_threads(1)
        assert (torch.get_num_threads(), numba.get_num_threads()) == (1, 1)
    finally:
        torch.set_num_threads(before[0])
        numba.set_num_threads(before[1])
