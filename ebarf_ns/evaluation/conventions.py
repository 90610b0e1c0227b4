"""Which conventions a trajectory's file follows, found by trying them against a reference."""

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import get_args

from ebarf_ns.errors import EvaluationError, TrajectoryError
from ebarf_ns.evaluation.trajectory_error import rotation_errors_deg
from ebarf_ns.geometry.trajectory import Trajectory
from ebarf_ns.geometry.trajectory_formats import Axes, Quaternion, TrajectoryFormat, Transform, read_trajectory

# The right convention is better than all others by this factor, or the motion cannot tell.
_CLEARLY = 0.5
_STILL_DEG = 0.01


def read_by_reference(
    path: Path, reference: Trajectory, known: TrajectoryFormat = TrajectoryFormat()
) -> tuple[Trajectory, list[str]]:
    """A trajectory read by the conventions under which its rotations are those of the reference.

    Order of the quaternion and direction of the transform are tried where ``known`` leaves them open, with any constant
    rotation between the two bodies; then the axes, without. Raises :class:`TrajectoryError` where several orders fit
    alike: then the motion cannot tell, and has to be told.
    """
    quaternions = (known.quaternion,) if known.quaternion else get_args(Quaternion)
    transforms = (known.transform,) if known.transform else get_args(Transform)
    tried: list[tuple[float, TrajectoryFormat]] = []
    for quaternion, transform in product(quaternions, transforms):
        attempt = replace(known, quaternion=quaternion, transform=transform)
        tried.append((_off_deg(path, reference, attempt, body=True), attempt))
    tried.sort(key=lambda one: one[0])
    best_deg, best = tried[0]
    if len(tried) > 1 and (best_deg > _CLEARLY * tried[1][0] or tried[1][0] < _STILL_DEG):
        second = tried[1][1]
        raise TrajectoryError(
            f"{path}: rotations are {best_deg:.2g} deg from the reference as {best.quaternion} {best.transform} and "
            f"{tried[1][0]:.2g} deg as {second.quaternion} {second.transform}; expected --quaternion and --transform, "
            "which this motion cannot tell"
        )
    trajectory, notes = read_trajectory(path, best)
    notes.append(f"{path.name}: {best.quaternion}, {best.transform} fits the reference to {best_deg:.2g} deg")
    if known.axes is None:
        notes += _note_on_axes(path, reference, best)
    return trajectory, notes


def _note_on_axes(path: Path, reference: Trajectory, found: TrajectoryFormat) -> list[str]:
    """Only where the two bodies are one do axes show; then those given should fit best."""
    tried = sorted(
        (_off_deg(path, reference, replace(found, axes=axes), body=False), axes) for axes in get_args(Axes)
    )
    (best_deg, axes), (second_deg, _) = tried[:2]
    assumed: Axes = "opencv"
    if best_deg > _CLEARLY * second_deg or axes == assumed:
        return []
    return [f"{path.name}: with {axes} axes it would fit the reference to {best_deg:.2g} deg: --axes {axes}?"]


def _off_deg(path: Path, reference: Trajectory, attempt: TrajectoryFormat, body: bool) -> float:
    estimate, _ = read_trajectory(path, attempt)
    try:
        world_deg, body_deg = rotation_errors_deg(estimate, reference)
    except EvaluationError as error:
        raise TrajectoryError(f"{path}: {error}") from None
    return body_deg if body else world_deg
