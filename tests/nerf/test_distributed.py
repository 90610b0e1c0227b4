"""Two processes train one model through nerfstudio's own DDP, here over gloo."""

import os
import socket
from collections.abc import Iterator
from datetime import timedelta
from itertools import count
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed
from nerfstudio.pipelines import base_pipeline
from nerfstudio.utils import comms
from torch.multiprocessing.spawn import spawn
from torch.nn.parallel import DistributedDataParallel

from ebarf_ns.nerf import trainer
from tests.nerf.test_training import config

COMPARED = 8


class OnCpu(DistributedDataParallel):
    """Nerfstudio names the GPU of each process, of which a CPU has none."""

    def __init__(self, model: torch.nn.Module, device_ids: list[int], **rest: Any):
        super().__init__(model, **rest)


def gradients(ready: Any) -> dict[str, torch.Tensor]:
    """Of the first step, before any update."""
    ready.pipeline.train()
    _, losses, _ = ready.pipeline.get_train_loss_dict(0)
    losses["event_loss"].backward()
    return {name: p.grad.clone() for name, p in ready.pipeline.model.named_parameters() if p.grad is not None}


def train_in(rank: int, scene: Path, folder: Path, port: int) -> None:
    """One of the two processes."""
    os.environ["MASTER_ADDR"], os.environ["MASTER_PORT"] = "127.0.0.1", str(port)
    torch.set_num_threads(1)
    torch.distributed.init_process_group("gloo", rank=rank, world_size=2, timeout=timedelta(seconds=120))
    comms.LOCAL_PROCESS_GROUP = torch.distributed.group.WORLD
    base_pipeline.DDP = OnCpu  # pyright: ignore[reportAttributeAccessIssue, reportPrivateImportUsage]
    barrier = torch.distributed.barrier
    torch.distributed.barrier = lambda **_: barrier()  # pyright: ignore[reportAttributeAccessIssue]
    made = config(scene, folder, steps=10**6)
    made.max_train_seconds = 0.8
    torch.manual_seed(rank)
    ready = made.setup(local_rank=rank, world_size=2)
    ready.setup()
    first = gradients(ready)
    ready.pipeline.zero_grad()
    # By clocks that go apart, 20 and 40 ms a step: the budget must not end earlier for one than for the other.
    readings = count()
    trainer.monotonic = lambda: 0.02 * (1 + rank) * next(readings)
    ready.train()
    batches = [ready.pipeline.datamanager._draw_training_pairs(2 * step + rank).t1_us for step in range(COMPARED)]
    torch.save(
        {
            "gradients": first,
            "parameters": {n: p.detach() for n, p in ready.pipeline.model.named_parameters()},
            "batches": batches,
            "seconds": ready.train_seconds,
            "steps": ready.steps_done,
        },
        folder / f"rank-{rank}.pt",
    )
    torch.distributed.destroy_process_group()


@pytest.fixture(scope="module")
def ranks(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    folder = tmp_path_factory.mktemp("distributed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    spawn(train_in, (tiny_scene, folder, port), nprocs=2)
    assert (folder / "x" / "ebarf" / "run" / "report" / "report.html").is_file()
    return [torch.load(folder / f"rank-{rank}.pt", weights_only=False) for rank in range(2)]


def test_batches_differ_and_gradients_agree(ranks: list[dict[str, Any]]):
    one, two = ranks
    for a, b in zip(one["batches"], two["batches"], strict=True):
        assert not (a == b).all()
    assert one["gradients"].keys() == two["gradients"].keys() and "camera_optimizer.correction" in one["gradients"]
    for name, gradient in one["gradients"].items():
        # The clock is learned only where it was off.
        assert gradient.abs().sum() > 0 or name == "camera_optimizer.clock_px"
        assert torch.equal(gradient, two["gradients"][name])


def test_both_processes_end_with_one_model_after_their_budget(ranks: list[dict[str, Any]]):
    one, two = ranks
    assert one["seconds"] == two["seconds"] >= 0.8
    assert one["steps"] == two["steps"] > 3
    for name, parameter in one["parameters"].items():
        assert torch.equal(parameter, two["parameters"][name]), name


@pytest.fixture
def one_thread() -> Iterator[None]:
    """As each process has: more of them round sums otherwise, on some processors by a hundredth of what is left."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.usefixtures("one_thread")
def test_the_gradient_is_the_mean_of_both_batches(ranks: list[dict[str, Any]], tiny_scene: Path, tmp_path: Path):
    alone = []
    for rank in range(2):
        torch.manual_seed(0)
        ready = config(tiny_scene, tmp_path / str(rank), steps=COMPARED).setup(local_rank=0, world_size=1)
        ready.setup()
        manager = ready.pipeline.datamanager
        manager.world_size, manager.rank, ready.pipeline.world_size = 2, rank, 2
        renderer = ready.pipeline.model.renderer
        ready.pipeline.model.begin_step(0, 0)
        remembered, refresh = renderer.density_grid.density.clone(), renderer.begin_step

        def begin_step(step: int, random: torch.Generator, refresh=refresh, renderer=renderer, first=remembered):
            # What the first process remembers of densities goes for both.
            refresh(step, random)
            renderer.density_grid.density.copy_(first)

        renderer.density_grid.density.fill_(1.0)
        renderer.begin_step = begin_step
        alone.append(gradients(ready))
    for name, gradient in ranks[0]["gradients"].items():
        mean = (alone[0][name] + alone[1][name]) / 2
        assert (gradient - mean).abs().max() <= 1e-4 * mean.abs().max(), name
