"""The refined trajectory in the formats of other programs, in the input's world frame and scale."""

from __future__ import annotations

import json
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ebarf_ns.errors import ExportError, NoSurfaceError
from ebarf_ns.export.pictures import FRAME_NAME, write_pictures, write_times
from ebarf_ns.export.settings import SurfaceSettings
from ebarf_ns.export.surface import Points, points, write_cloud
from ebarf_ns.export.views import evenly
from ebarf_ns.files import whole_file, whole_folder
from ebarf_ns.geometry.trajectory import Trajectory
from ebarf_ns.geometry.trajectory_file import write_tum

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from jaxtyping import Float, Int64

    from ebarf_ns.export.settings import TrajectoryFileFormat
    from ebarf_ns.export.subject import Subject
    from ebarf_ns.geometry.cameras import Camera

_MOST_POSES, _MOST_PICTURES, _MOST_POINTS = 10_000_000, 300, 50_000


def export_trajectory(
    subject: Subject,
    format_: TrajectoryFileFormat,
    output: Path,
    rate_hz: float | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> tuple[int, int]:
    """Write the poses of the keyframes, or poses at a constant rate; returns the numbers of poses and points.

    tum is a file; kitti is a file with NAME_times.txt beside it; colmap and transforms are folders with rendered
    pictures, of at most 300 keyframes if no rate is given, and a point cloud, which is empty if no surface is sharp.
    Raises :class:`ExportError` for invalid rates.
    """
    pictures = format_ in ("colmap", "transforms")
    t_us = _times(subject, rate_hz, _MOST_PICTURES if pictures else _MOST_POSES)
    poses = subject.poses_at(torch.from_numpy(t_us))
    matrix = poses.matrix().double().numpy()
    cloud = Points(np.empty((0, 3)), np.empty(0, np.uint8))
    if format_ == "tum":
        write_tum(output, Trajectory(torch.from_numpy(t_us), poses), ["camera to world, x right, y down, z forward"])
    elif format_ == "kitti":
        with whole_file(output) as temporary:
            np.savetxt(temporary, matrix.reshape(-1, 12), fmt="%.9f")
        with whole_file(output.with_name(f"{output.stem}_times.txt")) as temporary:
            write_times(temporary, t_us)
    else:
        with whole_folder(output) as folder:
            (folder / "images").mkdir()
            write_pictures(subject, subject.camera, t_us, folder / "images", progress)
            write_times(folder / "timestamps.txt", t_us)
            with suppress(NoSurfaceError):
                cloud = _subsampled(points(subject, SurfaceSettings()))
                write_cloud(cloud, folder / "points.ply")
            if format_ == "colmap":
                _write_colmap(subject.camera, matrix, cloud, folder / "sparse" / "0")
            else:
                _write_transforms(subject.camera, matrix, t_us, folder)
    return len(t_us), len(cloud.position)


def _times(subject: Subject, rate_hz: float | None, most: int) -> Int64[np.ndarray, "poses"]:
    keyframe_t_us = subject.trajectory.t_us.numpy()
    if rate_hz is None:
        return evenly(keyframe_t_us, most)
    if not 0 < rate_hz <= 1e6:
        raise ExportError(f"rate is {rate_hz} Hz, expected a value above 0 and at most 1,000,000")
    first_us, last_us = keyframe_t_us[[0, -1]].tolist()
    count = int((last_us - first_us) * rate_hz * 1e-6 + 1e-9) + 1
    if count > _MOST_POSES:
        raise ExportError(f"{rate_hz} Hz gives {count:,} poses, expected at most {_MOST_POSES:,}")
    return first_us + (np.arange(count) * 1e6 / rate_hz).round().astype(np.int64)


def _subsampled(cloud: Points) -> Points:
    chosen = np.random.default_rng(0).permutation(len(cloud.position))[:_MOST_POINTS]
    return Points(cloud.position[chosen], cloud.grey[chosen])


def _write_colmap(camera: Camera, matrix: Float[np.ndarray, "poses 3 4"], cloud: Points, folder: Path) -> None:
    """Write COLMAP's text files: world to camera, quaternions scalar first, pixel centres at half-integers."""
    folder.mkdir(parents=True)
    name, parameters = _colmap_camera(camera)
    numbers = " ".join(f"{value:.9g}" for value in parameters)
    (folder / "cameras.txt").write_text(
        f"# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n1 {name} {camera.width} {camera.height} {numbers}\n",
        encoding="utf-8",
    )
    to_camera = Rotation.from_matrix(matrix[:, :, :3]).inv()
    translation = -to_camera.apply(matrix[:, :, 3])
    rows = np.hstack([to_camera.as_quat()[:, [3, 0, 1, 2]], translation])
    with (folder / "images.txt").open("w", encoding="utf-8") as file:
        file.write("# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then POINTS2D[]: none\n")
        for k, row in enumerate(rows.tolist()):
            pose = " ".join(f"{value:.9f}" for value in row)
            file.write(f"{k + 1} {pose} 1 {FRAME_NAME.format(k)}.png\n\n")
    with (folder / "points3D.txt").open("w", encoding="utf-8") as file:
        file.write("# POINT3D_ID X Y Z R G B ERROR TRACK[]: none\n")
        for k, (position, grey) in enumerate(zip(cloud.position.tolist(), cloud.grey.tolist(), strict=True)):
            x, y, z = position
            file.write(f"{k + 1} {x:.6g} {y:.6g} {z:.6g} {grey} {grey} {grey} 0\n")


def _colmap_camera(camera: Camera) -> tuple[str, list[float]]:
    pinhole = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]
    if camera.model == "pinhole":
        return "PINHOLE", pinhole
    if camera.model == "equidistant":
        return "OPENCV_FISHEYE", [*pinhole, *camera.distortion]
    if any(camera.distortion[4:]):
        return "FULL_OPENCV", [*pinhole, *camera.distortion, 0.0, 0.0, 0.0]
    return "OPENCV", [*pinhole, *camera.distortion[:4]]


def _write_transforms(
    camera: Camera, matrix: Float[np.ndarray, "poses 3 4"], t_us: Int64[np.ndarray, "poses"], folder: Path
) -> None:
    """Write transforms.json: camera to world with y up and z backward, pixel centres at half-integers."""
    fisheye = camera.model == "equidistant"
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    whole = np.broadcast_to(np.eye(4), (len(matrix), 4, 4)).copy()
    whole[:, :3] = matrix * [1.0, -1.0, -1.0, 1.0]
    content: dict[str, Any] = {
        "camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV",
        "w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy,
        "cx": camera.cx + 0.5, "cy": camera.cy + 0.5,
        **dict(zip(names, camera.distortion, strict=False)),
        **({"ply_file_path": "points.ply"} if (folder / "points.ply").exists() else {}),
        "frames": [
            {"file_path": f"images/{FRAME_NAME.format(k)}.png", "transform_matrix": pose, "t_us": one}
            for k, (pose, one) in enumerate(zip(whole.tolist(), t_us.tolist(), strict=True))
        ],
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
