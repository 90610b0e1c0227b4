"""Readers for the camera calibration files of other programs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from scipy.spatial.transform import Rotation

from ebarf_ns.errors import SceneError, did_you_mean
from ebarf_ns.files import opened_npz
from ebarf_ns.formats.camera_entry import FISHEYE, INTRINSICS, Size, camera_of, matrix_of
from ebarf_ns.formats.named_values import KNOWN_LAYOUTS, Entry, numbers_of, parsed, plain, shown, text_of
from ebarf_ns.geometry.cameras import Camera

ECD_EXPECTED = "9 numbers 'fx fy cx cy k1 k2 p1 p2 k3'"


@dataclass(frozen=True)
class Calibrated:
    """A camera and, if the file gives it, its pose on the rig."""

    camera: Camera
    rig_from_camera: np.ndarray | None = None
    """4x4; the rig frame is the IMU or another reference of the file."""
    notes: tuple[str, ...] = ()
    """What the file leaves open and is assumed."""


def read_calibration(path: Path, which: str | None = None, sensor_size: Size | None = None) -> Calibrated:
    """Read the camera with name or number ``which``, by default the only one; raises :class:`SceneError`.

    TUM-VIE's (basalt's) JSON, kalibr's camchain and DSEC's YAML, EuRoC's sensor.yaml, ROS' camera_info, OpenCV's YAML
    and XML, the cameras of VINS and ORB-SLAM, Robust e-NeRF's npz, M3ED's h5, a scene.json, and the event camera
    dataset's calib.txt. ``sensor_size`` is used for formats that do not store it.
    """
    cameras = _cameras(path, sensor_size)
    if which is None and len(cameras) == 1:
        return next(iter(cameras.values()))()
    if which not in cameras:
        chosen = "not chosen" if which is None else repr(which)
        raise SceneError(f"{path}: camera {chosen}, expected --camera-name with one of {', '.join(cameras)}")
    return cameras[which]()


def read_cameras(path: Path, sensor_size: Size | None = None) -> dict[str, Calibrated]:
    """Read all cameras of a calibration file by name, see :func:`read_calibration`; raises :class:`SceneError`."""
    return {name: read() for name, read in _cameras(path, sensor_size).items()}


def camera_notes(camera: Camera) -> list[str]:
    """One line that shows a camera, and a suspicion if its principal point is outside the middle half of the image."""
    named = f"{len(camera.distortion)} coefficients" if camera.distortion else "no distortion"
    notes = [
        f"camera: {camera.model} {camera.width} x {camera.height}, f {camera.fx:g} {camera.fy:g}, "
        f"c {camera.cx:g} {camera.cy:g}, {named}"
    ]
    shares = (camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height
    if not all(0.25 <= share <= 0.75 for share in shares):
        notes.append(
            f"suspicious: the principal point {camera.cx:g} {camera.cy:g} is far from the middle of {camera.width} x "
            f"{camera.height} pixels: in pixels, cx before cy, and of this size of image?"
        )
    return notes


def _cameras(path: Path, size: Size | None) -> dict[str, Callable[[], Calibrated]]:
    """A reader per camera, so that an unreadable camera does not affect the others."""
    if not path.is_file():
        what = "a folder" if path.is_dir() else "no such file"
        raise SceneError(f"{path}: {what}, expected a calibration file{did_you_mean(path)}")
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return {"camera": lambda: _robust_e_nerf(path)}
    if suffix in (".h5", ".hdf5"):
        return _m3ed(path)
    text = text_of(path)
    if suffix == ".txt":
        return {"camera": lambda: Calibrated(_nine_numbers(path, text, size))}
    return _of_content(path, parsed(path, text), size)


def _of_content(path: Path, content: Any, size: Size | None) -> dict[str, Callable[[], Calibrated]]:
    """Find the cameras at any level of the content."""
    top = Entry(path, "", content)
    if "value0" in top.content:
        return _basalt(top.inner("value0"))
    if isinstance(top.content.get("cameras"), list):
        cameras = [Entry(path, f"cameras[{k}]", one) for k, one in enumerate(top.content["cameras"])]
        return {str(one.content.get("name", k)): _reader(one, size) for k, one in enumerate(cameras)}
    if any(str(key).startswith(("Camera.", "Camera1.")) for key in top.content):
        return {"camera": _reader(_orb_slam(top), size)}
    # kalibr's camchain at top level, DSEC's under "intrinsics".
    inner = top.content.get("intrinsics")
    if isinstance(inner, Mapping) and any(isinstance(one, Mapping) for one in inner.values()):
        top = top.inner("intrinsics")
    if _is_camera(top.content):
        return {"camera": _reader(top, size)}
    # DV states whether the lens is a fisheye beside the camera, not within it.
    fisheye = top.key(FISHEYE)
    above = {} if fisheye is None else {fisheye: top.content[fisheye]}
    entries = {
        str(name): Entry(path, top.name(name), {**above, **one}) for name, one in top.content.items() if _is_camera(one)
    }
    if not entries:
        keys = shown(", ".join(map(str, list(top.content)[:20])))
        raise SceneError(f"{path}: holds {keys if top.content else 'nothing'}, expected {KNOWN_LAYOUTS}")
    return {name: _chained(entries, name, size) for name in entries}


def _is_camera(content: Any) -> bool:
    if not isinstance(content, Mapping):
        return False
    keys = {plain(key) for key in content}
    return any(plain(key) in keys for key in (*INTRINSICS, "camera_model", "distortion_model", "model_type", "fx"))


def _calibrated(entry: Entry, size: Size | None, pose: np.ndarray | None) -> Calibrated:
    camera, notes = camera_of(entry, size)
    return Calibrated(camera, pose, tuple(notes))


def _reader(entry: Entry, size: Size | None) -> Callable[[], Calibrated]:
    def read() -> Calibrated:
        body = entry.key(("T_BS",))
        return _calibrated(entry, size, None if body is None else matrix_of(entry, body))

    return read


def _orb_slam(top: Entry) -> Entry:
    """Entry from keys such as Camera.fx; the first of two cameras."""
    prefix = (
        "Camera." if any(str(key).startswith("Camera.") and "fx" in str(key) for key in top.content) else "Camera1."
    )
    named = {key: value for key, value in top.content.items() if str(key).startswith((prefix, "Camera."))}
    return Entry(top.path, prefix[:-1], {str(key).split(".", 1)[1]: value for key, value in named.items()})


def _basalt(top: Entry) -> dict[str, Callable[[], Calibrated]]:
    parts = [top.content.get(name) for name in ("intrinsics", "resolution", "T_imu_cam")]
    if not all(isinstance(part, list) and len(part) == len(parts[0] or ()) for part in parts):
        raise SceneError(
            f"{top.path}: {top.place} is not as basalt writes it, expected intrinsics, resolution and T_imu_cam "
            "in lists of one length"
        )
    return {str(k): _of_basalt(top, k, *those) for k, those in enumerate(zip(*parts, strict=True))}  # pyright: ignore[reportArgumentType]


def _of_basalt(top: Entry, number: int, lens: Any, size: Any, pose: Any) -> Callable[[], Calibrated]:
    def read() -> Calibrated:
        entry = Entry(top.path, f"{top.name('intrinsics')}[{number}]", lens)
        camera = _calibrated(Entry(top.path, entry.place, {**entry.content, "resolution": size}), None, None)
        placed = Entry(top.path, f"{top.name('T_imu_cam')}[{number}]", pose)
        values = {one: placed.number((one,)) for one in ("px", "py", "pz", *_TURN)}
        if not any(values[one] for one in _TURN):
            raise placed.wrong("qw", "a quaternion that is not 0")
        return replace(camera, rig_from_camera=pose_matrix(values))

    return read


_TURN = ("qx", "qy", "qz", "qw")


def pose_matrix(entry: Mapping[str, float]) -> np.ndarray:
    """4x4 matrix from px py pz qx qy qz qw."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([entry[name] for name in _TURN]).as_matrix()
    matrix[:3, 3] = [entry[name] for name in ("px", "py", "pz")]
    return matrix


def _chained(entries: Mapping[str, Entry], name: str, size: Size | None) -> Callable[[], Calibrated]:
    """kalibr's poses are relative to the IMU if all cameras have T_cam_imu, else to the first camera."""

    def read() -> Calibrated:
        entry = entries[name]
        if all("T_cam_imu" in one.content for one in entries.values()):
            return _calibrated(entry, size, np.linalg.inv(matrix_of(entry, "T_cam_imu")))
        if entry.content.get("T_BS") is not None:
            return _calibrated(entry, size, matrix_of(entry, "T_BS"))
        pose = np.eye(4)
        before = list(entries)[1 : list(entries).index(name) + 1]
        for one in (entries[other] for other in before):
            if one.content.get("T_cn_cnm1") is None:
                return _calibrated(entry, size, None)
            pose = pose @ np.linalg.inv(matrix_of(one, "T_cn_cnm1"))
        return _calibrated(entry, size, pose if len(entries) > 1 else None)

    return read


def _nine_numbers(path: Path, text: str, sensor_size: Size | None) -> Camera:
    values = numbers_of(text) or []
    if len(values) != 9 or not np.isfinite(values).all() or min(values[:2]) <= 0:
        raise SceneError(f"{path}: holds {' '.join(text[:400].split())[:80]!r}, expected {ECD_EXPECTED}")
    if sensor_size is None:
        raise SceneError(f"{path}: does not say how large the sensor is, expected --sensor-size WIDTH HEIGHT")
    fx, fy, cx, cy, *distortion = values
    return Camera("radtan", *sensor_size, fx, fy, cx, cy, tuple(distortion))


def _m3ed(path: Path) -> dict[str, Callable[[], Calibrated]]:
    """The cameras among the groups with a ``calib``, by group name; the rig frame is the left event camera."""
    needed = {"intrinsics", "resolution", "distortion_model", "distortion_coeffs"}
    found: dict[str, Callable[[], Calibrated]] = {}
    try:
        with h5py.File(path, "r") as file:
            groups: list[str] = []
            file.visit(lambda name: groups.append(name) if name.endswith("/calib") else None)
            for name in groups:
                group: Any = file[name]
                content = {key: _value(one) for key, one in group.items()} if isinstance(group, h5py.Group) else {}
                if needed <= content.keys():
                    found[name.removesuffix("/calib")] = _of_m3ed(Entry(path, name, content))
    except (OSError, RuntimeError, KeyError):
        raise SceneError(f"{path}: cannot be read as an HDF5 file, expected a whole one") from None
    if not found:
        raise SceneError(f"{path}: holds no calibration, expected groups named calib with {', '.join(sorted(needed))}")
    return found


def _value(node: Any) -> Any:
    """A list, number or text; None for anything else."""
    if not isinstance(node, h5py.Dataset) or node.size is None or node.size > 64:
        return None
    value = np.asarray(node).tolist()
    return value.decode(errors="replace") if isinstance(value, bytes) else value


def _of_m3ed(entry: Entry) -> Callable[[], Calibrated]:
    def read() -> Calibrated:
        pose = entry.key(("T_to_prophesee_left",))
        return _calibrated(entry, None, None if pose is None else matrix_of(entry, pose))

    return read


def _robust_e_nerf(path: Path) -> Calibrated:
    try:
        with opened_npz(path) as file:
            content = {name: file[name].tolist() for name in file.files}
    except (OSError, ValueError):
        raise SceneError(f"{path}: cannot be read as an npz file, expected Robust e-NeRF's calibration") from None
    return _calibrated(Entry(path, "", content), None, None)
