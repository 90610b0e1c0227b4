"""Errors of a trajectory against a reference, as computed by the evo library."""

import warnings
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from evo.core.geometry import GeometryException, umeyama_alignment
from jaxtyping import Float, Int64
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from ebarf_ns.errors import EvaluationError
from ebarf_ns.geometry.so3 import quat_wxyz_multiply, rotate
from ebarf_ns.geometry.trajectory import Poses, Trajectory, interpolate, within_span

# Motion counts as a line if its extent across the main direction is below this share of that along it.
_THINNEST = 0.01
_ALTERNATIONS = 20
Alignment = Literal["se3", "sim3", "orientation"]
ALIGNMENTS: dict[Alignment, str] = {"sim3": "", "se3": "_se3", "orientation": "_orientation"}
"""Suffix of a result's name for each alignment."""


@dataclass(frozen=True)
class TrajectoryError:
    """Errors after one alignment of the estimate to the reference."""

    ate_m: float
    """RMS position error."""
    rotation_deg: float
    """RMS rotation error after the world rotation that fits the rotations best, not that of ate_m."""
    ape_full: float
    """Mean of evo's unit-less full transformation error, the number of the E-BARF paper's Table 2."""
    scale: float
    matched: int


def trajectory_error(estimate: Trajectory, reference: Trajectory, alignment: Alignment) -> TrajectoryError:
    """Compare at the estimate's times within the reference's span, where the reference is interpolated.

    ``se3`` and ``sim3`` align the positions (Umeyama 1991). ``orientation`` rotates by the mean difference of the
    rotations and fits position and scale, which is also defined for motion along a line. Raises
    :class:`EvaluationError` if the alignment is undefined: fewer than 3 poses, no motion, or for Umeyama's a line.
    """
    return _error(estimate, reference, alignment, rotation_error_deg(estimate, reference))


class _Path(NamedTuple):
    """Matched poses; evo's own path is a list of matrices, and slow for 100,000 of them."""

    position: Float[np.ndarray, "poses 3"]
    rotation: Rotation


class _Similarity(NamedTuple):
    """x -> scale R x + shift."""

    rotation: Rotation
    shift: Float[np.ndarray, "3"]
    scale: float

    def __call__(self, path: _Path) -> _Path:
        return _Path(self.scale * self.rotation.apply(path.position) + self.shift, self.rotation * path.rotation)


def _error(estimate: Trajectory, reference: Trajectory, alignment: Alignment, rotation_deg: float) -> TrajectoryError:
    estimated, true = _matched(estimate, reference)
    if alignment == "orientation":
        aligned_by = _align_by_orientation(estimated, true)
    else:
        aligned_by = _umeyama(estimated, true, with_scale=alignment == "sim3")
    aligned = aligned_by(estimated)
    apart = np.linalg.norm(aligned.position - true.position, axis=1)
    # The Frobenius norm of a rotation by an angle minus the identity.
    turned = np.sqrt(8) * np.sin((aligned.rotation.inv() * true.rotation).magnitude() / 2)
    return TrajectoryError(
        ate_m=float(np.sqrt(np.mean(apart**2))),
        rotation_deg=rotation_deg,
        ape_full=float(np.hypot(turned, apart).mean()),
        scale=aligned_by.scale,
        matched=len(apart),
    )


def _umeyama(estimated: _Path, true: _Path, with_scale: bool) -> _Similarity:
    """Raises :class:`EvaluationError` for positions on a line, which leave rotations about it open."""
    for path in (estimated, true):
        extent = np.linalg.svd(path.position - path.position.mean(axis=0), compute_uv=False)
        if extent[1] <= _THINNEST * extent[0]:
            raise EvaluationError(
                f"the trajectory cannot be aligned to the reference: the {len(path.position)} matched positions of one "
                "lie on a line or in a point, expected motion in at least 2 directions"
            )
    try:
        rotation, shift, scale = umeyama_alignment(estimated.position.T, true.position.T, with_scale)
    except GeometryException as error:
        raise EvaluationError(f"the trajectory cannot be aligned to the reference: {error}") from None
    return _Similarity(Rotation.from_matrix(rotation), shift, float(scale))


def _align_by_orientation(estimated: _Path, true: _Path) -> _Similarity:
    """Rotates by the mean difference of the rotations; raises :class:`EvaluationError` without motion."""
    world = (true.rotation * estimated.rotation.inv()).mean()
    moved = world.apply(estimated.position)
    offset, goal = moved - moved.mean(axis=0), true.position - true.position.mean(axis=0)
    still = 1e-12 * max(float(np.abs(moved).max()), float(np.abs(true.position).max()), 1e-300)
    if np.abs(offset).max() <= still or np.abs(goal).max() <= still:
        raise EvaluationError("the trajectory or its reference does not move, expected motion to align")
    scale = float((offset * goal).sum() / (offset**2).sum())
    if scale <= 0:
        raise EvaluationError("the trajectory moves against its reference, no positive scale aligns them")
    return _Similarity(world, true.position.mean(axis=0) - scale * moved.mean(axis=0), scale)


def rotation_error_deg(estimate: Trajectory, reference: Trajectory, with_body: bool = False) -> float:
    """The rotation error of :class:`TrajectoryError`, which needs no motion; ``with_body``: a constant rotation of the
    body is fitted as well as that of the world.

    Raises :class:`EvaluationError` for fewer than 3 poses within the reference's span.
    """
    estimated, true = _matched(estimate, reference)
    return _rotation_error_deg(estimated.rotation, true.rotation, with_body)


def rotation_errors_by_positions_deg(estimate: Trajectory, reference: Trajectory) -> tuple[float, float]:
    """Rotation errors in the world to which the positions are aligned, without and with one rotation for the body.

    Some wrong quaternion orders give rotations that are right up to a rotation of world and body; only the positions
    distinguish them. Raises :class:`EvaluationError` if the positions are on a line.
    """
    estimated, true = _matched(estimate, reference)
    aligned = _umeyama(estimated, true, with_scale=True)(estimated)
    difference = aligned.rotation.inv() * true.rotation
    return _spread_deg(difference), _spread_deg(difference.mean().inv() * difference)


def _spread_deg(rotations: Rotation) -> float:
    return float(np.degrees(np.sqrt(np.mean(rotations.magnitude() ** 2))))


def _rotation_error_deg(estimate: Rotation, true: Rotation, with_body: bool) -> float:
    """RMSE of true = world * estimate * body with the best world rotation and, if requested, the best body rotation."""
    body = _body(estimate, true) if with_body else Rotation.identity()
    world = (true * (estimate * body).inv()).mean()
    for _ in range(_ALTERNATIONS if with_body else 0):
        body = ((world * estimate).inv() * true).mean()
        world = (true * (estimate * body).inv()).mean()
    return _spread_deg((world * estimate * body).inv() * true)


def _body(estimate: Rotation, true: Rotation) -> Rotation:
    """The body rotation from relative rotations, which do not depend on the world (hand-eye calibration)."""
    lag = max(1, len(estimate) // 10)
    of_estimate, of_true = ((path[:-lag].inv() * path[lag:]).as_rotvec() for path in (estimate, true))
    if min(np.linalg.norm(of_estimate), np.linalg.norm(of_true)) < 1e-9:
        return Rotation.identity()
    with warnings.catch_warnings():
        # Rotations about a single axis leave the rotation about it open; the alternation then finds it.
        warnings.simplefilter("ignore")
        return Rotation.align_vectors(of_estimate, of_true)[0]


def _matched(estimate: Trajectory, reference: Trajectory) -> tuple[_Path, _Path]:
    t_us, reference_t_us = estimate.t_us.numpy(), reference.t_us.numpy()
    inside = (t_us >= reference_t_us[0]) & (t_us <= reference_t_us[-1])
    if inside.sum() < 3:
        raise EvaluationError(
            f"{inside.sum()} of {len(t_us)} poses lie within the reference's span, {reference_t_us[0]} to "
            f"{reference_t_us[-1]} us; expected at least 3"
        )
    # Relative times are exact in float64.
    t = (t_us[inside] - reference_t_us[0]).astype(float)
    reference_t = (reference_t_us - reference_t_us[0]).astype(float)
    reference_position, reference_quat_wxyz = (column.double().numpy() for column in reference.poses)
    position = np.stack([np.interp(t, reference_t, axis) for axis in reference_position.T], axis=1)
    rotation = Slerp(reference_t, Rotation.from_quat(reference_quat_wxyz[:, [1, 2, 3, 0]]))(t)
    estimated_position, estimated_quat_wxyz = (column.double().numpy()[inside] for column in estimate.poses)
    return (
        _Path(estimated_position, Rotation.from_quat(estimated_quat_wxyz[:, [1, 2, 3, 0]])),
        _Path(position, rotation),
    )


def aligned_positions(estimate: Trajectory, reference: Trajectory) -> Float[np.ndarray, "keyframes 3"]:
    """The estimate's positions aligned by orientation and scale, for plots; unchanged if that is undefined."""
    try:
        estimated, true = _matched(estimate, reference)
        return _align_by_orientation(estimated, true)(estimated).position
    except EvaluationError:
        return estimate.poses.position.double().numpy()


def trajectory_results(estimate: Trajectory, reference: Trajectory) -> dict[str, Any]:
    """The results of a trajectory: its errors under each alignment, None where it is undefined.

    The rotation error needs only 3 matching poses, even without translation.
    """
    errors, _ = errors_under_each_alignment(estimate, reference)
    try:
        rotation_deg = rotation_error_deg(estimate, reference)
    except EvaluationError:
        rotation_deg = None
    results: dict[str, Any] = {"alignment": "sim3", "rotation_deg": rotation_deg}
    for alignment, suffix in ALIGNMENTS.items():
        error = errors.get(alignment)
        results |= {f"ate_m{suffix}": error and error.ate_m, f"scale{suffix}": error and error.scale}
    return {**results, "ape_full": errors["se3"].ape_full if "se3" in errors else None}


def errors_under_each_alignment(
    estimate: Trajectory, reference: Trajectory
) -> tuple[dict[Alignment, TrajectoryError], dict[Alignment, str]]:
    """The errors of each defined alignment, and the reason for each undefined one."""
    errors, reasons = {}, {}
    try:
        rotation_deg = rotation_error_deg(estimate, reference)
    except EvaluationError as problem:
        return {}, dict.fromkeys(ALIGNMENTS, str(problem))
    for alignment in ALIGNMENTS:
        try:
            errors[alignment] = _error(estimate, reference, alignment, rotation_deg)
        except EvaluationError as problem:
            reasons[alignment] = str(problem)
    return errors, reasons


@dataclass(frozen=True)
class ErrorsOverTime:
    """Errors per pose, after one alignment of positions (sim3, else by orientation and scale) and one of rotations."""

    t_us: Int64[np.ndarray, "poses"]
    position_m: Float[np.ndarray, "poses"]
    rotation_deg: Float[np.ndarray, "poses"]


def errors_over_time(estimate: Trajectory, reference: Trajectory) -> ErrorsOverTime | None:
    """The error of each pose within the reference's span; None if no alignment is defined."""
    try:
        estimated, true = _matched(estimate, reference)
        aligned = _aligned(estimated, true)(estimated)
    except EvaluationError:
        return None
    world = (true.rotation * estimated.rotation.inv()).mean()
    t_us = estimate.t_us.numpy()
    inside = (t_us >= int(reference.t_us[0])) & (t_us <= int(reference.t_us[-1]))
    return ErrorsOverTime(
        t_us[inside],
        np.linalg.norm(aligned.position - true.position, axis=1),
        np.degrees(((world * estimated.rotation).inv() * true.rotation).magnitude()),
    )


def _aligned(estimated: _Path, true: _Path) -> _Similarity:
    """The sim3 alignment, or that by orientation and scale where it is undefined."""
    try:
        return _umeyama(estimated, true, with_scale=True)
    except EvaluationError:
        return _align_by_orientation(estimated, true)


def reference_in_estimates_world(estimate: Trajectory, reference: Trajectory, t_us: Int64[Tensor, "times"]) -> Poses:
    """The reference's poses at ``t_us``, moved into the estimate's world by the inverse of the sim3 alignment.

    For frames outside the estimate's span. For motion along a line, it aligns by orientation. Raises
    :class:`EvaluationError` if that is undefined too, and for times outside the reference's span.
    """
    outside = t_us[~within_span(t_us, reference.t_us)]
    if len(outside):
        raise EvaluationError(
            f"no reference pose at {int(outside[0])} us, expected a time from {int(reference.t_us[0])} to "
            f"{int(reference.t_us[-1])} us, the reference's span"
        )
    aligned_by = _aligned(*_matched(estimate, reference))
    poses = interpolate(reference.t_us, reference.poses, t_us)
    back = torch.from_numpy(aligned_by.rotation.inv().as_quat()[[3, 0, 1, 2]]).expand(len(t_us), 4)
    position = rotate(back, poses.position - torch.from_numpy(aligned_by.shift)) / aligned_by.scale
    return Poses(position, quat_wxyz_multiply(back, poses.quat_wxyz))
