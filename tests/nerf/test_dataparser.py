"""What nerfstudio is told of a scene."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest
import torch

from ebarf_ns.geometry.cameras import Camera
from ebarf_ns.geometry.trajectory import Poses, Trajectory
from ebarf_ns.geometry.trajectory_file import read_tum, write_tum
from ebarf_ns.nerf.dataparser import EbarfDataParserConfig, frame_cameras
from ebarf_ns.scene import read_scene, write_scene


@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_a_frame_camera_beside_the_event_camera_is_so_many_metres_away_whatever_the_trajectorys_unit(
    tiny_scene: Path, tmp_path: Path, scale: float
):
    folder = shutil.copytree(tiny_scene, tmp_path / "scene")
    scene = read_scene(folder)
    assert scene.groundtruth and scene.bounds
    true = read_tum(scene.groundtruth)
    write_tum(scene.trajectory, Trajectory(true.t_us, Poses(scale * true.poses.position, true.poses.quat_wxyz)))
    bounds = tuple(tuple(scale * side for side in corner) for corner in scene.bounds)
    places = []
    for beside_m in (0.0, 0.3):
        mount = ((1.0, 0, 0, beside_m), (0, 1.0, 0, 0), (0, 0, 1.0, 0), (0, 0, 0, 1.0))
        frames = tuple(dataclasses.replace(frame, event_camera_from_frame_camera=mount) for frame in scene.frames)
        write_scene(dataclasses.replace(scene, bounds=bounds, frames=frames))  # pyright: ignore[reportArgumentType]
        assert json.loads((folder / "scene.json").read_text())["frames"]
        outputs = EbarfDataParserConfig(data=folder).setup().get_dataparser_outputs(split="val")
        places.append(outputs.cameras.camera_to_worlds[:, :, 3] / outputs.dataparser_scale)
    apart = (places[1] - places[0]).norm(dim=-1)
    assert torch.allclose(apart, torch.full_like(apart, 0.3 * scale), rtol=1e-4)


def test_rays_of_a_fisheye_are_those_of_its_camera_at_the_very_centre_too(tiny_scene: Path):
    camera = Camera("equidistant", 9, 7, 10.0, 10.0, 4.0, 3.0, (0.1, 0.0, 0.0, 0.0))
    frame = dataclasses.replace(read_scene(tiny_scene).frames[0], camera=camera)
    still = Trajectory(torch.tensor([0]), Poses(torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]])))
    rays = frame_cameras([frame], still, 1.0).generate_rays(camera_indices=0).directions
    assert torch.allclose(rays, camera.bearings(camera.pixel_grid()).float(), atol=1e-3)
