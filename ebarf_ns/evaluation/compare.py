"""Comparison of trajectory files, and detection of a file's conventions by trying them."""

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, get_args

from ebarf_ns.errors import EvaluationError, TrajectoryError
from ebarf_ns.evaluation.trajectory_error import (
    ALIGNMENTS,
    errors_under_each_alignment,
    rotation_error_deg,
    rotation_errors_by_positions_deg,
)
from ebarf_ns.formats.trajectory_formats import (
    NOTHING_KNOWN,
    Axes,
    Quaternion,
    RawPoses,
    TrajectoryFormat,
    Transform,
    order_is_doubtful,
    read_raw,
    read_trajectory,
    trajectory_of,
)
from ebarf_ns.geometry.trajectory import Poses, Trajectory

# A convention is accepted only if its error is below all others by this factor.
_CLEARLY = 0.5
_STILL_DEG = 0.01
# A quaternion order that fits at least this well is not doubted.
_GOOD_DEG = 2.0
# Largest number of poses compared; longer trajectories are subsampled evenly.
_MOST = 2000


def compare_files(estimate: Path, reference: Path, known: TrajectoryFormat = NOTHING_KNOWN) -> dict[str, Any]:
    """The errors of a trajectory against a reference under every alignment that is defined.

    The files may have any format that :func:`read_trajectory` supports; ``known`` describes the estimate. Raises
    :class:`EvaluationError` if no alignment is defined.
    """
    true, notes = _reference(reference, estimate, known)
    estimated, said = read_beside_reference(estimate, true, known)
    errors, reasons = errors_under_each_alignment(estimated, true)
    if not errors:
        raise EvaluationError(f"{estimate}: {next(iter(reasons.values()))}")
    body_deg = rotation_error_deg(estimated, true, with_body=True)
    comparison: dict[str, Any] = {alignment: None for alignment in ALIGNMENTS}
    for alignment, error in errors.items():
        comparison[alignment] = {**vars(error), "rotation_deg_body": body_deg}
        comparison["matched"] = comparison[alignment].pop("matched")
    notes = said + notes + [f"{alignment}: {reason}" for alignment, reason in reasons.items()]
    return {**comparison, "scale": errors["sim3"].scale if "sim3" in errors else None, "notes": notes}


def _reference(path: Path, estimate: Path, known: TrajectoryFormat) -> tuple[Trajectory, list[str]]:
    """Read the reference; if its time unit is not stated, the estimate's span is used to infer it."""
    try:
        return read_trajectory(path)
    except TrajectoryError as problem:
        try:
            # The times do not depend on the quaternion order.
            span_us = _span_us(read_trajectory(estimate, replace(known, quaternion=known.quaternion or "xyzw"))[0])
        except TrajectoryError:
            raise problem from None
        return read_trajectory(path, span_us=span_us)


def read_beside_reference(
    path: Path,
    reference: Trajectory,
    known: TrajectoryFormat = NOTHING_KNOWN,
    span_us: tuple[int, int] | None = None,
) -> tuple[Trajectory, list[str]]:
    """Read a trajectory; if it does not state its quaternion order, find it by comparison with the reference.

    The usual order is kept unless another one fits clearly better. ``span_us`` is the span of the events, by default
    that of the reference. Also returns notes on what was found.
    """
    raw, span_us = read_raw(path, known), span_us or _span_us(reference)
    if order_is_doubtful(path, raw, known, span_us):
        return _read_by_reference(path, raw, reference, known, span_us)
    trajectory, notes = trajectory_of(path, raw, known, span_us)
    usual = replace(
        known, quaternion=known.quaternion or raw.quaternion or "xyzw", transform=known.transform or raw.transform
    )
    if raw.order_told or known.quaternion:
        return trajectory, notes + _note_on_axes(path, raw, reference, known, span_us)
    try:
        tried = _tried(path, raw, reference, known, span_us)
    except TrajectoryError:
        return trajectory, notes + _note_on_order(path, raw, reference, usual, span_us)
    alike = [one for one in tried if one[1].transform == usual.transform]
    (best_deg, best), usual_deg = tried[0], next(deg for deg, one in alike if one.quaternion == usual.quaternion)
    if best_deg > _CLEARLY * usual_deg or usual_deg < _GOOD_DEG:
        return trajectory, notes + _note_on_axes(path, raw, reference, known, span_us)
    if best != alike[0][1] or best_deg > _CLEARLY * alike[1][0]:
        flags = f"--quaternion {best.quaternion} --transform {best.transform}"
        notes.append(
            f"{path.name}: as {usual.quaternion}, {usual.transform} it is {usual_deg:.2g} deg off the reference, as "
            f"{best.quaternion}, {best.transform} it would be {best_deg:.2g} deg: {flags}?"
        )
        return trajectory, notes
    trajectory, notes = trajectory_of(path, raw, best, span_us)
    notes.append(
        f"{path.name}: quaternions as {best.quaternion}, which fits the reference to {best_deg:.2g} deg, as "
        f"{usual.quaternion} to {usual_deg:.2g} deg; --quaternion says otherwise"
    )
    return trajectory, notes + _note_on_axes(path, raw, reference, best, span_us)


def read_by_reference(
    path: Path, reference: Trajectory, known: TrajectoryFormat = NOTHING_KNOWN
) -> tuple[Trajectory, list[str]]:
    """Read a trajectory with the conventions under which its rotations match the reference.

    Quaternion order and transform direction are tried if ``known`` leaves them open, with any constant rotation between
    the two bodies; then the axes, without it. Raises :class:`TrajectoryError` if several conventions fit equally well:
    the motion then cannot distinguish them, and they must be given.
    """
    return _read_by_reference(path, read_raw(path, known), reference, known, _span_us(reference))


def _read_by_reference(
    path: Path, raw: RawPoses, reference: Trajectory, known: TrajectoryFormat, span_us: tuple[int, int]
) -> tuple[Trajectory, list[str]]:
    tried = _tried(path, raw, reference, known, span_us)
    best_deg, best = tried[0]
    if len(tried) > 1 and (best_deg > _CLEARLY * tried[1][0] or tried[1][0] < _STILL_DEG):
        second = tried[1][1]
        raise TrajectoryError(
            f"{path}: rotations are {best_deg:.2g} deg from the reference as {best.quaternion} {best.transform} and "
            f"{tried[1][0]:.2g} deg as {second.quaternion} {second.transform}; expected --quaternion and --transform, "
            "which this motion cannot tell"
        )
    trajectory, notes = trajectory_of(path, raw, best, span_us)
    notes.append(f"{path.name}: {best.quaternion}, {best.transform} fits the reference to {best_deg:.2g} deg")
    return trajectory, notes + _note_on_axes(path, raw, reference, best, span_us)


def _span_us(trajectory: Trajectory) -> tuple[int, int]:
    return int(trajectory.t_us[0]), int(trajectory.t_us[-1])


def _tried(
    path: Path, raw: RawPoses, reference: Trajectory, known: TrajectoryFormat, span_us: tuple[int, int]
) -> list[tuple[float, TrajectoryFormat]]:
    """Errors of all conventions that are left open, best first."""
    quaternions = (known.quaternion,) if known.quaternion else get_args(Quaternion)
    transforms = (known.transform,) if known.transform else get_args(Transform)
    tried: list[tuple[float, TrajectoryFormat]] = []
    for quaternion, transform in product(quaternions, transforms):
        attempt = replace(known, quaternion=quaternion, transform=transform)
        tried.append((_off_deg(path, raw, reference, attempt, span_us, body=True), attempt))
    return sorted(tried, key=lambda one: one[0])


def _note_on_order(
    path: Path, raw: RawPoses, reference: Trajectory, usual: TrajectoryFormat, span_us: tuple[int, int]
) -> list[str]:
    """Return a note if another quaternion order fits better, by rotations alone, since positions cannot be aligned.

    Rotations can only tell if both trajectories are of the same body.
    """
    tried = []
    try:
        for quaternion in get_args(Quaternion):
            estimate, _ = trajectory_of(path, raw, replace(usual, quaternion=quaternion), span_us)
            tried.append((rotation_error_deg(estimate, reference), quaternion))
    except (TrajectoryError, EvaluationError):
        return []
    (best_deg, best), (second_deg, _) = sorted(tried)[:2]
    if best == usual.quaternion or best_deg > _CLEARLY * second_deg or second_deg < _STILL_DEG:
        return []
    return [f"{path.name}: as {best} it would fit the reference to {best_deg:.2g} deg: --quaternion {best}?"]


def _note_on_axes(
    path: Path, raw: RawPoses, reference: Trajectory, found: TrajectoryFormat, span_us: tuple[int, int]
) -> list[str]:
    """Return a note if other axes fit better, which only shows if both trajectories are of the same body."""
    if found.axes:
        return []
    try:
        tried = sorted(
            (_off_deg(path, raw, reference, replace(found, axes=one), span_us, body=False), one)
            for one in get_args(Axes)
        )
    except TrajectoryError:
        return []
    (best_deg, axes), (second_deg, _) = tried[:2]
    assumed: Axes = "opencv"
    if best_deg > _CLEARLY * second_deg or axes == assumed:
        return []
    return [f"{path.name}: with {axes} axes it would fit the reference to {best_deg:.2g} deg: --axes {axes}?"]


def _off_deg(
    path: Path,
    raw: RawPoses,
    reference: Trajectory,
    attempt: TrajectoryFormat,
    span_us: tuple[int, int],
    body: bool,
) -> float:
    estimate, _ = trajectory_of(path, raw, attempt, span_us)
    every = -(-len(estimate.t_us) // _MOST)
    estimate = Trajectory(estimate.t_us[::every], Poses(*(column[::every] for column in estimate.poses)))
    try:
        same_body_deg, other_body_deg = rotation_errors_by_positions_deg(estimate, reference)
    except EvaluationError as error:
        raise TrajectoryError(f"{path}: {error}; expected --quaternion and --transform, which cannot be told") from None
    return other_body_deg if body else same_body_deg
