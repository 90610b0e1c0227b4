"""Trajectories as other programs write them, into ours: int64 microseconds, camera to world, OpenCV axes.

What a file says is taken; what can be recognised is, and is reported; what cannot is asked for by an option. The order
of a quaternion's columns cannot: every order is a rotation as smooth as the right one.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import IO, Literal, get_args

import h5py
import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ebarf_ns.errors import TrajectoryError
from ebarf_ns.files import opened_npz
from ebarf_ns.geometry.trajectory import Poses, Trajectory, check_keyframes

TimeUnit = Literal["s", "ms", "us", "ns"]
Quaternion = Literal["xyzw", "wxyz", "yzwx"]
Transform = Literal["camera-to-world", "world-to-camera"]
Axes = Literal["opencv", "opengl", "llff"]

_US: dict[TimeUnit, Decimal] = {"s": Decimal(10**6), "ms": Decimal(1000), "us": Decimal(1), "ns": Decimal("0.001")}
# Of the file's axes, what x, y and z of OpenCV are: LLFF has down, right, back.
_AXES: dict[Axes, np.ndarray] = {
    "opencv": np.eye(3),
    "opengl": np.diag([1.0, -1.0, -1.0]),
    "llff": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
}
_SPACINGS_S = (1e-4, 10.0)
_SINCE_1970_US, _SINCE_1970_NS = 1e14, 1e17
_UNIT_LENGTH = 1e-3
_DIGITS = 30


@dataclass(frozen=True)
class TrajectoryFormat:
    """What to know of a trajectory's file where the file itself does not say."""

    pose_time_unit: TimeUnit | None = None
    """Of its times; recognised from their spacing where not given."""
    quaternion: Quaternion | None = None
    """Order of the quaternion's columns: TUM's xyzw, wxyz, or the yzwx of some files of DEVO and DEIO."""
    transform: Transform | None = None
    """Of its poses; COLMAP's are world-to-camera, all others camera-to-world where not given."""
    axes: Axes | None = None
    """Of its cameras; LLFF's are its own, all others OpenCV's where not given."""
    pose_times: Path | None = None
    """A time for each pose, for files without (KITTI, LLFF, COLMAP): a line each, "time" or "name time"."""


NOTHING_KNOWN = TrajectoryFormat()


@dataclass(frozen=True)
class _Raw:
    """A file's content before conventions are applied."""

    format: str
    times: list[Decimal]
    position: Float[np.ndarray, "poses 3"]
    rotation: Float[np.ndarray, "poses 4"] | Float[np.ndarray, "poses 3 3"]
    """Quaternions in the file's order, or matrices."""
    quaternion: Quaternion | None = None
    """As the format has it; None: not to be known."""
    transform: Transform = "camera-to-world"
    axes: Axes = "opencv"
    time_unit: TimeUnit | None = None


def read_trajectory(path: Path, known: TrajectoryFormat = NOTHING_KNOWN) -> tuple[Trajectory, list[str]]:
    """Poses in order of time, and what was recognised; raises :class:`TrajectoryError`.

    TUM text in any unit, TUM-VIE's ``mocap_data.txt``, EDS' ground truth, KITTI, COLMAP's ``images.txt`` and
    ``images.bin`` (or the folder of either), LLFF's ``poses_bounds.npy``, Robust e-NeRF's ``camera_poses.npz``,
    M3ED's ``*_pose_gt.h5``.
    """
    raw = _read(path, known)
    unit = known.pose_time_unit or raw.time_unit or _recognised_unit(path, raw.times)
    quaternion = known.quaternion or raw.quaternion
    if raw.rotation.ndim == 2 and quaternion is None:
        raise TrajectoryError(
            f"{path}: times in {unit} with a point and no line of names are how DEVO and DEIO write quaternions as "
            "qy qz qw qx; expected --quaternion yzwx for that, or xyzw"
        )
    transform, axes = known.transform or raw.transform, known.axes or raw.axes
    t_us = torch.tensor([_in_us(path, time, unit) for time in raw.times], dtype=torch.int64)
    poses = _camera_to_world(raw, quaternion, transform, axes)
    order = torch.argsort(t_us, stable=True)
    trajectory = Trajectory(t_us[order], Poses(*(column[order] for column in poses)))
    try:
        check_keyframes(trajectory.t_us)
    except TrajectoryError as error:
        raise TrajectoryError(f"{path}: {error}") from None
    columns = "" if raw.rotation.ndim == 3 else f", quaternions {' '.join(quaternion or '')}"
    notes = [f"{path.name}: {raw.format}, {len(t_us)} poses, times in {unit}{columns}, {transform}, {axes} axes"]
    if not bool((order == torch.arange(len(order))).all()):
        notes.append(f"{path.name}: poses were not in order of time, and are sorted")
    return trajectory, notes


def order_is_known(path: Path, known: TrajectoryFormat) -> bool:
    """Whether the order of the quaternions is told by ``known``, by the file, or needs none."""
    raw = _read(path, known)
    return raw.rotation.ndim == 3 or bool(known.quaternion or raw.quaternion)


def _in_us(path: Path, time: Decimal, unit: TimeUnit) -> int:
    t_us = int((time * _US[unit]).to_integral_value())
    if abs(t_us) >= 1 << 61:
        raise TrajectoryError(f"{path}: time {time} in {unit} does not fit 64-bit microseconds, expected another unit")
    return t_us


def _recognised_unit(path: Path, times: list[Decimal]) -> TimeUnit:
    """The unit in which poses come a tenth of a millisecond to ten seconds apart."""
    spacing = float(np.median(np.abs(np.diff(np.array(times, dtype=float))))) if len(times) > 1 else 0.0
    units: tuple[TimeUnit, ...] = ("s", "us", "ns")
    fitting: list[TimeUnit] = [
        unit for unit in units if _SPACINGS_S[0] <= spacing * float(_US[unit]) * 1e-6 <= _SPACINGS_S[1]
    ]
    if fitting == ["us", "ns"] and float(max(times)) > _SINCE_1970_US:
        # A tenth of a second or more in microseconds, or as little as a tenth of a millisecond in nanoseconds: since
        # 1970, nanoseconds have grown by 18 digits, and microseconds by 15.
        fitting = ["ns"] if float(max(times)) > _SINCE_1970_NS else ["us"]
    if len(fitting) != 1:
        raise TrajectoryError(
            f"{path}: poses are {spacing:g} apart (median), which is a plausible spacing in "
            f"{' and in '.join(fitting) or 'no unit'}; expected --pose-time-unit"
        )
    return fitting[0]


def _camera_to_world(raw: _Raw, quaternion: Quaternion | None, transform: Transform, axes: Axes) -> Poses:
    if raw.rotation.ndim == 2:
        order = [(quaternion or "xyzw").index(name) for name in "xyzw"]
        rotation = Rotation.from_quat(raw.rotation[:, order])
    else:
        rotation = Rotation.from_matrix(raw.rotation)
    position = raw.position
    if transform == "world-to-camera":
        rotation = rotation.inv()
        position = -rotation.apply(position)
    rotation = rotation * Rotation.from_matrix(_AXES[axes])
    return Poses(torch.from_numpy(position.copy()), torch.from_numpy(rotation.as_quat()[:, [3, 0, 1, 2]].copy()))


def _read(path: Path, known: TrajectoryFormat) -> _Raw:
    if path.is_dir():
        models = [path / name for name in ("images.bin", "images.txt") if (path / name).is_file()]
        if not models:
            raise TrajectoryError(f"{path}: holds no images.bin or images.txt, expected a COLMAP model or a file")
        path = models[0]
    try:
        if path.suffix == ".npz":
            return _robust_e_nerf(path)
        if path.suffix == ".npy":
            return _llff(path, known)
        if path.suffix in (".h5", ".hdf5"):
            return _m3ed(path)
        if path.suffix == ".bin":
            return _colmap(path, _colmap_binary(path), known)
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError, ValueError, EOFError, struct.error, KeyError) as error:
        raise TrajectoryError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from None
    if path.name == "images.txt":
        return _colmap(path, _colmap_text(path, lines), known)
    return _text(path, lines, known)


def _text(path: Path, lines: list[str], known: TrajectoryFormat) -> _Raw:
    """TUM's eight columns, KITTI's twelve, or a 4x4 matrix, with or without a time before it."""
    rows: list[list[Decimal]] = []
    header, named, pointed = "", False, False
    for number, line in enumerate(lines, start=1):
        fields = line.split("#")[0].replace(",", " ").replace(";", " ").split()
        if not fields:
            header += "" if rows else line + "\n"
            continue
        values = [_number(field) for field in fields]
        if None in values:
            if rows or named:
                raise TrajectoryError(f"{path}:{number}: {line.strip()!r:.60} is no pose, expected numbers")
            header, named = header + line + "\n", True
            continue
        if rows and len(values) != len(rows[0]):
            raise TrajectoryError(f"{path}:{number}: {len(values)} columns, expected {len(rows[0])} as before")
        pointed |= "." in fields[0]
        rows.append([value for value in values if value is not None])
    if not rows:
        raise TrajectoryError(f"{path}: holds no poses")
    count = len(rows[0])
    if count == 8:
        return _tum(path, rows, header.lower(), pointed)
    if count in (12, 13, 16, 17):
        timed = count in (13, 17)
        numbers = np.array([row[timed:] for row in rows], float).reshape(len(rows), -1, 4)
        times = [row[0] for row in rows] if timed else _times(path, len(rows), None, known)
        return _Raw("matrices", times, numbers[:, :3, 3], _rotations(path, numbers[:, :3, :3]))
    raise TrajectoryError(f"{path}: {count} columns, expected 8 (TUM), or 12 or 16 (matrices) with or without a time")


def _number(text: str) -> Decimal | None:
    try:
        value = Decimal(text)
    except InvalidOperation:
        return None
    return value if value.is_finite() and value.adjusted() < _DIGITS else None


def _tum(path: Path, rows: list[list[Decimal]], header: str, pointed: bool) -> _Raw:
    numbers = np.array([row[1:] for row in rows], float)
    length = np.linalg.norm(numbers[:, 3:], axis=1)
    if (wrong := np.abs(length - 1) > _UNIT_LENGTH).any():
        k = int(wrong.argmax())
        raise TrajectoryError(f"{path}: the quaternion of pose {k} has length {length[k]:.6g}, expected 1")
    times = [row[0] for row in rows]
    unit: TimeUnit | None = next((one for one in ("ns", "us") if f"[{one}]" in header), None)
    unit = "s" if unit is None and ("[s]" in header or "[secs]" in header) else unit
    # "qx qy qz qw", or EuRoC's "q_RS_w [], q_RS_x [], ...".
    order = "".join(re.findall(r"\bq\w*?([wxyz])\b", header))
    said: Quaternion | None = next((one for one in get_args(Quaternion) if one == order), None)
    # Microseconds written as floats, without names, are the mark of one family of odometry.
    doubtful = pointed and (unit or _recognised_unit(path, times)) == "us"
    quaternion = said or (None if doubtful else "xyzw")
    return _Raw("TUM text", times, numbers[:, :3], numbers[:, 3:], quaternion, time_unit=unit)


def _rotations(path: Path, matrices: Float[np.ndarray, "poses 3 3"]) -> Float[np.ndarray, "poses 3 3"]:
    off = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = (off > 10 * _UNIT_LENGTH) | (np.linalg.det(matrices) < 0)
    if wrong.any():
        k = int(wrong.argmax())
        raise TrajectoryError(f"{path}: the matrix of pose {k} is no rotation (off by {off[k]:.3g}), expected one")
    return matrices


def _robust_e_nerf(path: Path) -> _Raw:
    with opened_npz(path) as file:
        times = [Decimal(int(t)) for t in file["T_wc_timestamp"]]
        position, rotation = file["T_wc_position"].astype(float), file["T_wc_orientation"].astype(float)
    return _Raw("Robust e-NeRF npz", times, position, rotation, "xyzw", time_unit="ns")


def _m3ed(path: Path) -> _Raw:
    """Chaney et al. 2023: ``Cn_T_C0`` brings points of the first event camera, which is the world, into the n-th."""
    with h5py.File(path, "r") as file:
        matrices, times = np.asarray(file["Cn_T_C0"], float), np.asarray(file["ts"])
    if matrices.shape != (len(times), 4, 4):
        raise TrajectoryError(f"{path}: Cn_T_C0 is of shape {matrices.shape}, expected ({len(times)}, 4, 4)")
    rotation = _rotations(path, matrices[:, :3, :3])
    times = [Decimal(str(time)) for time in times.tolist()]
    return _Raw("M3ED poses", times, matrices[:, :3, 3], rotation, None, "world-to-camera", time_unit="us")


def _llff(path: Path, known: TrajectoryFormat) -> _Raw:
    table = np.load(path).astype(float)
    if table.ndim != 2 or table.shape[1] not in (15, 17):
        raise TrajectoryError(f"{path}: an array of shape {table.shape}, expected LLFF's (poses, 17)")
    matrices = table[:, :15].reshape(-1, 3, 5)
    times = _times(path, len(table), None, known)
    return _Raw("LLFF", times, matrices[..., 3], _rotations(path, matrices[..., :3]), axes="llff")


Images = list[tuple[str, list[float]]]
"""COLMAP's: names, and qw qx qy qz tx ty tz of the world in the camera."""


def _colmap(path: Path, images: Images, known: TrajectoryFormat) -> _Raw:
    if not images:
        raise TrajectoryError(f"{path}: holds no image, expected a COLMAP model with some")
    images = sorted(images)
    numbers = np.array([pose for _, pose in images])
    times = _times(path, len(images), [name for name, _ in images], known)
    return _Raw("COLMAP model", times, numbers[:, 4:], numbers[:, :4], "wxyz", "world-to-camera")


def _colmap_text(path: Path, lines: list[str]) -> Images:
    """Two lines an image, of which the second lists its points, and may be empty."""
    lines = [line for line in lines if not line.startswith("#")]
    images = []
    for number, line in enumerate(lines[::2]):
        fields = line.split(maxsplit=9)
        if not fields:
            continue
        try:
            images.append((fields[9], [float(field) for field in fields[1:8]]))
        except (IndexError, ValueError):
            raise TrajectoryError(f"{path}: image {number}: {line!r:.60}, expected COLMAP's ten columns") from None
    return images


def _colmap_binary(path: Path) -> Images:
    images = []
    with path.open("rb") as file:
        (count,) = struct.unpack("<Q", file.read(8))
        for _ in range(count):
            _, *pose, _ = struct.unpack("<I7dI", file.read(64))
            name = _until_zero(file)
            (points,) = struct.unpack("<Q", file.read(8))
            if len(file.read(24 * points)) < 24 * points:
                raise struct.error(f"image {name} is cut short")
            images.append((name, list(pose)))
    return images


def _until_zero(file: IO[bytes]) -> str:
    name = b""
    while (byte := file.read(1)) != b"\0":
        if not byte:
            raise struct.error("a name is cut short")
        name += byte
    return name.decode()


def _times(path: Path, count: int, names: list[str] | None, known: TrajectoryFormat) -> list[Decimal]:
    """From the file that has them, by name where it has names."""
    if known.pose_times is None:
        raise TrajectoryError(f"{path}: has no times, expected --pose-times with a line for each of its {count} poses")
    times: dict[str, Decimal] = {}
    try:
        lines = known.pose_times.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise TrajectoryError(f"{known.pose_times}: cannot be read ({reason}), expected a time a line") from None
    for number, line in enumerate(lines, start=1):
        fields = line.split("#")[0].replace(",", " ").split()
        if not fields:
            continue
        # "time", "name time", where the name may be a number, or "time name".
        values = [_number(field) for field in fields[:2]]
        place = len(values) - 1 if values[-1] is not None else 0
        time = values[place]
        if time is None:
            if number == 1:
                continue
            raise TrajectoryError(f"{known.pose_times}:{number}: {line!r:.60}, expected a time or a name and a time")
        name = Path(fields[1 - place]).name if len(fields) > 1 else str(len(times))
        times[name] = time
    if names is not None and all(Path(name).name in times for name in names):
        return [times[Path(name).name] for name in names]
    if len(times) != count:
        raise TrajectoryError(
            f"{known.pose_times}: {len(times)} times, expected one for each of the {count} poses of {path}"
        )
    return list(times.values())
