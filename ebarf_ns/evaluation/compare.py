"""Trajectories in files against each other, and which conventions a file follows, found by trying them."""

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, get_args

from ebarf_ns.errors import EvaluationError, TrajectoryError
from ebarf_ns.evaluation.trajectory_error import (
    ALIGNMENTS,
    errors_under_each_alignment,
    rotation_errors_by_positions_deg,
)
from ebarf_ns.geometry.trajectory import Trajectory
from ebarf_ns.geometry.trajectory_formats import (
    NOTHING_KNOWN,
    Axes,
    Quaternion,
    TrajectoryFormat,
    Transform,
    order_is_known,
    read_trajectory,
)

# The right convention is better than all others by this factor, or the motion cannot tell.
_CLEARLY = 0.5
_STILL_DEG = 0.01


def compare_files(estimate: Path, reference: Path, known: TrajectoryFormat = NOTHING_KNOWN) -> dict[str, Any]:
    """The errors of a trajectory against another under every alignment that is defined for them.

    The files are of any format that :func:`read_trajectory` knows; ``known`` is of the estimate. Raises
    :class:`EvaluationError` where no alignment is defined.
    """
    true, notes = read_trajectory(reference)
    if order_is_known(estimate, known):
        estimated, said = read_trajectory(estimate, known)
        said += _note_on_axes(estimate, true, known)
    else:
        estimated, said = read_by_reference(estimate, true, known)
    errors, reasons = errors_under_each_alignment(estimated, true)
    if not errors:
        raise EvaluationError(f"{estimate}: {next(iter(reasons.values()))}")
    comparison: dict[str, Any] = {alignment: None for alignment in ALIGNMENTS}
    for alignment, error in errors.items():
        comparison[alignment] = vars(error).copy()
        comparison["matched"] = comparison[alignment].pop("matched")
    notes = said + notes + [f"{alignment}: {reason}" for alignment, reason in reasons.items()]
    return {**comparison, "scale": errors["sim3"].scale if "sim3" in errors else None, "notes": notes}


def read_by_reference(
    path: Path, reference: Trajectory, known: TrajectoryFormat = NOTHING_KNOWN
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
    return trajectory, notes + _note_on_axes(path, reference, best)


def _note_on_axes(path: Path, reference: Trajectory, found: TrajectoryFormat) -> list[str]:
    """Only where the two bodies are one do axes show; then those given should fit best."""
    if found.axes:
        return []
    try:
        tried = sorted((_off_deg(path, reference, replace(found, axes=one), body=False), one) for one in get_args(Axes))
    except TrajectoryError:
        return []
    (best_deg, axes), (second_deg, _) = tried[:2]
    assumed: Axes = "opencv"
    if best_deg > _CLEARLY * second_deg or axes == assumed:
        return []
    return [f"{path.name}: with {axes} axes it would fit the reference to {best_deg:.2g} deg: --axes {axes}?"]


def _off_deg(path: Path, reference: Trajectory, attempt: TrajectoryFormat, body: bool) -> float:
    estimate, _ = read_trajectory(path, attempt)
    try:
        same_body_deg, other_body_deg = rotation_errors_by_positions_deg(estimate, reference)
    except EvaluationError as error:
        raise TrajectoryError(f"{path}: {error}; expected --quaternion and --transform, which cannot be told") from None
    return other_body_deg if body else same_body_deg
