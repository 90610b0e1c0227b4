"""Before training: large errors of the trajectory, found by a field too coarse to lock them in.

A fine field explains a drifted trajectory by a scene of its own, and then holds the keyframes where they are. A coarse
one cannot (coarse to fine, as in Lin et al. 2021, BARF): its finest level begins at 16 pixels and ends at 1.5. What it
has found is measured as motion of the image. Where that is little, the trajectory was good, and is left alone: the
coarse field's own errors, a pixel along directions that events hardly tell, would be all that it gets.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from time import monotonic
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ebarf_ns.geometry.so3 import rotate
from ebarf_ns.nerf.keyframe_adam import KeyframeAdam
from ebarf_ns.radiance.ray_sampling import Rays

if TYPE_CHECKING:
    from jaxtyping import Float
    from nerfstudio.cameras.rays import RayBundle

    from ebarf_ns.nerf.datamanager import EventDataManager
    from ebarf_ns.nerf.model import EbarfModel, EbarfModelConfig
    from ebarf_ns.radiance.hash_grid import HashGrid

# Both runs that drifted by 12 pixels (5 degrees) came back with these.
_FIRST_PX, _LAST_PX = 16.0, 1.5
_FIRST_RATE, _LAST_RATE = 0.4, 0.05
_FIELD_RATE, _FIELD_DECAY = 1e-2, 0.3
_SAMPLES, _DENSITY_CELLS = 8, 48
_MOST_KNOTS = 200
# Odometry errs by degrees rather than by pixels of translation. What moves the image alike is told apart by this, and
# by what leaving the trajectory costs a squared pixel: without them, rotation and shift grow together, in opposition.
_TRANSLATION_PX, _COST = 0.3, 1e-4
_PROBE, _CERTAINLY_GOOD_PX, _GOOD_PX = 200, 1.0, 1.8
_BATCHES_TO_MEASURE = 2
_WARM_UP = 5


@dataclass(frozen=True)
class Alignment:
    """What the coarse field found."""

    moved_px: float
    """Root mean square motion of the image at events, less what moves the whole scene along."""
    taken: bool
    """Whether training begins from the keyframes found."""
    steps: int
    seconds: float

    def __str__(self) -> str:
        if self.taken:
            return f"the trajectory is off by {self.moved_px:.1f} px: training begins where a coarse field puts it"
        return f"the trajectory is off by {self.moved_px:.1f} px or less: training begins from it as it is"


def align(
    model: EbarfModel, datamanager: EventDataManager, steps: int, seed: int, most_seconds: float | None = None
) -> Alignment | None:
    """Move the keyframes that ``model`` begins from to where a coarse field puts them, if that is far.

    None, and nothing moved, if that would take more than ``most_seconds`` or ends in numbers that are not finite.
    """
    started = monotonic()
    coarse = _coarse_model(model)
    keyframes, grid = coarse.camera_optimizer, coarse.renderer.field.grid
    parameters = coarse.get_param_groups()
    field = torch.optim.Adam(parameters["fields"], lr=_FIELD_RATE, betas=(0.9, 0.99), eps=1e-15, fused=True)
    poses = KeyframeAdam(parameters["camera_opt"], lr=_FIRST_RATE, power=0.25)
    moved_px, warm = 0.0, started
    for step in range(steps):
        done = step / steps
        grid.level_shares = _shares(grid, _LAST_PX / _between(_FIRST_PX, _LAST_PX, done))
        _set_rate(poses, _between(_FIRST_RATE, _LAST_RATE, done))
        _set_rate(field, _between(_FIELD_RATE, _FIELD_DECAY * _FIELD_RATE, done))
        coarse.begin_step(step, seed)
        rays, batch = datamanager.next_train(step)
        losses = coarse.get_loss_dict(coarse(rays), batch)
        loss = torch.stack([*losses.values()]).sum() + _COST * keyframes.correction.square().sum(dim=-1).mean()
        if not bool(loss.detach().isfinite()):
            return None
        for optimizer in (field, poses):
            optimizer.zero_grad()
        loss.backward()
        gradient = keyframes.correction.grad
        if gradient is None or not bool(gradient.isfinite().all()):
            return None
        for optimizer in (field, poses):
            optimizer.step()
        if step == _WARM_UP:
            warm = monotonic()
        elif most_seconds and step == 5 * _WARM_UP and (monotonic() - warm) / (4 * _WARM_UP) * steps > most_seconds:
            return None
        if step + 1 in (_PROBE, steps):
            moved_px = _moved_px(coarse, [datamanager.next_train(step + k)[0] for k in range(_BATCHES_TO_MEASURE)])
            if not moved_px < float("inf"):
                return None
            if moved_px < _CERTAINLY_GOOD_PX:
                break
    taken = moved_px >= _GOOD_PX
    if taken:
        model.camera_optimizer.begin_from(keyframes.trajectory().poses)
    return Alignment(round(moved_px, 3), taken, step + 1, round(monotonic() - started, 3))


def _coarse_model(model: EbarfModel) -> EbarfModel:
    """A model of the same scene that sees no more than its coarse levels, and all of whose keyframes move."""
    config: EbarfModelConfig = deepcopy(model.config)
    assert config.grid_finest and config.grid_levels and config.density_cells
    config.grid_finest = max(round(config.grid_finest / _LAST_PX), config.grid_coarsest + 2)
    config.grid_levels = max(config.grid_levels - 1, 2)
    config.samples, config.density_cells = _SAMPLES, min(config.density_cells, _DENSITY_CELLS)
    config.time_constant_us = config.time_constant_us or 0.0
    knots = config.camera_optimizer
    knots.prior, knots.every = 0.0, 1
    knots.keyframe_stride = max(1, model.num_train_data // _MOST_KNOTS)
    with torch.random.fork_rng():
        coarse = config.setup(
            scene_box=model.scene_box, num_train_data=model.num_train_data, metadata=model.kwargs["metadata"]
        )
    coarse.camera_optimizer.translation_px = _TRANSLATION_PX
    return coarse.to(model.device).train()


def _between(first: float, last: float, done: float) -> float:
    return first * (last / first) ** done


def _set_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    for group in optimizer.param_groups:
        group["lr"] = rate


def _shares(grid: HashGrid, of_finest: float) -> Float[Tensor, "levels"]:
    """1 for levels up to the given share of the finest resolution, 0 beyond the next, and the first level always."""
    resolution = torch.tensor(grid.shape.resolutions).float()
    level = (resolution / resolution[0]).log() / (resolution[1] / resolution[0]).log()
    last = (of_finest * resolution[-1] / resolution[0]).log() / (resolution[1] / resolution[0]).log()
    return (last - level + 1).clamp(0, 1).maximum(torch.eye(len(level))[0]).to(grid.table.device)


@torch.no_grad()
def _moved_px(model: EbarfModel, bundles: list[RayBundle]) -> float:
    """Root mean square distance, in pixels, between where events were seen and where the surfaces that they now see lie
    from where training began; less the best motion and scale of the whole scene, which no event tells.

    By least squares over the seven numbers of a small similarity; events at infinity have no part in its shift.
    """
    keyframes = model.camera_optimizer
    offsets, slopes = [], []
    for rays in bundles:
        t_us, direction = rays.metadata["event_t_us"][:, 0], rays.directions
        now, before = keyframes.poses_at(t_us), keyframes.start_at(t_us)
        seen_now = rotate(now.quat_wxyz, direction)
        depth = model.renderer(Rays(now.position, seen_now)).depth
        point = (now.position + depth[:, None] * seen_now).double()
        away = point - before.position
        distance = away.norm(dim=-1, keepdim=True)
        bearing = away / distance
        across = torch.eye(3).to(bearing) - bearing[:, :, None] * bearing[:, None, :]
        x, y, z = point.unbind(-1)
        zero = torch.zeros_like(x)
        turned = torch.stack([zero, z, -y, -z, zero, x, y, -x, zero], dim=-1).unflatten(-1, (3, 3))
        moves = torch.cat([turned, torch.eye(3).to(point).expand_as(turned), point[:, :, None]], dim=-1)
        offsets.append(across @ (bearing - rotate(before.quat_wxyz, direction))[:, :, None])
        slopes.append(across @ moves / distance[:, :, None])
    offset, slope = torch.cat(offsets), torch.cat(slopes)
    if not bool(offset.isfinite().all() and slope.isfinite().all()):
        return float("nan")
    flat = slope.flatten(0, 1)
    # Normal equations, a little damped: a camera that only turns says nothing of scale.
    normal = flat.T @ flat
    damping = 1e-6 * normal.diagonal().mean() * torch.eye(7).to(normal)
    similarity = torch.linalg.solve(normal + damping, -flat.T @ offset.flatten(0, 1))
    left = (offset + slope @ similarity).square().sum(dim=(1, 2)).mean().sqrt()
    return float(left) / keyframes.pixel_rad
