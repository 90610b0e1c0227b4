"""Cameras as other programs' calibration files describe them."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from ebarf_ns.errors import SceneError
from ebarf_ns.files import opened_npz
from ebarf_ns.geometry.cameras import COEFFICIENTS, Camera, CameraModel

_MODELS: dict[str, CameraModel] = {
    "pinhole": "pinhole", "none": "pinhole", "": "pinhole", "radtan": "radtan", "plumb_bob": "radtan",
    "rational_polynomial": "radtan", "equidistant": "equidistant", "equi": "equidistant", "kb4": "equidistant",
    "fisheye": "equidistant",
}  # fmt: skip
ECD_EXPECTED = "9 numbers 'fx fy cx cy k1 k2 p1 p2 k3'"


@dataclass(frozen=True)
class Calibrated:
    """A camera, and where it sits on the rig where the file says so."""

    camera: Camera
    rig_from_camera: np.ndarray | None = None
    """4x4, of the IMU or whatever else the file refers to."""


def read_calibration(path: Path, which: str | None = None, sensor_size: tuple[int, int] | None = None) -> Calibrated:
    """The camera named or numbered ``which``, the only one where not given; raises :class:`SceneError`.

    TUM-VIE's (basalt's) JSON, kalibr's camchain and DSEC's YAML, ROS' camera_info, Robust e-NeRF's npz, M3ED's h5, a
    scene.json, and the event camera dataset's calib.txt, which needs ``sensor_size``.
    """
    cameras = read_cameras(path, sensor_size)
    if which is None and len(cameras) == 1:
        return next(iter(cameras.values()))
    if which not in cameras:
        names = ", ".join(cameras) or "none"
        raise SceneError(f"{path}: camera {which or 'not chosen'}, expected --camera-name with one of {names}")
    return cameras[which]


def read_cameras(path: Path, sensor_size: tuple[int, int] | None = None) -> dict[str, Calibrated]:
    """All cameras of a calibration file by name, see :func:`read_calibration`; raises :class:`SceneError`."""
    try:
        if path.suffix == ".npz":
            return {"camera": _robust_e_nerf(path)}
        if path.suffix in (".h5", ".hdf5"):
            return _m3ed(path)
        text = path.read_text(encoding="utf-8")
        if path.suffix == ".txt":
            return {"camera": Calibrated(_nine_numbers(path, text, sensor_size))}
        content = json.loads(text) if path.suffix == ".json" else yaml.safe_load(re.sub(r"^%YAML.*\n", "", text))
    except (OSError, UnicodeDecodeError, ValueError, yaml.YAMLError) as error:
        raise SceneError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from None
    return _cameras(path, content, sensor_size)


def _cameras(path: Path, content: Any, size: tuple[int, int] | None) -> dict[str, Calibrated]:
    try:
        if "value0" in content:
            return _basalt(content["value0"])
        if "camera" in content:
            return {"camera": Calibrated(_camera(_flat(content["camera"]), size))}
        if "camera_matrix" in content and "image_width" in content:
            return {"camera": Calibrated(_ros(content))}
        # kalibr's camchain at top level, DSEC's under "intrinsics".
        chain = content.get("intrinsics", content)
        entries = {name: entry for name, entry in chain.items() if re.fullmatch(r"cam\w+", name)}
        return {name: Calibrated(_kalibr(entries[name], size), pose) for name, pose in _chained(entries).items()}
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise SceneError(f"{path}: not a calibration as known ({type(error).__name__}: {error})") from None


def _flat(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Of a scene.json."""
    return {
        "model": entry["model"],
        "resolution": (entry["width"], entry["height"]),
        "intrinsics": [entry[name] for name in ("fx", "fy", "cx", "cy")],
        "distortion": entry.get("distortion", ()),
    }


def _camera(entry: Mapping[str, Any], size: tuple[int, int] | None) -> Camera:
    distortion = tuple(float(value) for value in entry["distortion"])
    name = str(entry["model"]).lower()
    if name not in _MODELS:
        raise ValueError(f"distortion model {name!r}, expected one of {', '.join(filter(None, _MODELS))}")
    model = _MODELS[name]
    # Without any coefficient, an equidistant lens is still no pinhole.
    if model != "equidistant" and not any(distortion):
        model, distortion = "pinhole", ()
    if len(distortion) not in COEFFICIENTS[model]:
        raise ValueError(f"{len(distortion)} coefficients for {model}, expected {COEFFICIENTS[model]}")
    size = entry["resolution"] or size
    if size is None:
        raise ValueError("no sensor size, expected --sensor-size")
    fx, fy, cx, cy = (float(value) for value in entry["intrinsics"])
    if not (min(fx, fy) > 0 and np.isfinite([fx, fy, cx, cy, *distortion]).all()):
        raise ValueError(f"focal lengths {fx} and {fy}, expected finite values above 0")
    return Camera(model, int(size[0]), int(size[1]), fx, fy, cx, cy, distortion)


def _basalt(content: Mapping[str, Any]) -> dict[str, Calibrated]:
    found = {}
    for number, (entry, size) in enumerate(zip(content["intrinsics"], content["resolution"], strict=True)):
        values = entry["intrinsics"]
        intrinsics = [values[name] for name in ("fx", "fy", "cx", "cy")]
        distortion = [values[name] for name in ("k1", "k2", "k3", "k4") if name in values]
        camera = {
            "model": entry["camera_type"], "resolution": size, "intrinsics": intrinsics, "distortion": distortion
        }  # fmt: skip
        found[str(number)] = Calibrated(_camera(camera, None), pose_matrix(content["T_imu_cam"][number]))
    return found


def pose_matrix(entry: Mapping[str, float]) -> np.ndarray:
    """4x4 of px py pz qx qy qz qw."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([entry[name] for name in ("qx", "qy", "qz", "qw")]).as_matrix()
    matrix[:3, 3] = [entry[name] for name in ("px", "py", "pz")]
    return matrix


def _chained(entries: Mapping[str, Mapping[str, Any]]) -> dict[str, np.ndarray | None]:
    """Where kalibr's cameras are: on the IMU where it says so of all, else as seen from the first."""
    if entries and all("T_cam_imu" in entry for entry in entries.values()):
        return {name: np.linalg.inv(np.array(entry["T_cam_imu"], float)) for name, entry in entries.items()}
    found: dict[str, np.ndarray | None] = {}
    pose: np.ndarray | None = np.eye(4)
    for number, (name, entry) in enumerate(entries.items()):
        if number:
            step = entry.get("T_cn_cnm1")
            pose = None if pose is None or step is None else pose @ np.linalg.inv(np.array(step, float))
        found[name] = pose if len(entries) > 1 else None
    return found


def _kalibr(entry: Mapping[str, Any], size: tuple[int, int] | None) -> Camera:
    intrinsics = entry.get("intrinsics", entry.get("camera_matrix"))
    camera = {
        "model": entry.get("distortion_model", "radtan" if entry.get("distortion_coeffs") else "none"),
        "resolution": entry.get("resolution"),
        "intrinsics": intrinsics,
        "distortion": entry.get("distortion_coeffs", ()),
    }
    return _camera(camera, size)


def _ros(content: Mapping[str, Any]) -> Camera:
    matrix: Sequence[float] = content["camera_matrix"]["data"]
    camera = {
        "model": content.get("distortion_model", "none"),
        "resolution": (content["image_width"], content["image_height"]),
        "intrinsics": [matrix[0], matrix[4], matrix[2], matrix[5]],
        "distortion": content.get("distortion_coefficients", {}).get("data", ()),
    }
    return _camera(camera, None)


def _nine_numbers(path: Path, text: str, sensor_size: tuple[int, int] | None) -> Camera:
    try:
        values = [float(field) for field in text.split()]
    except ValueError as error:
        raise SceneError(f"{path}: {error}, expected {ECD_EXPECTED}") from None
    if len(values) != 9 or not np.isfinite(values).all() or min(values[:2]) <= 0:
        raise SceneError(f"{path}: holds {' '.join(text.split())[:80]!r}, expected {ECD_EXPECTED}")
    if sensor_size is None:
        raise SceneError(f"{path}: does not say how large the sensor is, expected --sensor-size")
    fx, fy, cx, cy, *distortion = values
    return Camera("radtan", *sensor_size, fx, fy, cx, cy, tuple(distortion))


def _m3ed(path: Path) -> dict[str, Calibrated]:
    """The cameras among the groups with a ``calib``, by the groups' names; the rig is the left event camera."""
    found: dict[str, Calibrated] = {}
    with h5py.File(path, "r") as file:
        groups: list[str] = []
        file.visit(lambda name: groups.append(name.removesuffix("/calib")) if name.endswith("/calib") else None)
        for name in groups:
            calibration = {key: np.asarray(value) for key, value in file[f"{name}/calib"].items()}  # pyright: ignore[reportAttributeAccessIssue]
            if not {"intrinsics", "resolution", "distortion_model", "distortion_coeffs"} <= calibration.keys():
                continue
            model = calibration["distortion_model"].item()
            camera = {
                "model": model.decode() if isinstance(model, bytes) else model,
                "resolution": calibration["resolution"].tolist(),
                "intrinsics": calibration["intrinsics"].tolist(),
                "distortion": calibration["distortion_coeffs"].tolist(),
            }
            found[name] = Calibrated(_camera(camera, None), calibration.get("T_to_prophesee_left"))
    return found


def _robust_e_nerf(path: Path) -> Calibrated:
    with opened_npz(path) as file:
        content = {name: file[name] for name in file.files}
    try:
        matrix = np.asarray(content["intrinsics"], float)
        camera = {
            "model": str(content.get("distortion_model", "none")),
            "resolution": (int(content["img_width"]), int(content["img_height"])),
            "intrinsics": (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]),
            "distortion": np.asarray(content.get("distortion_params", ()), float).ravel().tolist(),
        }
        return Calibrated(_camera(camera, None))
    except (KeyError, IndexError, ValueError) as error:
        raise SceneError(f"{path}: not Robust e-NeRF's calibration ({error})") from None
