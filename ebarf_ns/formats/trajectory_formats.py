"""Read trajectories of other programs, converted to int64 microseconds, camera-to-world, OpenCV axes.

Conventions given in a file are used; others are recognised and reported if possible, or asked for by an option. The
order of quaternion columns cannot be recognised: every order gives an equally smooth rotation.
"""

from __future__ import annotations

import struct
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import IO, Any

import h5py
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ebarf_ns.errors import TrajectoryError, did_you_mean
from ebarf_ns.files import opened_npz
from ebarf_ns.formats.raw_poses import (
    NOTHING_KNOWN,
    Axes,
    Quaternion,
    RawPoses,
    TimeUnit,
    TrajectoryFormat,
    Transform,
    by_number,
    check_lengths,
    moving,
    named_beside,
    rotations,
    times_beside,
)
from ebarf_ns.formats.trajectory_text import read_text
from ebarf_ns.formats.trajectory_units import US, recognised_unit
from ebarf_ns.geometry.trajectory import Poses, Trajectory

__all__ = [
    "NOTHING_KNOWN",
    "Axes",
    "Quaternion",
    "RawPoses",
    "TrajectoryFormat",
    "Transform",
    "read_raw",
    "read_trajectory",
    "trajectory_of",
]

# OpenCV's x, y and z axes as columns, in the axes of the file: LLFF has down, right, back.
_AXES: dict[Axes, np.ndarray] = {
    "opencv": np.eye(3),
    "opengl": np.diag([1.0, -1.0, -1.0]),
    "llff": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
}

_OF_ROBUST_E_NERF = ("T_wc_timestamp", "T_wc_position", "T_wc_orientation")
_READ = "poses as text in UTF-8, npy, npz (Robust e-NeRF), h5 (M3ED) or a COLMAP model"
_KINDS = {
    b"\xff\xfe": "text in UTF-16", b"\xfe\xff": "text in UTF-16", b"MATLAB": "a MATLAB file", b"#ROSBAG": "a ROS bag",
    b"\x1f\x8b": "compressed with gzip", b"PK\x03\x04": "a zip or npz file", b"\x89HDF": "an HDF5 file",
}  # fmt: skip


def read_trajectory(
    path: Path, known: TrajectoryFormat = NOTHING_KNOWN, span_us: tuple[int, int] | None = None
) -> tuple[Trajectory, list[str]]:
    """Read poses, sorted by time, and notes on what was recognised; raises :class:`TrajectoryError`.

    TUM text in any unit, text with a line that names its columns, TUM-VIE's ``mocap_data.txt``, EuRoC's ``data.csv``,
    EDS' ground truth, KITTI, COLMAP's ``images.txt`` and ``images.bin`` (or the folder of either), matrices as npy,
    LLFF's ``poses_bounds.npy``, Robust e-NeRF's ``camera_poses.npz``, M3ED's ``*_pose_gt.h5``. ``span_us``, the span of
    the events or a reference, helps to recognise the time unit.
    """
    return trajectory_of(path, read_raw(path, known), known, span_us)


def trajectory_of(
    path: Path, raw: RawPoses, known: TrajectoryFormat = NOTHING_KNOWN, span_us: tuple[int, int] | None = None
) -> tuple[Trajectory, list[str]]:
    """Convert raw poses, see :func:`read_trajectory`."""
    _check_numbers(path, raw)
    unit = known.pose_time_unit or raw.time_unit or recognised_unit(path, raw.times, span_us)
    quaternion, doubtful = known.quaternion or raw.quaternion, False
    if not raw.order_told and quaternion is None:
        quaternion, doubtful = "xyzw", order_is_doubtful(path, raw, known, span_us)
    if doubtful and raw.unclear:
        raise TrajectoryError(
            f"{path}: {raw.unclear}, expected --quaternion, or a line with the names qx, qy, qz, qw in their order"
        )
    if doubtful:
        raise TrajectoryError(
            f"{path}: times in {unit} with a point and no line of names are how DEVO and DEIO write quaternions as "
            "qy qz qw qx; expected --quaternion yzwx for that, or xyzw"
        )
    transform, axes = known.transform or raw.transform, known.axes or raw.axes
    t_us = torch.tensor([_in_us(path, time, unit) for time in raw.times], dtype=torch.int64)
    poses = _camera_to_world(raw, quaternion, transform, axes)
    order = torch.argsort(t_us, stable=True)
    trajectory = Trajectory(t_us[order], Poses(*(column[order] for column in poses)))
    for before, after in pairwise(order.tolist()):
        if t_us[before] == t_us[after]:
            raise TrajectoryError(
                f"{raw.place(path, after)}: times {raw.times[before]:f} and {raw.times[after]:f} in {unit} are in one "
                "microsecond, expected a microsecond or more between poses"
            )
    columns = "" if raw.rotation.ndim == 3 else f", quaternions {' '.join(quaternion or '')}"
    notes = [f"{path.name}: {raw.format}, {len(t_us)} poses, times in {unit}{columns}, {transform}, {axes} axes"]
    earlier = torch.nonzero(t_us.diff() < 0).flatten().tolist()
    if earlier:
        place = raw.place(path, earlier[0] + 1).removeprefix(f"{path.parent}/")
        others = f", as {len(earlier) - 1} others," if len(earlier) > 1 else ""
        notes.append(
            f"{place}{others} is earlier than the pose before; poses were not in order of time, and are sorted"
        )
    return trajectory, [*notes, *raw.notes]


def order_is_doubtful(
    path: Path, raw: RawPoses, known: TrajectoryFormat, span_us: tuple[int, int] | None = None
) -> bool:
    """Whether the quaternion order is ambiguous: names of columns or comments that do not give it, or microseconds
    written as floats, without either, which are typical of one family of odometry."""
    if raw.order_told or known.quaternion or not (raw.pointed or raw.unclear):
        return False
    if raw.unclear:
        return True
    return (known.pose_time_unit or raw.time_unit or recognised_unit(path, raw.times, span_us)) == "us"


def _check_numbers(path: Path, raw: RawPoses) -> None:
    """Raise :class:`TrajectoryError` unless there are at least two poses of finite numbers, with distinct times."""
    if len(raw.times) < 2:
        raise TrajectoryError(f"{path}: holds {len(raw.times)} pose{'s'[: not raw.times]}, expected 2 or more")
    values = np.concatenate([raw.position, raw.rotation.reshape(len(raw.times), -1)], axis=1)
    finite = np.isfinite(values).all(axis=1) & [time.is_finite() for time in raw.times]
    if not finite.all():
        raise TrajectoryError(f"{raw.place(path, int(finite.argmin()))}: a number is not finite, expected a pose")
    seen: dict[Decimal, int] = {}
    for k, time in enumerate(raw.times):
        if (first := seen.setdefault(time, k)) != k:
            where = "" if first == k - 1 else f", as in {raw.place(path, first).removeprefix(f'{path}:').strip()}"
            where = where.replace("as in ", "as in line ") if raw.places else where
            raise TrajectoryError(f"{raw.place(path, k)}: time {time:f} again{where}, expected times that increase")
    if raw.rotation.ndim == 2:
        check_lengths(raw.rotation, [raw.place(path, k) for k in range(len(raw.times))])


def _in_us(path: Path, time: Decimal, unit: TimeUnit) -> int:
    t_us = int((time * US[unit]).to_integral_value())
    if abs(t_us) >= 1 << 61:
        raise TrajectoryError(f"{path}: time {time} in {unit} does not fit 64-bit microseconds, expected another unit")
    return t_us


def _camera_to_world(raw: RawPoses, quaternion: Quaternion | None, transform: Transform, axes: Axes) -> Poses:
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


def read_raw(path: Path, known: TrajectoryFormat = NOTHING_KNOWN) -> RawPoses:
    """Read a file without applying conventions; raises :class:`TrajectoryError`."""
    if path.is_dir():
        models = [path / name for name in ("images.bin", "images.txt") if (path / name).is_file()]
        if not models:
            raise TrajectoryError(f"{path}: holds no images.bin or images.txt, expected a COLMAP model or a file")
        path = models[0]
    try:
        if path.suffix == ".npz":
            return _robust_e_nerf(path)
        if path.suffix == ".npy":
            return _npy(path, known)
        if path.suffix in (".h5", ".hdf5"):
            return _m3ed(path)
        if path.suffix == ".bin":
            return _colmap(path, _colmap_binary(path), known)
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise TrajectoryError(f"{path}: {_kind(path)}, expected {_READ}") from None
    except (OSError, ValueError, EOFError, struct.error, KeyError) as error:
        reason = getattr(error, "strerror", None) or error
        if path.suffix in (".h5", ".hdf5"):
            reason = "not a whole HDF5 file" if path.is_file() else "no such file"
        raise TrajectoryError(f"{path}: cannot be read ({reason}){did_you_mean(path)}") from None
    if lines and lines[0].lstrip().startswith(("{", "<")):
        raise TrajectoryError(f"{path}: begins with {lines[0].lstrip()[:20]!r}, as JSON or XML does, expected {_READ}")
    if path.name == "images.txt":
        return _colmap(path, _colmap_text(path, lines), known)
    return read_text(path, lines, known)


def _kind(path: Path) -> str:
    """What a file that is not text is, by its first bytes."""
    with path.open("rb") as file:
        begin = file.read(10)
    return next((kind for mark, kind in _KINDS.items() if begin.startswith(mark)), "not text in UTF-8")


def _robust_e_nerf(path: Path) -> RawPoses:
    with opened_npz(path) as file:
        missing = [name for name in _OF_ROBUST_E_NERF if name not in file.files]
        if missing:
            raise TrajectoryError(
                f"{path}: holds {', '.join(file.files[:8]) or 'nothing'}, expected {', '.join(_OF_ROBUST_E_NERF)} as "
                "Robust e-NeRF writes them"
            )
        times = [Decimal(int(t)) for t in file["T_wc_timestamp"]]
        position, rotation = file["T_wc_position"].astype(float), file["T_wc_orientation"].astype(float)
    return RawPoses("Robust e-NeRF npz", times, position, rotation, "xyzw", time_unit="ns")


def _m3ed(path: Path) -> RawPoses:
    """M3ED (Chaney et al. 2023): ``Cn_T_C0`` maps points from the first event camera, the world frame, to the n-th."""
    with h5py.File(path, "r") as file:
        found: list[Any] = [file.get(name) for name in ("Cn_T_C0", "ts")]
        if not all(isinstance(one, h5py.Dataset) for one in found):
            raise TrajectoryError(
                f"{path}: holds {', '.join(list(file)[:8]) or 'nothing'}, expected Cn_T_C0 and ts as M3ED writes them"
            )
        matrices, times = np.asarray(found[0], float), np.asarray(found[1])
    if matrices.shape != (len(times), 4, 4):
        raise TrajectoryError(f"{path}: Cn_T_C0 is of shape {matrices.shape}, expected ({len(times)}, 4, 4)")
    rotation = rotations(path, matrices[:, :3, :3])
    times = [Decimal(str(time)) for time in times.tolist()]
    return RawPoses("M3ED poses", times, matrices[:, :3, 3], rotation, None, "world-to-camera", time_unit="us")


def _npy(path: Path, known: TrajectoryFormat) -> RawPoses:
    """LLFF's table, or flat or stacked matrices."""
    table = np.load(path)
    if table.dtype.kind not in "iuf":
        raise TrajectoryError(
            f"{path}: an array of {', '.join(table.dtype.names or [str(table.dtype)])}, expected numbers"
        )
    table = table.astype(float)
    shape, count = table.shape, len(table) if table.ndim else 0
    if shape[1:] == (3, 5):
        table, shape = table.reshape(-1, 15), (count, 15)
    timed = shape[1:] in ((13,), (17,)) and (shape[1] == 13 or bool((table[:, 13:] == [0, 0, 0, 1]).all()))
    if table.ndim == 2 and shape[1] in (15, 17) and not timed and count:
        matrices = table[:, :15].reshape(-1, 3, 5)
        times = times_beside(path, count, None, known)
        return RawPoses("LLFF", times, matrices[..., 3], rotations(path, matrices[..., :3]), axes="llff")
    if not count or not (timed or shape[1:] in ((12,), (16,), (3, 4), (4, 4))):
        raise TrajectoryError(
            f"{path}: an array of shape {shape}, expected matrices (poses, 4, 4) or (poses, 3, 4), or LLFF's "
            "(poses, 17)"
        )
    position, rotation = moving(path, (table[:, 1:] if timed else table).reshape(count, -1, 4))
    own = [Decimal(repr(time)) for time in table[:, 0].tolist()] if timed else None
    return RawPoses("matrices", own or times_beside(path, count, None, known), position, rotation)


Images = list[tuple[str, list[float]]]
"""COLMAP images: name, and world-to-camera qw qx qy qz tx ty tz."""


def _colmap(path: Path, images: Images, known: TrajectoryFormat) -> RawPoses:
    if not images:
        raise TrajectoryError(f"{path}: holds no image, expected a COLMAP model with some")
    images = sorted(images, key=lambda image: by_number(image[0]))
    numbers = np.array([pose for _, pose in images])
    names = [name for name, _ in images]
    times = times_beside(path, len(images), names, known)
    notes = ()
    if not named_beside(names, known):
        notes = (f"{path.name}: times without names are given to the images from {names[0]} to {names[-1]} in order",)
    return RawPoses("COLMAP model", times, numbers[:, 4:], numbers[:, :4], "wxyz", "world-to-camera", notes=notes)


def _colmap_text(path: Path, lines: list[str]) -> Images:
    """Two lines per image; the second lists its points and may be empty."""
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
