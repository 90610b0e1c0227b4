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
from ebarf_ns.nerf.dataparser import EbarfDataParserConfig, frame_cameras, keep_scene
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


def test_a_scene_that_is_gone_is_opened_by_what_the_run_has_kept(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    scene, kept = read_scene(tiny_scene), tmp_path / "run" / "scene"
    keep_scene(scene, kept)
    there = EbarfDataParserConfig(data=tiny_scene, kept=kept).setup()
    assert there.scene == scene and not capsys.readouterr().err
    gone = EbarfDataParserConfig(data=tmp_path / "gone", kept=kept).setup()
    assert torch.equal(gone.trajectory.poses.position, there.trajectory.poses.position)
    assert gone.scene.camera == scene.camera and gone.scene.bounds == scene.bounds and not gone.scene.frames
    assert torch.equal(gone.normalization.centre, there.normalization.centre)
    said = capsys.readouterr().err
    assert f"{tmp_path / 'gone'}: no such folder" in said and said.count("\n") == 1


def test_missing_frames_are_said_and_do_without(tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = shutil.copytree(tiny_scene, tmp_path / "scene")
    (folder / "frames" / "0001.png").unlink()
    outputs = EbarfDataParserConfig(data=folder).setup().get_dataparser_outputs(split="val")
    assert [path.name for path in outputs.image_filenames] == ["0000.png", "0002.png"]
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.startswith("warning: ") and "0001.png: no such file" in said
    shutil.rmtree(folder / "frames")
    outputs = EbarfDataParserConfig(data=folder).setup().get_dataparser_outputs(split="val")
    assert all(path.parent.name == "keyframes" for path in outputs.image_filenames)


def test_another_scene_in_the_place_of_a_runs_is_refused(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder, kept = shutil.copytree(tiny_scene, tmp_path / "scene"), tmp_path / "run" / "scene"
    keep_scene(read_scene(folder), kept)
    lines = (folder / "trajectory.txt").read_text().splitlines(keepends=True)
    (folder / "trajectory.txt").write_text("".join(lines[:-2]))
    with pytest.raises(SystemExit) as stopped:
        EbarfDataParserConfig(data=folder, kept=kept).setup()
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and f"error: {folder / 'trajectory.txt'}: 9 keyframes, other than the 11 of" in said


@pytest.mark.parametrize(
    ("content", "place"),
    [
        ("pipeline:\n  datamanager:\n    a: 1\n    data: *id004\n    dataparser: x\n      data: y\n", "line 4 of {}"),
        ("pipeline:\n  datamanager:\n    data: !!path\n    - a\n    - b\n    dataparser: x\n", "lines 3 to 5 of {}"),
        ("no such line", "'data:' under pipeline, datamanager in the run's config.yml"),
    ],
)
def test_the_line_to_change_is_named_where_nothing_is_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str, place: str
):
    (tmp_path / "config.yml").write_text(content)
    with pytest.raises(SystemExit) as stopped:
        EbarfDataParserConfig(data=tmp_path / "gone", kept=tmp_path / "scene").setup()
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and f"error: {tmp_path / 'gone'}: no such folder, expected the scene of" in said
    assert place.format(tmp_path / "config.yml") in said


def test_rays_of_a_fisheye_are_those_of_its_camera_at_the_very_centre_too(tiny_scene: Path):
    camera = Camera("equidistant", 9, 7, 10.0, 10.0, 4.0, 3.0, (0.1, 0.0, 0.0, 0.0))
    frame = dataclasses.replace(read_scene(tiny_scene).frames[0], camera=camera)
    still = Trajectory(torch.tensor([0]), Poses(torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]])))
    rays = frame_cameras([frame], still, 1.0).generate_rays(camera_indices=0).directions
    assert torch.allclose(rays, camera.bearings(camera.pixel_grid()).float(), atol=1e-3)
