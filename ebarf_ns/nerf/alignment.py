"""Alignment before training: a coarse field finds large errors of the trajectory and its clock.

The correction is measured as image motion. If it is small, the trajectory is kept as given: it would only pick up the
coarse field's own errors, about a pixel in directions that events barely constrain.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import monotonic
from typing import TYPE_CHECKING

import torch

from ebarf_ns.geometry.clock import offset_by_activity
from ebarf_ns.geometry.so3 import rotate
from ebarf_ns.geometry.trajectory import Trajectory
from ebarf_ns.nerf.coarse import CoarseTraining, between, coarse_model, gain, losses_from_trajectory, set_rate
from ebarf_ns.nerf.keyframe_adam import KeyframeAdam
from ebarf_ns.radiance.ray_sampling import Rays

if TYPE_CHECKING:
    from jaxtyping import Float
    from nerfstudio.cameras.rays import RayBundle
    from torch import Tensor

    from ebarf_ns.nerf.datamanager import EventDataManager
    from ebarf_ns.nerf.model import EbarfModel
    from ebarf_ns.nerf.trajectory_optimizer import TrajectoryOptimizer

# Both runs that drifted by 12 pixels (5 degrees) recovered with these.
_FIRST_RATE, _LAST_RATE, _POWER = 0.4, 0.05, 0.25
# Odometry errors are degrees of rotation rather than pixels of translation. This prior scale, and the cost per squared
# pixel of leaving the trajectory, separate the two: without them, opposite rotations and shifts grow together.
_TRANSLATION_PX, _COST = 0.3, 1e-4
# The same in training, for smooth errors only. It would hold back corrections of noise on every keyframe: -0.5 dB.
_COST_IN_TRAINING, _SMOOTH = 3e-4, 0.06
_PROBE, _CERTAINLY_GOOD_PX, _GOOD_PX = 200, 1.0, 1.8
# Training corrects noise on every keyframe by itself. The coarse field would leave its own errors in place of it:
# 2.4 degrees instead of 0.5 on a dim recording that was given with 1.2.
_NOISE_PX = 6.0
_BATCHES_TO_MEASURE = 2
# A field adapts to its initial intrinsics: a second pass reduces the focal length error from 0.7 % to 0.2 %.
_INTRINSICS_FROM, _INTRINSICS_PASSES = 0.2, 2
_WARM_UP = 5
_CLOCK_EVERY, _LEAST_CLOCK_PX = 100, 0.2
# A clock offset from the event rate is only tested if it is large and its correlation clear.
_LEAST_ACTIVITY_US, _LEAST_CORRELATION, _LEAST_GAIN = 40_000, 0.5, 0.05
NOT_ALIGNED = "trajectory: not checked for large errors, which needs a longer training"
_SOME_BEARINGS, _SOME_EVENTS = 50, 5_000_000
_CLOCK_STEPS, _CLOCK_DEVIATIONS = 100, 3.0


@dataclass(frozen=True)
class Alignment:
    """Result of the alignment."""

    moved_px: float
    """RMS image motion at events, after removing motion of the whole scene."""
    taken: bool
    """Whether training starts from the aligned keyframes."""
    clock_offset_us: int
    """Offset added to the trajectory's times; 0: they fit the events."""
    steps: int
    seconds: float

    def __str__(self) -> str:
        clock = f"clock off by {self.clock_offset_us / 1000:+.1f} ms, now corrected; " if self.clock_offset_us else ""
        if self.taken:
            return f"trajectory: {clock}off by {self.moved_px:.1f} px, training starts from the coarse alignment"
        return (
            f"trajectory: {clock}no large smooth error (a coarse field moves it by {self.moved_px:.1f} px), training "
            "starts from it unchanged"
        )


def align(
    model: EbarfModel, datamanager: EventDataManager, steps: int, seed: int, most_seconds: float | None = None
) -> Alignment | None:
    """Align the initial keyframes of ``model`` with a coarse field, if they move far; also corrects a clock offset.

    Returns None and leaves everything unchanged if alignment would take more than ``most_seconds`` or diverges.
    """
    started = monotonic()
    _set_clock_by_activity(model, datamanager, seed)
    for _ in range(_INTRINSICS_PASSES if model.intrinsics else 0):
        _set_intrinsics(model, datamanager, steps, seed)
    coarse = coarse_model(model)
    keyframes = coarse.camera_optimizer
    keyframes.hold_to_given(_COST, _TRANSLATION_PX)
    if keyframes.clock_offset_us:
        keyframes.learn_clock()
    poses = KeyframeAdam(keyframes.parameters(), lr=_FIRST_RATE, power=_POWER)
    training = CoarseTraining(coarse, datamanager, steps, seed)
    moved_px, warm = 0.0, started
    for step in range(steps):
        set_rate(poses, between(_FIRST_RATE, _LAST_RATE, step / steps))
        if not training.step(step, poses):
            return _nothing_moved(model, datamanager)
        if step == _WARM_UP:
            warm = monotonic()
        elif most_seconds and step == 5 * _WARM_UP and (monotonic() - warm) / (4 * _WARM_UP) * steps > most_seconds:
            return _nothing_moved(model, datamanager)
        if (step + 1) % _CLOCK_EVERY == 0:
            if offset_us := _clock_offset_us(model, datamanager, keyframes, step + 1 == _PROBE, seed):
                keyframes.explain_by_clock(offset_us)
                keyframes.learn_clock()
                datamanager.shift_clock(int(keyframes.clock_offset_us))
                poses.state.clear()
        if step + 1 in (_PROBE, steps):
            moved_px = _moved_px(coarse, [datamanager.next_train(step + k)[0] for k in range(_BATCHES_TO_MEASURE)])
            if not moved_px < float("inf"):
                return _nothing_moved(model, datamanager)
            if moved_px < _CERTAINLY_GOOD_PX:
                break
    taken = _begin(model, coarse, moved_px)
    datamanager.shift_clock(int(model.camera_optimizer.clock_offset_us))
    seconds = round(monotonic() - started, 3)
    return Alignment(round(moved_px, 3), taken, int(model.camera_optimizer.clock_offset_us), step + 1, seconds)


def _set_clock_by_activity(model: EbarfModel, datamanager: EventDataManager, seed: int) -> None:
    """Set the clock to the best correlation of event rate and image motion, if held-out events confirm it."""
    keyframes = model.camera_optimizer
    some = datamanager.bearings[:: max(1, len(datamanager.bearings) // _SOME_BEARINGS)]
    kind = keyframes.config.interpolation or "linear"
    events = datamanager.index.events
    event_t_us = events["t_us"][:: max(1, len(events) // _SOME_EVENTS)]
    offset_us, best, now = offset_by_activity(event_t_us, keyframes.start_trajectory(), some, kind)
    clear = abs(offset_us) >= _LEAST_ACTIVITY_US and best > _LEAST_CORRELATION and best - now > _LEAST_GAIN
    if clear and _is_better(model, datamanager, offset_us, seed):
        keyframes.shift_clock(offset_us)
        datamanager.shift_clock(offset_us)


def _clock_offset_us(
    model: EbarfModel, datamanager: EventDataManager, keyframes: TrajectoryOptimizer, test_likely: bool, seed: int
) -> int:
    """Clock offset implied by the corrections of ``keyframes`` so far; 0: none.

    Other errors may look like a clock offset. A first offset is therefore confirmed on held-out events;
    ``test_likely`` also tests offsets that are likely but not certain.
    """
    offset = keyframes.remaining_clock_offset()
    if offset.moved_rad < _LEAST_CLOCK_PX * keyframes.pixel_rad:
        return 0
    if keyframes.learns_clock:
        return offset.offset_us if offset.certain else 0
    worth_testing = offset.certain or (test_likely and offset.likely)
    return offset.offset_us if worth_testing and _is_better(model, datamanager, offset.offset_us, seed) else 0


def _set_intrinsics(model: EbarfModel, datamanager: EventDataManager, steps: int, seed: int) -> None:
    """Learn the intrinsics with fixed keyframes: moving ones would absorb much of a focal length error."""
    coarse = coarse_model(model, "off")
    assert model.intrinsics and coarse.intrinsics
    coarse.camera_optimizer.begin_from(model.camera_optimizer.start_trajectory().poses)
    intrinsics = KeyframeAdam(coarse.intrinsics.parameters(), power=_POWER)
    training = CoarseTraining(coarse, datamanager, steps, seed)
    for step in range(steps):
        young = step < _INTRINSICS_FROM * steps
        set_rate(intrinsics, 0.0 if young else between(_FIRST_RATE, _LAST_RATE, step / steps))
        if not training.step(step, intrinsics):
            return
    model.intrinsics.load_state_dict(coarse.intrinsics.state_dict())


def _is_better(model: EbarfModel, datamanager: EventDataManager, offset_us: int, seed: int) -> bool:
    """Whether a coarse field with fixed poses predicts held-out events better with the clock shifted."""
    losses, start = [], model.camera_optimizer.start_trajectory()
    for shift_us in (0, offset_us):
        shifted = Trajectory(start.t_us + shift_us, start.poses)
        found = losses_from_trajectory(model, datamanager, _CLOCK_STEPS, seed, shifted)
        if found is None:
            return False
        losses.append(found)
    return gain(losses[0], losses[1]) > _CLOCK_DEVIATIONS


def _nothing_moved(model: EbarfModel, datamanager: EventDataManager) -> None:
    model.camera_optimizer.shift_clock(-int(model.camera_optimizer.clock_offset_us))
    datamanager.shift_clock(0)


def _begin(model: EbarfModel, coarse: EbarfModel, moved_px: float) -> bool:
    """Start training from the result of the coarse field; return whether its keyframes are taken."""
    ours, found = model.camera_optimizer, coarse.camera_optimizer
    trajectory, start = found.trajectory(), found.start_trajectory()
    offset_us = int(trajectory.t_us[0] - start.t_us[0]) + int(found.clock_offset_us)
    if offset_us:
        ours.shift_clock(offset_us - int(ours.clock_offset_us))
        ours.learn_clock()
    found.begin_from(trajectory.poses)
    smooth = roughness(found.before_px) < _SMOOTH
    taken = moved_px >= (_GOOD_PX if smooth else _NOISE_PX)
    if taken:
        ours.begin_from(trajectory.poses)
    if smooth:
        ours.hold_to_given(_COST_IN_TRAINING, _TRANSLATION_PX)
    return taken


def roughness(moved: Float[Tensor, "keyframes 6"]) -> float:
    """Mean squared difference between neighbours over twice the variance: 1 for white noise, 0 for drift."""
    spread = (moved - moved.mean(dim=0)).square().sum()
    return float(moved.diff(dim=0).square().sum() / (2 * spread).clamp_min(1e-12))


@torch.no_grad()
def _moved_px(model: EbarfModel, bundles: list[RayBundle]) -> float:
    """RMS distance, in pixels, between events and the surfaces they now see, reprojected into the initial poses, after
    removing the best similarity of the whole scene, which events do not constrain.

    Solved by least squares over the seven parameters of a small similarity; events at infinity do not affect its shift.
    """
    keyframes = model.camera_optimizer
    offsets, slopes = [], []
    for rays in bundles:
        t_us, direction = rays.metadata["event_t_us"][:, 0], rays.directions
        now, before = keyframes.poses_at(t_us), keyframes.start_at(t_us)
        learned = model.intrinsics and model.intrinsics.bearings(rays.metadata["event_pixel"][:, 0])
        seen_now = rotate(now.quat_wxyz, direction if learned is None else learned)
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
    # Slightly damped normal equations: a purely rotating camera leaves the scale undetermined.
    normal = flat.T @ flat
    damping = 1e-6 * normal.diagonal().mean() * torch.eye(7).to(normal)
    similarity = torch.linalg.solve(normal + damping, -flat.T @ offset.flatten(0, 1))
    residual = (offset + slope @ similarity).square().sum(dim=(1, 2)).mean().sqrt()
    return float(residual) / keyframes.pixel_rad
