"""Threads by what other programs leave."""

import copy

import numba
import psutil
import pytest
import torch
from nerfstudio.configs.base_config import ViewerConfig

from ebarf_ns.machine import free_threads, use_threads
from ebarf_ns.nerf.method import ebarf
from ebarf_ns.plan import Line


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)
    own = psutil.Process().cpu_times()
    monkeypatch.setattr(psutil.Process, "cpu_times", lambda _: own)


@pytest.mark.parametrize(
    "shares, count", [([0.0, 3.0], 2), ([30.0, 10.0], 2), ([92.0, 5.0], 1), ([100.0, 100.0], 1), ([60.0, 60.0], 1)]
)
def test_a_busy_core_is_left_to_others(monkeypatch: pytest.MonkeyPatch, shares: list[float], count: int):
    monkeypatch.setattr(psutil, "cpu_percent", lambda interval, percpu: shares)
    found = free_threads()
    assert found.value == count and f"{sum(shares) / 100:.1f} of them used" in found.reason


def test_what_the_environment_says_stands(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.setattr(psutil, "cpu_percent", lambda interval, percpu: [100.0, 100.0])
    assert free_threads() == Line("threads", 2, "set by OMP_NUM_THREADS")


def test_torch_and_numba_follow(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.undo()
    before = torch.get_num_threads(), numba.get_num_threads()
    try:
        use_threads(1)
        assert (torch.get_num_threads(), numba.get_num_threads()) == (1, 1)
    finally:
        torch.set_num_threads(before[0])
        numba.set_num_threads(before[1])


@pytest.mark.parametrize("words, host", [([], "127.0.0.1"), (["--viewer.websocket-host", "0.0.0.0"], "0.0.0.0")])
def test_a_viewer_listens_on_loopback_unless_told_otherwise(
    monkeypatch: pytest.MonkeyPatch, words: list[str], host: str
):
    """As ns-viewer does it, whose own default is all addresses."""
    monkeypatch.setattr("sys.argv", ["ns-viewer", "--load-config", "config.yml", *words])
    config = copy.deepcopy(ebarf.config)
    config.viewer = ViewerConfig(websocket_host="0.0.0.0")
    assert config.viewer.websocket_host == host
