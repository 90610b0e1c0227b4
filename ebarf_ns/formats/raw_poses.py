"""Poses as stored in a file, before conventions are applied, and the conventions that a file may not give."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from ebarf_ns.errors import TrajectoryError

TimeUnit = Literal["s", "ms", "us", "ns"]
Quaternion = Literal["xyzw", "wxyz", "yzwx"]
Transform = Literal["camera-to-world", "world-to-camera"]
Axes = Literal["opencv", "opengl", "llff"]

_UNIT_LENGTH = 1e-3
"""A larger deviation from unit length is not rounding."""
_DIGITS = 30


@dataclass(frozen=True)
class TrajectoryFormat:
    """Conventions of a trajectory file, for what the file does not give."""

    pose_time_unit: TimeUnit | None = None
    """Unit of the times; by default recognised from their spacing."""
    quaternion: Quaternion | None = None
    """Order of the quaternion columns: TUM's xyzw, wxyz, or the yzwx of some files of DEVO and DEIO."""
    transform: Transform | None = None
    """Direction of the poses; by default world-to-camera for COLMAP and camera-to-world for all others."""
    axes: Axes | None = None
    """Camera axes; by default LLFF's for LLFF and OpenCV's for all others."""
    pose_times: Path | None = None
    """File with a time per pose, for formats without times (KITTI, LLFF, COLMAP): lines "time" or "name time"."""


NOTHING_KNOWN = TrajectoryFormat()


@dataclass(frozen=True)
class RawPoses:
    """A file's content before conventions are applied."""

    format: str
    times: list[Decimal]
    position: Float[np.ndarray, "poses 3"]
    rotation: Float[np.ndarray, "poses 4"] | Float[np.ndarray, "poses 3 3"]
    """Quaternions in the file's order, or matrices."""
    quaternion: Quaternion | None = None
    """Order given by the file or its format; None: not given."""
    transform: Transform = "camera-to-world"
    axes: Axes = "opencv"
    time_unit: TimeUnit | None = None
    pointed: bool = False
    """Whether times are written with a decimal point."""
    places: tuple[str, ...] = ()
    """Location of each pose for messages, such as the line of a text file."""
    notes: tuple[str, ...] = ()
    unclear: str = ""
    """What the file says of the order of its quaternions without giving it."""

    def place(self, path: Path, pose: int) -> str:
        """Location of a pose for messages."""
        return self.places[pose] if self.places else f"{path}: pose {pose}"

    @property
    def order_told(self) -> bool:
        """Whether the file gives the order of its quaternions, or needs none."""
        return self.rotation.ndim == 3 or self.quaternion is not None


def number(text: str) -> Decimal | None:
    """Parse a finite number of reasonable size, or return None."""
    try:
        value = Decimal(text)
    except InvalidOperation:
        return None
    return value if value.is_finite() and value.adjusted() < _DIGITS else None


def check_lengths(quaternions: Float[np.ndarray, "poses 4"], places: Sequence[str]) -> None:
    """Raise :class:`TrajectoryError` unless all quaternions have unit length."""
    length = np.linalg.norm(quaternions, axis=1)
    if (wrong := np.abs(length - 1) > _UNIT_LENGTH).any():
        k = int(wrong.argmax())
        raise TrajectoryError(f"{places[k]}: the quaternion has length {length[k]:.6g}, expected 1")


def rotations(
    path: Path, matrices: Float[np.ndarray, "poses 3 3"], places: tuple[str, ...] = ()
) -> Float[np.ndarray, "poses 3 3"]:
    """Return the matrices; raises :class:`TrajectoryError` if one is not a rotation."""
    off = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = ~(off <= 10 * _UNIT_LENGTH)
    wrong[~wrong] = np.linalg.det(matrices[~wrong]) < 0
    if wrong.any():
        k = int(wrong.argmax())
        place = f"{places[k]}: the matrix" if places else f"{path}: the matrix of pose {k}"
        raise TrajectoryError(f"{place} is not a rotation (off by {off[k]:.3g}), expected one")
    return matrices


def moving(
    path: Path, matrices: Float[np.ndarray, "poses rows 4"], places: tuple[str, ...] = ()
) -> tuple[Float[np.ndarray, "poses 3"], Float[np.ndarray, "poses 3 3"]]:
    """Positions and rotations of 3x4 or 4x4 matrices; the last row of the latter must be 0 0 0 1."""
    if matrices.shape[1] == 4:
        wrong = ~(np.abs(matrices[:, 3] - [0, 0, 0, 1]) <= _UNIT_LENGTH).all(axis=1)
        if wrong.any():
            k = int(wrong.argmax())
            place = f"{places[k]}: the last row" if places else f"{path}: the last row of matrix {k}"
            row = " ".join(f"{value:g}" for value in matrices[k, 3])
            raise TrajectoryError(
                f"{place} is {row}, expected 0 0 0 1 of a 4x4 matrix{', or a line of names above' if places else ''}"
            )
    return matrices[:, :3, 3], rotations(path, matrices[:, :3, :3], places)


def times_beside(path: Path, count: int, names: list[str] | None, known: TrajectoryFormat) -> list[Decimal]:
    """Times from the ``pose_times`` file, matched by name if it has names."""
    if known.pose_times is None:
        raise TrajectoryError(f"{path}: has no times, expected --pose-times with a line for each of its {count} poses")
    times = _listed(known.pose_times)
    if names is not None and named_beside(names, known):
        return [times[Path(name).name] for name in names]
    if len(times) != count:
        raise TrajectoryError(
            f"{known.pose_times}: {len(times)} times, expected one for each of the {count} poses of {path}"
        )
    return list(times.values())


def named_beside(names: list[str], known: TrajectoryFormat) -> bool:
    """Whether the ``pose_times`` file gives the times by these names."""
    times = _listed(known.pose_times) if known.pose_times else {}
    return all(Path(name).name in times for name in names)


def by_number(name: str) -> list[str | int]:
    """Key that sorts names in order of the numbers within them: 2 before 10."""
    return [int(part) if k % 2 else part for k, part in enumerate(re.split(r"(\d+)", name))]


def _listed(path: Path) -> dict[str, Decimal]:
    """Times by name, or by index without names."""
    times: dict[str, Decimal] = {}
    try:
        if path.suffix == ".npy":
            return {str(k): Decimal(str(time)) for k, time in enumerate(np.load(path).ravel().tolist())}
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, ValueError, InvalidOperation) as error:
        reason = getattr(error, "strerror", None) or error
        raise TrajectoryError(f"{path}: cannot be read ({reason}), expected one time per line") from None
    first = True
    for line_number, line in enumerate(lines, start=1):
        fields = line.split("#")[0].replace(",", " ").split()
        if not fields:
            continue
        # "time", "time name", or "name time", whose name may be a number.
        values = [number(field) for field in fields[:2]]
        place = len(values) - 1 if values[-1] is not None else 0
        time = values[place]
        if time is None:
            # The fields of a header line do not begin with a digit.
            if first and not any(field[0].isdigit() for field in fields[:2]):
                first = False
                continue
            raise TrajectoryError(f"{path}:{line_number}: {line!r:.60}, expected a time or a name and a time")
        first = False
        name = Path(fields[1 - place]).name if len(fields) > 1 else str(len(times))
        if name in times:
            raise TrajectoryError(f"{path}:{line_number}: {name} again, expected one time for each name")
        times[name] = time
    return times
