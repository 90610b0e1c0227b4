"""Exported trajectories, read back by the programs that they are for."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

from ebarf_ns.errors import ExportError
from ebarf_ns.export.trajectory import export_trajectory
from ebarf_ns.geometry.cameras import Camera
from ebarf_ns.scene import Scene
from tests.export.subjects import FISHEYE, PINHOLE, RADTAN, FoggyRoom, KnownRoom

CAMERAS = pytest.mark.parametrize("camera", [PINHOLE, RADTAN, FISHEYE], ids=lambda camera: camera.model)


def matrices(subject: KnownRoom) -> np.ndarray:
    return subject.trajectory.poses.matrix().numpy()


@pytest.mark.parametrize("rate_hz", [None, 1000.0])
def test_evo_reads_tum(known: KnownRoom, tmp_path: Path, rate_hz: float | None):
    count, _ = export_trajectory(known, "tum", tmp_path / "out.txt", rate_hz)
    read = file_interface.read_tum_trajectory_file(str(tmp_path / "out.txt"))
    assert read.num_poses == count == (21 if rate_hz is None else 1001)
    t_us = torch.from_numpy((read.timestamps * 1e6).round().astype(np.int64))
    expected = known.poses_at(t_us).matrix().numpy()
    assert t_us[0] == 1_000_000 and t_us[-1] == 2_000_000
    assert np.allclose(np.array(read.poses_se3)[:, :3], expected, atol=1e-7)


def test_evo_reads_kitti(known: KnownRoom, tmp_path: Path):
    export_trajectory(known, "kitti", tmp_path / "out.txt")
    read = file_interface.read_kitti_poses_file(str(tmp_path / "out.txt"))
    assert np.allclose(np.array(read.poses_se3)[:, :3], matrices(known), atol=1e-7)
    assert np.allclose(np.loadtxt(tmp_path / "out_times.txt"), known.trajectory.t_us.numpy() * 1e-6)


@CAMERAS
def test_nerfstudio_reads_transforms(scene: Scene, camera: Camera, tmp_path: Path):
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    subject = KnownRoom(scene, camera)
    export_trajectory(subject, "transforms", tmp_path / "out")
    as_it_is = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False, "eval_mode": "all"}
    config = NerfstudioDataParserConfig(data=tmp_path / "out", load_3D_points=True, **as_it_is)
    parsed = config.setup().get_dataparser_outputs("train")
    assert len(parsed.image_filenames) == 21 and all(path.stat().st_size > 500 for path in parsed.image_filenames)
    cameras = parsed.cameras
    opencv = cameras.camera_to_worlds.numpy() * [1, -1, -1, 1]
    assert np.allclose(opencv, matrices(subject), atol=1e-6)
    # Rays that nerfstudio makes of it are the camera's own, but for the fisheye's centre, where it divides 0 by 0.
    rays = cameras.generate_rays(3).directions.double()
    rotation = subject.trajectory.poses.matrix()[3, :, :3]
    expected = camera.bearings(camera.pixel_grid()) @ rotation.mT
    assert float((rays - expected).nan_to_num().abs().max()) < 2e-3
    assert len(parsed.metadata["points3D_xyz"]) > 1000


@CAMERAS
def test_colmap_text_is_what_its_manual_says(scene: Scene, camera: Camera, tmp_path: Path):
    subject = KnownRoom(scene, camera)
    export_trajectory(subject, "colmap", tmp_path / "out")
    model = tmp_path / "out" / "sparse" / "0"
    rows = [line.split() for line in (model / "cameras.txt").read_text().splitlines() if line[0] != "#"]
    ((number, name, width, height, *parameters),) = rows
    assert (number, int(width), int(height)) == ("1", 64, 48)
    assert name == {"pinhole": "PINHOLE", "radtan": "FULL_OPENCV", "equidistant": "OPENCV_FISHEYE"}[camera.model]
    assert [float(value) for value in parameters][:4] == [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]
    lines = [line for line in (model / "images.txt").read_text().splitlines() if not line.startswith("#")]
    images = [line.split() for line in lines[::2]]
    assert len(images) == 21 and not any(lines[1::2])
    for (_, w, x, y, z, *shift, _, name), matrix in zip(images, matrices(subject), strict=True):
        rotation = Rotation.from_quat([float(q) for q in (x, y, z, w)]).as_matrix()
        position = -rotation.T @ np.array(shift, float)
        assert np.allclose(rotation.T, matrix[:, :3], atol=1e-7) and np.allclose(position, matrix[:, 3], atol=1e-7)
        assert (tmp_path / "out" / "images" / name).is_file()
    points = np.loadtxt(model / "points3D.txt")
    assert points.shape[1] == 8 and len(points) > 1000


@CAMERAS
def test_pycolmap_reads_it(scene: Scene, camera: Camera, tmp_path: Path):
    pycolmap: Any = pytest.importorskip("pycolmap", reason="pycolmap is not installed: its reader is not asked")
    subject = KnownRoom(scene, camera)
    export_trajectory(subject, "colmap", tmp_path / "out")
    read = pycolmap.Reconstruction(str(tmp_path / "out" / "sparse" / "0"))
    assert read.num_images() == 21 and read.num_points3D() > 1000
    for number, matrix in enumerate(matrices(subject), start=1):
        image = read.images[number]
        pose: Any = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        assert np.allclose(image.projection_center(), matrix[:, 3], atol=1e-7)
        assert np.allclose(pose.rotation.matrix().T, matrix[:, :3], atol=1e-7)
    # Its camera model and ours put a direction into the same pixel, but for what they call its centre.
    direction = camera.bearings(torch.tensor([[5.0, 40.0], [50.0, 7.0]]))
    plane = (direction[:, :2] / direction[:, 2:]).numpy()
    pixel = np.array([read.cameras[1].img_from_cam(np.append(one, 1.0)) for one in plane]).reshape(-1, 2)
    assert np.allclose(pixel, camera.project(direction).numpy() + 0.5, atol=1e-6)


def test_long_brown_distortion_without_k3_is_opencv(scene: Scene, tmp_path: Path):
    camera = replace(RADTAN, distortion=RADTAN.distortion[:4])
    export_trajectory(KnownRoom(scene, camera, keyframes=4), "colmap", tmp_path / "out", rate_hz=20)
    assert "1 OPENCV 64 48 " in (tmp_path / "out" / "sparse" / "0" / "cameras.txt").read_text()


def test_frames_know_their_time(known: KnownRoom, tmp_path: Path):
    export_trajectory(known, "transforms", tmp_path / "out", rate_hz=5)
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    assert [frame["t_us"] for frame in frames] == [1_000_000, 1_200_000, 1_400_000, 1_600_000, 1_800_000, 2_000_000]


@pytest.mark.parametrize("format_", ["colmap", "transforms"])
def test_poses_and_pictures_are_exported_where_no_surface_is_sharp(
    scene: Scene, format_: Literal["colmap", "transforms"], tmp_path: Path
):
    assert export_trajectory(FoggyRoom(scene, keyframes=4), format_, tmp_path / "out") == (4, 0)
    assert len(list((tmp_path / "out" / "images").iterdir())) == 4
    if format_ == "colmap":
        assert len((tmp_path / "out" / "sparse" / "0" / "points3D.txt").read_text().splitlines()) == 1
    else:
        assert "ply_file_path" not in json.loads((tmp_path / "out" / "transforms.json").read_text())


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan"), 1e9])
def test_impossible_rates_are_refused(known: KnownRoom, tmp_path: Path, rate_hz: float):
    with pytest.raises(ExportError, match="rate is"):
        export_trajectory(known, "tum", tmp_path / "out.txt", rate_hz)
    assert not list(tmp_path.iterdir())
