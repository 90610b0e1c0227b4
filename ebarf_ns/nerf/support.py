"""Verification after training: how well held-out events support the refined trajectory.

A field trained jointly with the keyframes agrees with them, right or wrong. Coarse fields are thus trained with fixed
trajectories: the refined one, the given one, and the refined one perturbed in weakly constrained directions.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch

from ebarf_ns.geometry.clock import differences_less_similarity
from ebarf_ns.geometry.so3 import quat_wxyz_conjugate, rotate
from ebarf_ns.geometry.trajectory import Trajectory, corrected
from ebarf_ns.nerf.coarse import gain, losses_from_trajectory
from ebarf_ns.radiance.ray_sampling import Rays

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float

    from ebarf_ns.nerf.datamanager import EventDataManager
    from ebarf_ns.nerf.model import EbarfModel

    Losses = Float[np.ndarray, "blocks"]
    LossesFrom = Callable[[Trajectory], Losses | None]

_CERTAIN = 4.0
_USUAL_TIMES, _MUCH_WORSE = 3.0, 1.1
_ASKED_PX, _LEAST_DEVIATIONS = 2.0, 0.25
_SOME_RAYS = 512
# Name, rotation axis, translation axis, and the sign of the translation: right, down and forward are 0, 1 and 2.
_BAS_RELIEFS = (
    ("a pan with a sideways shift", 1, 0, -1.0),
    ("a tilt with a vertical shift", 0, 1, 1.0),
)


@dataclass(frozen=True)
class WeakDirection:
    """Uncertainty of a rotation and a compensating shift, under which the image hardly moves."""

    name: str
    turn_deg: float
    """RMS rotation over the keyframes, one standard deviation."""
    shift: float
    """The compensating shift, in the trajectory's unit."""
    or_more: bool
    """Whether the size is only a lower bound."""

    def __str__(self) -> str:
        more = " or more" if self.or_more else ""
        size = f"{self.turn_deg:.2g}° and {self.shift:.2g} of the trajectory's unit{more}"
        return f"least certain: {self.name}, by {size} (one standard deviation)"


@dataclass(frozen=True)
class Support:
    """How well held-out events are predicted with the given and the refined trajectory, and the conclusion."""

    loss_given: float
    loss_refined: float
    deviations: float
    """Number of standard deviations, over time blocks, by which the refined trajectory is better."""
    worse_at_s: tuple[float, ...]
    """Centres of the time blocks, in seconds on the event clock, that the given trajectory predicts much better."""
    shifted: float
    """RMS distance between refined and given positions after removing a similarity, in the trajectory's unit."""
    weakest: WeakDirection | None

    @property
    def verdict(self) -> Literal["better", "alike", "worse"]:
        """Whether the refined trajectory is better than the given one, as judged by held-out events."""
        if abs(self.deviations) < _CERTAIN:
            return "alike"
        return "better" if self.deviations > 0 else "worse"

    @property
    def positions_undecided(self) -> bool:
        """Whether positions moved by less than one standard deviation of the weakest direction."""
        return self.weakest is not None and self.shifted < self.weakest.shift

    def __str__(self) -> str:
        said = {
            "better": "held-out events support the refined trajectory"
            + (", its rotations at least" if self.positions_undecided else ""),
            "alike": "held-out events do not distinguish the refined trajectory from the given one",
            "worse": "held-out events support the given trajectory, which is in trajectory_initial.txt",
        }[self.verdict]
        losses = f"loss {self.loss_refined:.3g}, {self.loss_given:.3g} with the given one"
        where = ", ".join(f"{one:g} s" for one in self.worse_at_s)
        lines = [
            f"{said} ({losses}, {abs(self.deviations):.1f} deviations)" + (f"; worse about {where}" if where else "")
        ]
        if self.weakest:
            lines.append(str(self.weakest))
            if self.positions_undecided:
                lines.append(
                    f"positions moved by {self.shifted:.2g}, less than that: they may be no better than the given ones"
                )
        return "\n".join(lines)


def support(model: EbarfModel, datamanager: EventDataManager, steps: int, seed: int) -> Support | None:
    """Test the refined trajectory on held-out events with coarse fields of ``steps`` steps; None if one diverges."""
    keyframes = model.camera_optimizer
    given = Trajectory(keyframes.keyframe_t_us - keyframes.clock_offset_us, keyframes.initial())
    losses_from = partial(losses_from_trajectory, model, datamanager, steps, seed)
    loss_given, loss_refined = losses_from(given, given_camera=True), losses_from(keyframes.trajectory())
    if loss_given is None or loss_refined is None:
        return None
    difference = loss_refined - loss_given
    worse = difference > _USUAL_TIMES * np.nanmedian(np.abs(difference))
    worse &= loss_refined > _MUCH_WORSE * loss_given
    return Support(
        float(np.nanmean(loss_given)),
        float(np.nanmean(loss_refined)),
        gain(loss_given, loss_refined),
        tuple(map(datamanager.heldout_blocks.middle_s, np.flatnonzero(worse).tolist())),
        _shifted(given, keyframes.trajectory()) / _scale(model),
        _weakest(model, _median_depth(model, datamanager), loss_refined, losses_from),
    )


def _weakest(model: EbarfModel, depth: float, loss_refined: Losses, losses_from: LossesFrom) -> WeakDirection | None:
    """The less constrained of two motions that are easily confused with scene relief (the bas-relief ambiguity,
    Belhumeur, Kriegman and Yuille 1999): a pan with a sideways shift, or a tilt with a vertical shift.

    Perturbing the trajectory by two pixels raises the held-out loss by z standard deviations. Losses are quadratic, so
    one standard deviation of motion is two pixels over the square root of z.
    """
    refined = model.camera_optimizer.trajectory()
    position, quat_wxyz = refined.poses
    place = rotate(quat_wxyz_conjugate(quat_wxyz[:1]).expand_as(quat_wxyz), position - position.mean(dim=0))
    turn_rad, found = _ASKED_PX * model.camera_optimizer.pixel_rad, []
    for name, turned, shifted, sign in _BAS_RELIEFS:
        size = place[:, shifted].square().mean().sqrt()
        course = turn_rad * place[:, shifted] / size.clamp_min(1e-9)
        move = torch.zeros(len(course), 6).to(course)
        move[:, turned], move[:, 3 + shifted] = course, sign * depth * course
        moved = losses_from(Trajectory(refined.t_us, corrected(refined.poses, move)))
        if moved is None or not float(size) > 0:
            return None
        found.append((gain(moved, loss_refined), name))
    deviations, name = min(found)
    turn_rad /= max(deviations, _LEAST_DEVIATIONS) ** 0.5
    shift = round(turn_rad * depth / _scale(model), 6)
    return WeakDirection(name, round(float(np.degrees(turn_rad)), 4), shift, deviations < _LEAST_DEVIATIONS)


def _scale(model: EbarfModel) -> float:
    """Training units per trajectory unit."""
    return float(model.kwargs["metadata"]["normalization"].scale)


def _shifted(given: Trajectory, refined: Trajectory) -> float:
    residual = differences_less_similarity(given.poses, refined.poses)[:, 3:]
    return round(float(residual.square().sum(dim=-1).mean().sqrt()), 6)


@torch.no_grad()
def _median_depth(model: EbarfModel, datamanager: EventDataManager) -> float:
    """Median depth at held-out events, in training coordinates."""
    rays, _ = datamanager.next_eval(0)
    every = max(1, len(rays) // _SOME_RAYS)
    assert rays.metadata is not None
    poses = model.camera_optimizer.poses_at(rays.metadata["event_t_us"][::every, 0])
    seen = Rays(poses.position, rotate(poses.quat_wxyz, rays.directions[::every]))
    return float(model.renderer(seen).depth.median())
