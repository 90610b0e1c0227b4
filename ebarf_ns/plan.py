"""Automatic configuration from the scene: every decision has a reason and can be overridden by the flag it names.

A configuration field that is None is set by the plan; the decision is written into the run's ``config.yml`` and the
header of its metrics.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from math import ceil, log, sqrt
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ebarf_ns.events.sensor_facts import UNKNOWN_SENSOR, SensorFacts
from ebarf_ns.geometry.so3 import rotate, turn_between
from ebarf_ns.geometry.trajectory import Interpolation, Poses, Trajectory, densified, interpolate
from ebarf_ns.radiance.field import fastest_precision
from ebarf_ns.radiance.ray_sampling import Rays, leave_box
from ebarf_ns.scene import box_of_bounds

if TYPE_CHECKING:
    from jaxtyping import Float

    from ebarf_ns.scene import Scene

_GROWTH = 1.6
# Nonlinear motion between learned corrections may be noise, which then remains: a fifth of a pixel cost 1 to 2 dB.
_STRAIGHT_PX = 0.05
_AS_GOOD_AS_STRAIGHT_PX = 0.02
_UNEVEN = 4.0
_BETWEEN_PX = 0.05
_SHORTEST_GAP_US = 45_000
_MOST_BLANK = 0.06


@dataclass(frozen=True)
class Line:
    """One decision of the plan."""

    field: str
    """Dotted path in the run's configuration."""
    value: Any
    reason: str

    @property
    def flag(self) -> str:
        """The command-line flag that overrides the decision."""
        return "--" + self.field.replace("_", "-")


def plan_for(
    scene: Scene,
    trajectory: Trajectory,
    events: int,
    device: str,
    coarsest: int = 8,
    finest_given: int | None = None,
    normalized: bool = False,
    facts: SensorFacts = UNKNOWN_SENSOR,
) -> list[Line]:
    """Plan for a scene, the initial trajectory and a number of events, on "cpu" or "cuda".

    Decisions that depend on the grid's coarsest and finest level use ``coarsest`` and, if given, ``finest_given``;
    ``normalized`` selects the paper's Eq. 6; ``facts`` are those of the recording.
    """
    far_side = _far_side(scene, trajectory)
    bounded, distance = far_side is not None, far_side and far_side[0]
    finest, why = _finest(scene.camera.fx, far_side)
    # A view covers less than half the width of contracted space.
    supported = max(round(sqrt(events)) * (1 if bounded else 2), 32)
    if finest > supported:
        finest, why = supported, f"one cell per event over a visible surface; pixels resolve up to {finest}"
    planned_finest, finest = finest, finest_given or finest
    levels = 1 + max(ceil(log(finest / coarsest) / log(_GROWTH)), 0)
    rows_log2 = int(np.clip(round(2 * log(finest, 2)), 10, 19))
    gap_us, gaps = _longest_gap(trajectory, scene.camera.fx, distance)
    dense, _ = densified(trajectory, gap_us, _spline_if_even(trajectory))
    stride, straight = _stride(trajectory, scene.camera.fx, distance)
    if len(dense.t_us) > len(trajectory.t_us):
        stride, straight = 1, "keyframes are inserted, and each is learned"
    precision = fastest_precision(device)
    rays = 16384 if device == "cuda" else 1024
    return [
        Line(
            "pipeline.model.contract",
            not bounded,
            "the scene has bounds: no contraction"
            if bounded
            else "the scene has no bounds: all of space is contracted",
        ),
        Line("pipeline.model.grid_finest", planned_finest, why),
        Line("pipeline.model.grid_levels", levels, f"from {coarsest} to {finest} in steps of at most {_GROWTH}"),
        Line(
            "pipeline.model.grid_table_size_log2",
            rows_log2,
            f"{1 << rows_log2:,} rows, at most 524,288: a wall has {finest}² cells",
        ),
        Line(
            "pipeline.model.broad_cells",
            16,
            "low-frequency brightness is learned as fast as edges; gradients across a room otherwise come last",
        ),
        Line(
            "pipeline.model.density_cells",
            int(np.clip(finest, 32, 128)),
            "as the finest level, up to 128: a finer density cache needs fewer samples",
        ),
        Line(
            "pipeline.model.samples",
            16,
            "the density cache locates surfaces: more samples cost steps and improved nothing",
        ),
        Line(
            "pipeline.model.precision",
            precision,
            "native bfloat16 on this processor" if precision == "bfloat16" else "no native bfloat16 on this processor",
        ),
        Line("pipeline.model.camera_optimizer.longest_gap_us", gap_us, gaps),
        Line("pipeline.model.camera_optimizer.keyframe_stride", stride, straight),
        Line("pipeline.model.camera_optimizer.interpolation", *_interpolation(trajectory, scene.camera.fx, distance)),
        Line(
            "pipeline.datamanager.silent_share",
            0.0 if normalized else 0.125,
            "Eq. 6 has no threshold unit for silent pixels"
            if normalized
            else "a silent pixel has changed by less than a threshold",
        ),
        *_sensor_lines(scene, facts, normalized),
        Line(
            "pipeline.datamanager.train_num_rays_per_batch", rays, f"keeps {'a GPU' if rays > 1024 else 'caches'} full"
        ),
    ]


def _sensor_lines(scene: Scene, facts: SensorFacts, normalized: bool) -> list[Line]:
    """Sensor parameters: as given in the scene, else as estimated from the recording."""
    blind, ratio = facts.refractory_us, facts.threshold_ratio
    if scene.refractory_us is not None:
        refractory_us, blind_why = scene.refractory_us, "given in scene.json"
    else:
        refractory_us = round(blind.value)
        blind_why = (
            f"estimated from event intervals: {blind.low:.0f} to {blind.high:.0f} us"
            if refractory_us
            else f"event intervals, the shortest {blind.high:.0f} us, show no refractory period"
        )
    stated = scene.contrast_threshold
    if stated:
        value, deviation, ratio_why = stated.on / stated.off, 0.0, "thresholds given in scene.json"
    else:
        value, deviation = ratio.value, log(ratio.high / ratio.low) / 4
        ratio_why = f"estimated from ON and OFF events that cancel: {ratio.low:.2f} to {ratio.high:.2f}"
    blank = 0.0 if normalized else _MOST_BLANK * facts.blank_share
    return [
        Line(
            "pipeline.datamanager.doubles_us",
            facts.doubles_us,
            f"{facts.doubles_share:.1%} of the events repeat the previous one within that time"
            if facts.doubles_us
            else "no crossing is reported twice",
        ),
        Line("pipeline.datamanager.refractory_us", refractory_us, blind_why),
        Line("pipeline.model.time_constant_us", *_time_constant(scene, normalized)),
        Line("pipeline.datamanager.blank_share", blank, f"{facts.blank_share:.0%} of the pixels never fire"),
        Line("pipeline.model.threshold_ratio", value, ratio_why),
        Line(
            "pipeline.model.threshold_deviation",
            deviation,
            "range within which training refines the ratio" if deviation else "thresholds given: nothing to refine",
        ),
    ]


def _time_constant(scene: Scene, normalized: bool) -> tuple[float | None, str]:
    if normalized:
        return 0.0, "Eq. 6 assumes events without delay"
    if scene.time_constant_us is not None:
        return scene.time_constant_us, "given in scene.json"
    return None, "learned from 0 up: event delays only show in training, and learning them costs nothing at 0"


def apply_plan(lines: list[Line], configuration: Any) -> list[Line]:
    """Fill in fields of ``configuration`` that are None; returns the lines in effect."""
    in_force = []
    for line in lines:
        *path, name = line.field.split(".")
        part = reduce(getattr, path, configuration)
        value = getattr(part, name)
        if value is None:
            setattr(part, name, line.value)
            in_force.append(line)
        else:
            in_force.append(Line(line.field, value, f"set by flag or method (planned: {line.value}, {line.reason})"))
    return in_force


def _finest(focal_px: float, far_side: tuple[float, float] | None) -> tuple[int, str]:
    """Cells per side of the finest level: one per pixel footprint at the scene's distance."""
    if far_side is None:
        # Contracted space is four units wide; a pixel's footprint in it is about 2 / focal_px beyond one unit.
        finest = int(np.clip(2 * focal_px, 64, 2048))
        return (
            finest,
            "twice the focal length in pixels, from 64 to 2048: a pixel's footprint beyond the near field",
        )
    distance, size = far_side
    finest = int(np.clip(round(size * focal_px / distance), 64, 2048))
    footprint = distance / focal_px
    return (
        finest,
        f"a pixel covers {footprint:.3g} at the far side of the bounds, {distance:.3g} away; they are {size:.3g} wide",
    )


def _far_side(scene: Scene, trajectory: Trajectory) -> tuple[float, float] | None:
    """Median distance to the far side of the bounds over keyframes and directions, and the bounds' largest side."""
    if scene.bounds is None:
        return None
    _, scale, _ = box_of_bounds(scene.bounds)
    distances = _far_sides(scene, trajectory)
    return (max(float(distances.median()), 0.01 / scale) if len(distances) else 1 / scale), 2 / scale


def depth_spread(scene: Scene, trajectory: Trajectory) -> float | None:
    """How many times as far the bounds are in some directions of view as in others; None without bounds.

    The quotient of the 90 % and 10 % quantiles over keyframes and directions.
    """
    distances = _far_sides(scene, trajectory)
    if not len(distances):
        return None
    near, far = distances.quantile(torch.tensor([0.1, 0.9], dtype=distances.dtype)).tolist()
    return far / max(near, 1e-12 * far) if far > 0 else None


def _far_sides(scene: Scene, trajectory: Trajectory) -> Float[torch.Tensor, "rays"]:
    """Distances to the far side of the bounds from keyframes within them, over directions of view; may be empty."""
    if scene.bounds is None:
        return torch.zeros(0, dtype=torch.float64)
    centre, scale, half_sides = box_of_bounds(scene.bounds)
    place = (trajectory.poses.position.double() - centre) * scale
    inside = (place.abs() < half_sides).all(dim=-1).nonzero()[:, 0]
    some = inside[:: max(1, len(inside) // 50)]
    quat_wxyz = trajectory.poses.quat_wxyz[some].double()
    bearing = _some_bearings(scene).double()
    direction = rotate(quat_wxyz[:, None], bearing[None]).flatten(0, 1)
    return leave_box(Rays(place[some].repeat_interleave(len(bearing), dim=0), direction), half_sides) / scale


def _some_bearings(scene: Scene) -> Float[torch.Tensor, "pixels 3"]:
    camera = scene.camera
    columns, rows = np.linspace(0, camera.width - 1, 5), np.linspace(0, camera.height - 1, 5)
    return camera.bearings(torch.cartesian_prod(torch.from_numpy(columns), torch.from_numpy(rows)))


def _stride(trajectory: Trajectory, focal_px: float, distance: float | None) -> tuple[int, str]:
    """Largest spacing of learned corrections for which the motion between is linear to 1/20 of a pixel."""
    keyframes = len(trajectory.t_us)
    stride, off_px = 1, 0.0
    while 2 * stride * 4 <= keyframes:
        wider = _off_px(trajectory, 2 * stride, focal_px, distance)
        if wider > _STRAIGHT_PX:
            break
        stride, off_px = 2 * stride, wider
    rate = (keyframes - 1) / (float(trajectory.t_us[-1] - trajectory.t_us[0]) * 1e-6)
    if keyframes < 8:
        return 1, f"only {keyframes} keyframes"
    if stride == 1:
        return 1, f"{rate:.0f} keyframes per second: over longer intervals, the motion or its noise is not linear"
    return stride, f"{rate:.0f} keyframes per second: between every {stride}th, motion is linear to {off_px:.2g} px"


def _longest_gap(trajectory: Trajectory, focal_px: float, distance: float | None) -> tuple[int, str]:
    """Largest allowed gap between keyframes, in microseconds; 0: insert none."""
    gaps_us = trajectory.t_us.diff()
    usual_us, longest_us = int(gaps_us.median()), int(gaps_us.max())
    kind = _spline_if_even(trajectory)
    # Halving the knot spacing divides the error by 4 for linear interpolation, and by at least 8 for a spline.
    shrinks = 8 if kind == "cubic" else 4
    off_px = _off_px(trajectory, 2, focal_px, distance, kind) / shrinks
    pieces, left_px = 1, off_px
    while left_px > _BETWEEN_PX and usual_us // (2 * pieces) >= _SHORTEST_GAP_US:
        pieces, left_px = 2 * pieces, left_px / shrinks
    gap_us = max(usual_us // pieces, _SHORTEST_GAP_US)
    if pieces == 1 and longest_us < 2 * gap_us:
        return 0, f"between keyframes the motion is known to {off_px:.2g} px"
    if pieces == 1:
        return gap_us, f"gaps of up to {longest_us} us between keyframes with a median spacing of {usual_us} us"
    return gap_us, f"between keyframes, {usual_us} us apart, the motion is uncertain by {off_px:.2g} px"


def _unevenness(trajectory: Trajectory) -> float:
    gaps_us = trajectory.t_us.diff().double()
    return float(gaps_us.max() / gaps_us.min())


def _spline_if_even(trajectory: Trajectory) -> Interpolation:
    return "linear" if len(trajectory.t_us) < 5 or _unevenness(trajectory) > _UNEVEN else "cubic"


def _interpolation(trajectory: Trajectory, focal_px: float, distance: float | None) -> tuple[Interpolation, str]:
    """A spline if the motion between keyframes is nonlinear and their spacing is even enough."""
    keyframes = len(trajectory.t_us)
    if _spline_if_even(trajectory) == "linear":
        uneven = _unevenness(trajectory)
        return "linear", f"{keyframes} keyframes, gaps between them up to {uneven:.3g} times the shortest: no spline"
    # Halving the knot spacing divides the deviation from a line by 4.
    off_px = _off_px(trajectory, 2, focal_px, distance) / 4
    if off_px < _AS_GOOD_AS_STRAIGHT_PX:
        return "linear", f"between keyframes the motion is linear to {off_px:.2g} px"
    return "cubic", f"between keyframes the motion deviates from a line by {off_px:.2g} px"


def _off_px(
    trajectory: Trajectory, stride: int, focal_px: float, distance: float | None, kind: Interpolation = "linear"
) -> float:
    """RMS error, in pixels, of predicting the keyframes from every ``stride``-th one.

    An unknown scene distance is replaced by four times the trajectory's radius.
    """
    knots = torch.arange(0, len(trajectory.t_us) - 1, stride)
    knots = torch.cat([knots, torch.tensor([len(trajectory.t_us) - 1])])
    at_knots = Poses(*(column[knots] for column in trajectory.poses))
    line = interpolate(trajectory.t_us[knots], at_knots, trajectory.t_us, kind)
    position = trajectory.poses.position
    if distance is None:
        distance = 4 * float((position - position.mean(dim=0)).norm(dim=-1).max())
    moved = (line.position - position).norm(dim=-1) / max(distance, 1e-9)
    turn = turn_between(line.quat_wxyz, trajectory.poses.quat_wxyz)
    return float((moved + turn.norm(dim=-1)).square().mean().sqrt()) * focal_px
