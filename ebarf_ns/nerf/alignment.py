"""Before training: large errors of the trajectory and of its clock, found by a field too coarse to lock them in.

What was found is measured as motion of the image. Where that is little, the trajectory was good, and is left alone:
the coarse field's own errors, a pixel along directions that events hardly tell, would be all that it gets.
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

# Both runs that drifted by 12 pixels (5 degrees) came back with these.
_FIRST_RATE, _LAST_RATE, _POWER = 0.4, 0.05, 0.25
# Odometry errs by degrees rather than by pixels of translation. What moves the image alike is told apart by this, and
# by what leaving the trajectory costs a squared pixel: without them, rotation and shift grow together, in opposition.
_TRANSLATION_PX, _COST = 0.3, 1e-4
# The same in training, where errors were smooth. Noise on every keyframe is more than that would let go: -0.5 dB.
_COST_IN_TRAINING, _SMOOTH = 3e-4, 0.06
_PROBE, _CERTAINLY_GOOD_PX, _GOOD_PX = 200, 1.0, 1.8
_BATCHES_TO_MEASURE = 2
# A field adapts to the intrinsics that it grows up with: a second one brings 0.7 % of the focal length to 0.2 %.
_INTRINSICS_FROM, _INTRINSICS_PASSES = 0.2, 2
_WARM_UP = 5
_CLOCK_EVERY, _LEAST_CLOCK_PX = 100, 0.2
# What the rate of events says of the clock is looked into when it says a lot.
_LEAST_ACTIVITY_US, _LEAST_ALIKE, _LEAST_GAIN = 40_000, 0.5, 0.05
_SOME_BEARINGS, _SOME_EVENTS = 50, 5_000_000
_CLOCK_STEPS, _CLOCK_DEVIATIONS = 100, 3.0


@dataclass(frozen=True)
class Alignment:
    """What the coarse field found."""

    moved_px: float
    """Root mean square motion of the image at events, less what moves the whole scene along."""
    taken: bool
    """Whether training begins from the keyframes found."""
    clock_offset_us: int
    """What was added to the trajectory's times; 0: they fit the events."""
    steps: int
    seconds: float

    def __str__(self) -> str:
        clock = (
            f"clock off by {self.clock_offset_us / 1000:+.1f} ms, which is made good; " if self.clock_offset_us else ""
        )
        if self.taken:
            return f"trajectory: {clock}off by {self.moved_px:.1f} px, training begins where a coarse field puts it"
        return f"trajectory: {clock}good to {self.moved_px:.1f} px, training begins from it as it is"


def align(
    model: EbarfModel, datamanager: EventDataManager, steps: int, seed: int, most_seconds: float | None = None
) -> Alignment | None:
    """Move the keyframes that ``model`` begins from to where a coarse field puts them, if that is far.

    Their clock is set by the way, where it was off. None, and nothing moved, if that would take more than
    ``most_seconds`` or ends in numbers that are not finite.
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
    taken = moved_px >= _GOOD_PX
    _begin(model, coarse, taken)
    datamanager.shift_clock(int(model.camera_optimizer.clock_offset_us))
    seconds = round(monotonic() - started, 3)
    return Alignment(round(moved_px, 3), taken, int(model.camera_optimizer.clock_offset_us), step + 1, seconds)


def _set_clock_by_activity(model: EbarfModel, datamanager: EventDataManager, seed: int) -> None:
    """Set the clock to where the rate of events goes best with the motion, if a field trained there is better, too."""
    keyframes = model.camera_optimizer
    some = datamanager.bearings[:: max(1, len(datamanager.bearings) // _SOME_BEARINGS)]
    kind = keyframes.config.interpolation or "linear"
    events = datamanager.index.events
    event_t_us = events["t_us"][:: max(1, len(events) // _SOME_EVENTS)]
    offset_us, alike, now = offset_by_activity(event_t_us, keyframes.start_trajectory(), some, kind)
    says_a_lot = abs(offset_us) >= _LEAST_ACTIVITY_US and alike > _LEAST_ALIKE and alike - now > _LEAST_GAIN
    if says_a_lot and _is_better(model, datamanager, offset_us, seed):
        keyframes.shift_clock(offset_us)
        datamanager.shift_clock(offset_us)


def _clock_offset_us(
    model: EbarfModel, datamanager: EventDataManager, keyframes: TrajectoryOptimizer, in_doubt: bool, seed: int
) -> int:
    """What the corrections of ``keyframes`` so far say that the clock is off by; 0: nothing.

    Other errors may look like a late clock. So a field is asked as well, before there is any offset, and ``in_doubt``
    even where the corrections alone would not do.
    """
    offset = keyframes.remaining_clock_offset()
    if offset.moved_rad < _LEAST_CLOCK_PX * keyframes.pixel_rad:
        return 0
    if keyframes.learns_clock:
        return offset.offset_us if offset.certain else 0
    asked = offset.certain or (in_doubt and offset.likely)
    return offset.offset_us if asked and _is_better(model, datamanager, offset.offset_us, seed) else 0


def _set_intrinsics(model: EbarfModel, datamanager: EventDataManager, steps: int, seed: int) -> None:
    """Learn the intrinsics from the trajectory as it is: moving ones take on much of what a focal length does."""
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
    """Whether a field predicts held-out events better if the clock is shifted, and poses left as they are."""
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


def _begin(model: EbarfModel, coarse: EbarfModel, taken: bool) -> None:
    """Let training begin with what the coarse field found."""
    ours, found = model.camera_optimizer, coarse.camera_optimizer
    trajectory, start = found.trajectory(), found.start_trajectory()
    offset_us = int(trajectory.t_us[0] - start.t_us[0]) + int(found.clock_offset_us)
    if offset_us:
        ours.shift_clock(offset_us - int(ours.clock_offset_us))
        ours.learn_clock()
    if taken:
        ours.begin_from(trajectory.poses)
    found.begin_from(trajectory.poses)
    rough = roughness(found.before_px)
    if rough < _SMOOTH:
        ours.hold_to_given(_COST_IN_TRAINING, _TRANSLATION_PX)


def roughness(moved: Float[Tensor, "keyframes 6"]) -> float:
    """Mean square of the differences between neighbours over twice the variance: 1 for white noise, 0 for drift."""
    spread = (moved - moved.mean(dim=0)).square().sum()
    return float(moved.diff(dim=0).square().sum() / (2 * spread).clamp_min(1e-12))


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
    # Normal equations, a little damped: a camera that only turns says nothing of scale.
    normal = flat.T @ flat
    damping = 1e-6 * normal.diagonal().mean() * torch.eye(7).to(normal)
    similarity = torch.linalg.solve(normal + damping, -flat.T @ offset.flatten(0, 1))
    left = (offset + slope @ similarity).square().sum(dim=(1, 2)).mean().sqrt()
    return float(left) / keyframes.pixel_rad
