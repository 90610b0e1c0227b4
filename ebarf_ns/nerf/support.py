"""After training: whether the events speak for the refined trajectory, or for the one that was given.

The field that was trained along with the refined keyframes agrees with them, right or wrong. So two coarse fields are
trained alike, one from either trajectory, neither of which moves, and predict events that nothing was trained on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch

from ebarf_ns.geometry.so3 import rotate
from ebarf_ns.geometry.trajectory import corrected
from ebarf_ns.nerf.coarse import CoarseTraining, coarse_model, gain, heldout_losses
from ebarf_ns.photometry.brightness import log_brightness
from ebarf_ns.photometry.event_loss import reported_change
from ebarf_ns.radiance.ray_sampling import Rays

if TYPE_CHECKING:
    from jaxtyping import Float

    from ebarf_ns.geometry.trajectory import Poses
    from ebarf_ns.nerf.datamanager import EventDataManager
    from ebarf_ns.nerf.model import EbarfModel

_CERTAIN = 3.0
_STEP_PX = 0.1


@dataclass(frozen=True)
class Support:
    """How well held-out events are predicted from either trajectory, and what that says."""

    loss_given: float
    loss_refined: float
    deviations: float
    """By how many standard deviations, from stretch to stretch of time, the refined trajectory is the better one."""
    worse_at_s: tuple[float, ...]
    """Middles of the stretches of time, in seconds on the clock of the events, that are much better predicted from the
    trajectory given."""

    @property
    def verdict(self) -> Literal["better", "alike", "worse"]:
        """What the events say of the refined trajectory, against the one given."""
        if abs(self.deviations) < _CERTAIN:
            return "alike"
        return "better" if self.deviations > 0 else "worse"

    def __str__(self) -> str:
        said = {
            "better": "events that were held out speak for the refined trajectory",
            "alike": "events that were held out do not tell the refined trajectory from the one given",
            "worse": "events that were held out speak for the trajectory given, which is in trajectory_initial.txt",
        }[self.verdict]
        losses = f"loss {self.loss_refined:.3g}, {self.loss_given:.3g} with the one given"
        where = ", ".join(f"{one:g} s" for one in self.worse_at_s)
        return f"{said} ({losses}, {abs(self.deviations):.1f} deviations)" + (f"; worse about {where}" if where else "")


def support(model: EbarfModel, datamanager: EventDataManager, steps: int, seed: int) -> Support | None:
    """Compare the trajectory as ``model`` refined it with the one given; None if a number is not finite."""
    keyframes = model.camera_optimizer
    refined = keyframes.trajectory()
    offset_us = int(refined.t_us[0] - keyframes.given_trajectory().t_us[0])
    given = _losses(model, keyframes.initial(), 0, False, datamanager, steps, seed)
    better = _losses(model, refined.poses, offset_us, True, datamanager, steps, seed)
    if given is None or better is None:
        return None
    difference = better - given
    blocks = datamanager.heldout_blocks
    usual = np.nanmedian(np.abs(difference))
    worse = np.flatnonzero((difference > 3 * usual) & (better > 1.1 * given))
    return Support(
        float(np.nanmean(given)), float(np.nanmean(better)), gain(given, better), tuple(map(blocks.middle_s, worse))
    )


def _losses(
    model: EbarfModel,
    poses: Poses,
    offset_us: int,
    with_intrinsics: bool,
    datamanager: EventDataManager,
    steps: int,
    seed: int,
) -> Float[np.ndarray, "blocks"] | None:
    coarse = coarse_model(model, "off")
    keyframes = coarse.camera_optimizer
    keyframes.begin_from(poses)
    keyframes.shift_clock(offset_us - int(keyframes.clock_offset_us))
    if with_intrinsics and coarse.intrinsics and model.intrinsics:
        coarse.intrinsics.load_state_dict(model.intrinsics.state_dict())
    return heldout_losses(coarse, CoarseTraining(coarse, datamanager, steps, seed))


@dataclass(frozen=True)
class WeakDirection:
    """The motion of a keyframe that events tell worst, one standard deviation of it."""

    turn_deg: tuple[float, float, float]
    """About the camera's axes: right, down, forward."""
    shift: tuple[float, float, float]
    """Along them, in the unit of the trajectory."""
    times_worse: float
    """Its standard deviation over that of what is told best, both as motion of the image at unit distance."""

    def __str__(self) -> str:
        turn, shift = np.array(self.turn_deg), np.array(self.shift)
        about, along = int(np.abs(turn).argmax()), int(np.abs(shift).argmax())
        return (
            f"least certain is {_TURNS[about]} with a shift {_SHIFTS[along]}: no better than "
            f"{np.linalg.norm(turn):.2g} deg with {np.linalg.norm(shift):.2g} for each keyframe"
        )


_TURNS = ("a turn about the horizontal", "a turn about the vertical", "a roll")
_SHIFTS = ("sideways", "up or down", "forward")


@torch.no_grad()
def weak_direction(model: EbarfModel, datamanager: EventDataManager, scale: float) -> WeakDirection | None:
    """The direction of a keyframe's six numbers that events tell worst, and how well at best; None if nothing tells.

    By the bound of Cramér and Rao: residuals r of held-out pairs have the slopes J to the later pose, of which each
    keyframe has n = events / keyframes. The covariance is mean(r²) mean(J Jᵀ)⁻¹ / n, in pixels of a correction. The
    field counts as known, which it is not: what bends it along with the trajectory is worse. ``scale`` is that of the
    training coordinates over the trajectory's unit.
    """
    keyframes = model.camera_optimizer
    rays, batch = datamanager.next_eval(0)
    t_us, seen = rays.metadata["event_t_us"][:, 0], rays.directions
    if model.intrinsics:
        seen = model.intrinsics.bearings(rays.metadata["event_pixel"][:, 0])
    poses = keyframes.poses_at(t_us)
    half = len(t_us) // 2
    was_training = model.training
    model.eval()
    moves = torch.cat([torch.zeros(1, 6), _STEP_PX * torch.eye(6)]).to(seen)
    looks = []
    for move in moves:
        moved = corrected(poses, (keyframes.pixel_rad * move).expand(len(t_us), 6))
        rendered = model.renderer(Rays(moved.position, rotate(moved.quat_wxyz, seen)))
        looks.append(log_brightness(rendered.intensity, model.config.brightness).double())
    model.train(was_training)
    after = torch.stack([look[half:] for look in looks])
    change = after[0] - looks[0][:half]
    reported = reported_change(batch["polarity_sum"], batch["event_count"], *model.sensor()).to(change)
    slope = ((after[1:] - after[0]) / _STEP_PX).T
    variance = (change - reported).square().mean()
    events = len(datamanager.index.events) / len(keyframes.keyframe_t_us)
    information = slope.T @ slope / len(slope) * events / variance
    told, direction = torch.linalg.eigh(information)
    if not bool(told.isfinite().all()) or not float(told[0]) > 0:
        return None
    worst = (direction[:, 0] / told[0].sqrt()).cpu().numpy() * keyframes.pixel_rad
    return WeakDirection(
        tuple(np.degrees(worst[:3]).tolist()),
        tuple((worst[3:] / scale).tolist()),
        float((told[-1] / told[0]).sqrt()),
    )
