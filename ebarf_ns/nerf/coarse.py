"""A field too coarse to fit a wrong trajectory with a wrong scene, and its loss on held-out events.

Coarse to fine, as in Lin et al. 2021 (BARF), but measured in pixels: the finest level starts at 16 pixels and ends at
1.5. The field is discarded: fine fields initialised from it stayed 1 to 6 dB worse.
"""

from __future__ import annotations

from copy import deepcopy
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from ebarf_ns.geometry.trajectory import Trajectory
    from ebarf_ns.nerf.datamanager import EventDataManager
    from ebarf_ns.nerf.model import EbarfModel, EbarfModelConfig
    from ebarf_ns.radiance.hash_grid import HashGrid

_FIRST_PX, _LAST_PX = 16.0, 1.5
_RATE, _DECAY = 1e-2, 0.3
_SAMPLES, _DENSITY_CELLS = 8, 48
_MOST_KNOTS = 200
_FEWEST_PAIRS = 20


def coarse_model(model: EbarfModel, mode: Literal["refine", "off"] = "refine") -> EbarfModel:
    """Build a model of the same scene with coarse levels only; all keyframes are refined, or none.

    Clock and intrinsics are initialised from ``model``.
    """
    config: EbarfModelConfig = deepcopy(model.config)
    assert config.grid_finest and config.grid_levels and config.density_cells
    config.grid_finest = max(round(config.grid_finest / _LAST_PX), config.grid_coarsest + 2)
    config.grid_levels = max(config.grid_levels - 1, 2)
    config.samples, config.density_cells = _SAMPLES, min(config.density_cells, _DENSITY_CELLS)
    config.time_constant_us = config.time_constant_us or 0.0
    knots = config.camera_optimizer
    knots.mode, knots.prior, knots.every = mode, 0.0, 1
    knots.keyframe_stride = max(1, len(model.camera_optimizer.keyframe_t_us) // _MOST_KNOTS)
    with torch.random.fork_rng():
        coarse = config.setup(
            scene_box=model.scene_box, num_train_data=model.num_train_data, metadata=model.kwargs["metadata"]
        )
    coarse.camera_optimizer.shift_clock(int(model.camera_optimizer.clock_offset_us))
    if coarse.intrinsics and model.intrinsics:
        coarse.intrinsics.load_state_dict(model.intrinsics.state_dict())
    return coarse.to(model.device).train()


class CoarseTraining:
    """Trains a coarse model and, optionally, its poses."""

    def __init__(self, coarse: EbarfModel, datamanager: EventDataManager, steps: int, seed: int):
        self.coarse, self.datamanager, self.steps, self.seed = coarse, datamanager, steps, seed
        fields = coarse.get_param_groups()["fields"]
        self.field = torch.optim.Adam(fields, lr=_RATE, betas=(0.9, 0.99), eps=1e-15, fused=True)
        self.grid = coarse.renderer.field.grid

    def step(self, step: int, poses: torch.optim.Optimizer | None = None) -> bool:
        """Step the field and ``poses``; returns False without a step if a value is not finite."""
        done = step / self.steps
        self.grid.level_shares = _shares(self.grid, _LAST_PX / between(_FIRST_PX, _LAST_PX, done))
        set_rate(self.field, _RATE * _DECAY**done)
        self.coarse.begin_step(step, self.seed)
        rays, batch = self.datamanager.next_train(step)
        losses = self.coarse.get_loss_dict(self.coarse(rays), batch)
        loss = torch.stack([*losses.values()]).sum()
        optimizers = [self.field, poses] if poses else [self.field]
        for optimizer in optimizers:
            optimizer.zero_grad()
        loss.backward()
        moving = [one.grad for group in poses.param_groups for one in group["params"]] if poses else []
        if not all(one is not None and bool(one.isfinite().all()) for one in [loss.detach(), *moving]):
            return False
        for optimizer in optimizers:
            optimizer.step()
        return True


def heldout_losses(coarse: EbarfModel, training: CoarseTraining) -> Float[np.ndarray, "blocks"] | None:
    """Train a coarse model with fixed poses, and return its mean loss on held-out pairs per time block.

    NaN for blocks with few pairs; None if a value is not finite.
    """
    if not all(training.step(step) for step in range(training.steps)):
        return None
    rays, batch = training.datamanager.next_eval(0)
    block = training.datamanager.heldout_blocks.number(rays.metadata["event_t_us"].cpu().numpy()[len(rays) // 2 :, 0])
    with torch.no_grad():
        outputs = coarse.eval()(rays)
    before, after = outputs["brightness"][:, 0].chunk(2)
    losses = np.full(block.max() + 1, np.nan)
    for k in np.unique(block):
        inside = torch.from_numpy(block == k).to(before.device)
        if int(inside.sum()) >= _FEWEST_PAIRS:
            one = {"brightness": torch.cat([before[inside], after[inside]])[:, None], "sensor": outputs["sensor"]}
            pairs = {name: column[inside] for name, column in batch.items()}
            losses[k] = float(coarse.get_loss_dict(one, pairs)["event_loss"])
    return losses if np.isfinite(losses).any() else None


def losses_from_trajectory(
    model: EbarfModel,
    datamanager: EventDataManager,
    steps: int,
    seed: int,
    trajectory: Trajectory,
    given_camera: bool = False,
) -> Float[np.ndarray, "blocks"] | None:
    """:func:`heldout_losses` of a coarse field trained on a trajectory, with the learned or the given intrinsics."""
    coarse = coarse_model(model, "off")
    keyframes = coarse.camera_optimizer
    keyframes.begin_from(trajectory.poses)
    keyframes.shift_clock(int(trajectory.t_us[0] - keyframes.keyframe_t_us[0]))
    if coarse.intrinsics and given_camera:
        torch.nn.init.zeros_(coarse.intrinsics.correction)
    return heldout_losses(coarse, CoarseTraining(coarse, datamanager, steps, seed))


def gain(worse: Float[np.ndarray, "blocks"], better: Float[np.ndarray, "blocks"]) -> float:
    """Number of standard deviations, over blocks, by which the second losses are lower."""
    difference = worse - better
    known = difference[np.isfinite(difference)]
    if len(known) < 3:
        return 0.0
    return float(known.mean() / max(known.std(ddof=1) / len(known) ** 0.5, 1e-12))


def between(first: float, last: float, done: float) -> float:
    """Geometric interpolation from the first to the last value."""
    return first * (last / first) ** done


def set_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of all parameter groups."""
    for group in optimizer.param_groups:
        group["lr"] = rate


def _shares(grid: HashGrid, of_finest: float) -> Float[Tensor, "levels"]:
    """Level weights: 1 up to a share of the finest resolution, 0 one level further; the coarsest is always 1."""
    resolution = torch.tensor(grid.shape.resolutions).float()
    level = (resolution / resolution[0]).log() / (resolution[1] / resolution[0]).log()
    last = (of_finest * resolution[-1] / resolution[0]).log() / (resolution[1] / resolution[0]).log()
    return (last - level + 1).clamp(0, 1).maximum(torch.eye(len(level))[0]).to(grid.table.device)
