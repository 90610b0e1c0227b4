"""Folder layouts of public datasets, read into the ingredients of a scene."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ebarf_ns.errors import SceneError
from ebarf_ns.files import opened_npz
from ebarf_ns.formats.calibration import Calibrated, pose_matrix, read_calibration, read_cameras
from ebarf_ns.formats.readers.arrays import read_npy, read_npz
from ebarf_ns.formats.readers.hdf5 import read_hdf5
from ebarf_ns.formats.readers.text import read_text
from ebarf_ns.formats.source import Source, TimeUnit
from ebarf_ns.formats.trajectory_formats import TrajectoryFormat, read_trajectory
from ebarf_ns.geometry.cameras import Camera
from ebarf_ns.geometry.trajectory import Poses, Trajectory
from ebarf_ns.scene import ContrastThreshold, FrameIntensity

Layout = Literal["ecd", "tumvie", "eds", "esim", "robust-e-nerf"]
_EVENT_CAMERAS = {"left": "2", "right": "3"}
_GREY_CAMERAS = {"left": "0", "right": "1"}


@dataclass(frozen=True)
class FrameFile:
    """A frame of a camera."""

    picture: Path | np.ndarray
    """A file, or an 8- or 16-bit grey image."""
    t_us: int
    camera: Camera | None
    """None: the event camera."""
    event_camera_from_frame_camera: np.ndarray
    intensity: FrameIntensity


@dataclass(frozen=True)
class Ingredients:
    """Contents of a dataset's folder for a scene."""

    open_events: Callable[[], Source]
    camera: Camera | None = None
    groundtruth: Trajectory | None = None
    frames: Iterable[FrameFile] = ()
    frames_left_out: Counter[str] = field(default_factory=Counter)
    """Number of skipped frames, by topic and reason; counted while reading."""
    contrast_threshold: ContrastThreshold | None = None
    notes: list[str] = field(default_factory=list)
    sensor_size: tuple[int, int] | None = None
    """Columns and rows of the dataset's sensor, for calibrations and recordings that do not give them."""


@dataclass(frozen=True)
class Given:
    """User settings for reading a dataset's folder."""

    camera: Path | None = None
    """A calibration file that replaces the folder's own."""
    sensor_size: tuple[int, int] | None = None
    part: str | None = None
    """Which of two event cameras."""
    frames: bool = True
    """Whether to read frames."""
    event_time_unit: TimeUnit | None = None
    """Unit of the event times, if not the dataset's usual one."""


NOTHING_GIVEN = Given()


def ecd(folder: Path, given: Given = NOTHING_GIVEN) -> Ingredients:
    """The event camera dataset (Mueggler et al. 2017): events.txt, calib.txt, groundtruth.txt, images.txt."""
    davis_size, camera = (240, 180), None
    if given.camera is None:
        camera = read_calibration(folder / "calib.txt", sensor_size=given.sensor_size or davis_size).camera
    groundtruth, notes = None, []
    if (folder / "groundtruth.txt").is_file():
        groundtruth, notes = read_trajectory(folder / "groundtruth.txt", TrajectoryFormat("s", "xyzw"))
    # DAVIS frames are linear up to an offset of the sensor.
    listed = _listed(folder / "images.txt", "s") if given.frames else []
    frames = tuple(FrameFile(path, t_us, None, np.eye(4), "linear") for t_us, path in listed)
    events = lambda: read_text(folder / "events.txt", given.event_time_unit or "s")  # noqa: E731
    return Ingredients(events, camera, groundtruth, frames, notes=notes, sensor_size=davis_size)


def tumvie(folder: Path, given: Given = NOTHING_GIVEN) -> Ingredients:
    """TUM-VIE (Klenk et al. 2021): ``*events_left.h5``, mocap_data.txt and calibration A or B in the same folder.

    Marker poses are converted to event camera poses by T_mocap_marker · T_imu_marker⁻¹ · T_imu_cam. ``part`` is left
    (default) or right.
    """
    side = given.part or "left"
    if side not in _EVENT_CAMERAS:
        raise SceneError(f"{folder}: part {side!r}, expected one of {', '.join(_EVENT_CAMERAS)}")
    events = _only(folder, f"*events_{side}.h5")
    cameras = given.camera or _only(folder, "camera-calibration*.json")
    marker = cameras.parent / f"mocap-imu-{cameras.name.removeprefix('camera-')}"
    event_camera = read_calibration(cameras, _EVENT_CAMERAS[side])
    grey_camera = read_calibration(cameras, _GREY_CAMERAS[side])
    groundtruth, notes = None, []
    mocap = _at_most_one(folder, "**/mocap_data.txt")
    if mocap and marker.is_file():
        marker_path, notes = read_trajectory(mocap, TrajectoryFormat("us", "xyzw"))
        imu_from_marker = _imu_from_marker(marker)
        groundtruth = _moved(marker_path, np.linalg.inv(imu_from_marker) @ _rig(event_camera, cameras))
    elif mocap:
        notes.append(f"{mocap.name} is left out: it has poses of a marker whose calibration, {marker.name}, is missing")
    event_from_grey = np.linalg.inv(_rig(event_camera, cameras)) @ _rig(grey_camera, cameras)
    frames = []
    for stamps in folder.glob(f"**/image_timestamps_{side}.txt") if given.frames else ():
        images = sorted((stamps.parent / f"{side}_images").glob("*.jpg"))
        times = _times(stamps, len(images))
        frames = [
            FrameFile(path, t_us, grey_camera.camera, event_from_grey, "srgb")
            for path, t_us in zip(images, times, strict=True)
        ]
    return Ingredients(
        lambda: read_hdf5(events, "events", given.event_time_unit),
        event_camera.camera,
        groundtruth,
        tuple(frames),
        notes=notes,
    )


def eds(folder: Path, given: Given = NOTHING_GIVEN) -> Ingredients:
    """EDS (Hidalgo-Carrió et al. 2022): events.h5 with columns at top level, poses of the event camera.

    The frames, images/ with images_timestamps.txt [us], are from another camera; ``camera`` is then a kalibr file with
    cam0 (frames) and cam1 (events).
    """
    cameras, groundtruth, notes, frames = given.camera, None, [], []
    poses, stamps = folder / "stamped_groundtruth.txt", folder / "images_timestamps.txt"
    if poses.is_file():
        groundtruth, notes = read_trajectory(poses, TrajectoryFormat("s", "xyzw"))
    known = read_cameras(cameras) if cameras and cameras.suffix.lower() in (".yaml", ".yml") else {}
    stamped = given.frames and stamps.is_file()
    if stamped and "cam0" in known and "cam1" in known:
        event_from_frame = np.linalg.inv(_rig(known["cam1"], cameras)) @ _rig(known["cam0"], cameras)
        images = sorted((folder / "images").glob("*.png"))
        frames = [
            FrameFile(path, t_us, known["cam0"].camera, event_from_frame, "srgb")
            for path, t_us in zip(images, _times(stamps, len(images)), strict=True)
        ]
    elif stamped:
        notes.append("the frames are from another camera; without a --camera file with both, they are left out")
    return Ingredients(
        lambda: read_hdf5(folder / "events.h5", None, given.event_time_unit),
        None,
        groundtruth,
        tuple(frames),
        notes=notes,
    )


def esim(folder: Path, given: Given = NOTHING_GIVEN) -> Ingredients:
    """Synthetic recordings of ESIM and E-NeRF: events/*.npy, *poses_all*.txt (ns); images are not used."""
    groundtruth, notes = None, []
    poses = _at_most_one(folder, "**/*poses_all*.txt")
    if poses:
        groundtruth, notes = read_trajectory(poses, TrajectoryFormat("ns", "xyzw"))
    events = folder / "events" if (folder / "events").is_dir() else folder
    return Ingredients(lambda: read_npy(events, given.event_time_unit), None, groundtruth, notes=notes)


def robust_e_nerf(folder: Path, given: Given = NOTHING_GIVEN) -> Ingredients:
    """Robust e-NeRF (Low & Lee 2023): raw_events.npz, camera_poses.npz, camera_calibration.npz."""
    calibration = folder / "camera_calibration.npz"
    camera = read_calibration(calibration).camera if given.camera is None else None
    threshold = _contrast_threshold(calibration) if calibration.is_file() else None
    groundtruth, notes = read_trajectory(folder / "camera_poses.npz")
    return Ingredients(
        lambda: read_npz(folder / "raw_events.npz", given.event_time_unit),
        camera,
        groundtruth,
        contrast_threshold=threshold,
        notes=notes,
    )


LAYOUTS: dict[Layout, Callable[[Path, Given], Ingredients]] = {
    "ecd": ecd, "tumvie": tumvie, "eds": eds, "esim": esim, "robust-e-nerf": robust_e_nerf
}  # fmt: skip


def recognised_layout(folder: Path) -> Layout:
    """Recognise the dataset by the files in its folder; raises :class:`SceneError`."""
    marks: dict[Layout, str] = {
        "ecd": "events.txt", "tumvie": "*events_*.h5", "eds": "events.h5", "robust-e-nerf": "raw_events.npz",
        "esim": "events/*.npy",
    }  # fmt: skip
    found: list[Layout] = [layout for layout, mark in marks.items() if any(folder.glob(mark))]
    if len(found) != 1:
        raise SceneError(
            f"{folder}: looks like {' and '.join(found) or 'none'} of the datasets known; expected one of "
            f"{', '.join(f'{layout} ({mark})' for layout, mark in marks.items())}, or the recording's file"
        )
    return found[0]


def _moved(trajectory: Trajectory, body_from_camera: np.ndarray) -> Trajectory:
    """Camera poses from the poses of the body to which the camera is fixed."""
    turn = Rotation.from_matrix(body_from_camera[:3, :3]).as_quat()[[3, 0, 1, 2]]
    count = len(trajectory.t_us)
    local = Poses(torch.from_numpy(body_from_camera[:3, 3]).expand(count, 3), torch.from_numpy(turn).expand(count, 4))
    return Trajectory(trajectory.t_us, trajectory.poses.compose(local))


def _contrast_threshold(path: Path) -> ContrastThreshold:
    try:
        with opened_npz(path) as file:
            return ContrastThreshold(*(float(file[f"{sign}_contrast_threshold"]) for sign in ("pos", "neg")))
    except (OSError, ValueError) as error:
        raise SceneError(f"{path}: {error}, expected pos_contrast_threshold and neg_contrast_threshold") from None


def _imu_from_marker(path: Path) -> np.ndarray:
    try:
        content: Any = json.loads(path.read_text(encoding="utf-8"))
        return pose_matrix(content["value0"]["T_imu_marker"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise SceneError(f"{path}: cannot be read ({reason}), expected TUM-VIE's T_imu_marker") from None


def _rig(camera: Calibrated, path: Path | None) -> np.ndarray:
    if camera.rig_from_camera is None:
        raise SceneError(f"{path}: does not say where the cameras are on the rig, expected T_imu_cam or T_cn_cnm1")
    return camera.rig_from_camera


def _only(folder: Path, pattern: str) -> Path:
    found = _at_most_one(folder, pattern)
    if found is None:
        raise SceneError(f"{folder}: holds no {pattern}, expected the dataset's folder as it was downloaded")
    return found


def _at_most_one(folder: Path, pattern: str) -> Path | None:
    found = sorted(folder.glob(pattern))
    if len(found) > 1:
        raise SceneError(
            f"{folder}: holds {len(found)} files {pattern}, expected one: {', '.join(p.name for p in found)}"
        )
    return found[0] if found else None


def _listed(path: Path, unit: Literal["s", "us"]) -> list[tuple[int, Path]]:
    """Times and files from lines "time file"."""
    images = []
    lines = _lines(path) if path.is_file() else []
    for number, line in enumerate(lines, start=1):
        fields = line.strip().split(maxsplit=1)
        if not fields or line.startswith("#"):
            continue
        try:
            t_us = round(float(fields[0]) * (1e6 if unit == "s" else 1))
        except (ValueError, OverflowError):
            t_us = None
        if t_us is None or len(fields) != 2 or not (path.parent / fields[1]).is_file():
            raise SceneError(
                f"{path}:{number}: {line!r:.60}, expected 't[{unit}] file' with an existing file, or --no-frames"
            )
        images.append((t_us, path.parent / fields[1]))
    return images


def _times(path: Path, count: int) -> list[int]:
    """One time in microseconds per line, after a header line."""
    lines = [line.split()[0] for line in _lines(path) if line.strip()]
    lines = [line for line in lines if re.fullmatch(r"\d+(\.\d*)?", line)]
    if len(lines) != count:
        raise SceneError(f"{path}: {len(lines)} times, expected one for each of the {count} images, or --no-frames")
    return [round(float(line)) for line in lines]


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: byte {error.start} is not UTF-8 text, expected times, or --no-frames") from None
