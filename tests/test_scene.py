import json
import os
from dataclasses import replace
from pathlib import Path

import pytest

from ebarf_ns.errors import SceneError
from ebarf_ns.scene import read_scene, write_scene

CAMERA = {"model": "radtan", "width": 24, "height": 18, "fx": 30.0, "fy": 31.0, "cx": 11.5, "cy": 8.5,
          "distortion": [-0.1, 0.05, 0.0, 0.001]}  # fmt: skip
SCENE = {
    "format": "ebarf-scene", "version": 1, "events": "events.h5", "trajectory": "trajectory.txt", "groundtruth": None,
    "frames": "frames.json", "camera": CAMERA, "contrast_threshold": {"on": 0.2, "off": 0.3},
    "bounds": [[-1, -1, -1], [1, 1, 2]],
}  # fmt: skip
FRAME = {"file": "a.png", "t_us": 17, "intensity": "srgb"}


def make(folder: Path, scene: object = SCENE, frames: object = (FRAME,)) -> Path:
    for name in ("events.h5", "trajectory.txt", "a.png"):
        (folder / name).touch()
    (folder / "scene.json").write_text(json.dumps(scene))
    (folder / "frames.json").write_text(json.dumps(frames))
    return folder


def test_reads_what_the_format_says(tmp_path: Path):
    scene = read_scene(make(tmp_path))
    assert scene.camera.distortion == (-0.1, 0.05, 0.0, 0.001)
    assert scene.contrast_threshold is not None and scene.contrast_threshold.off == 0.3
    assert scene.bounds == ((-1, -1, -1), (1, 1, 2))
    assert scene.frames[0].camera == scene.camera and scene.frames[0].intensity == "srgb"
    assert scene.groundtruth is None


def test_optional_keys_may_be_missing(tmp_path: Path):
    needed = {key: SCENE[key] for key in ("format", "version", "events", "trajectory", "camera")}
    scene = read_scene(make(tmp_path, needed))
    assert scene.bounds is None and scene.contrast_threshold is None and scene.frames == ()


def test_written_scene_reads_back_equal(tmp_path: Path):
    scene = read_scene(make(tmp_path))
    moved = replace(scene.frames[0], event_camera_from_frame_camera=((1, 0, 0, 2), (0, 1, 0, 0), (0, 0, 1, 0),
                                                                    (0, 0, 0, 1)))  # fmt: skip
    scene = replace(scene, frames=(moved, replace(moved, camera=replace(scene.camera, fx=99.0))))
    write_scene(scene)
    assert read_scene(tmp_path) == scene


def changed(**changes: object) -> dict:
    return {**SCENE, **changes}


def camera(**changes: object) -> dict:
    return changed(camera={**CAMERA, **changes})


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        (changed(format="other"), "format is 'other', expected one of ebarf-scene"),
        (changed(version=2), "version is 2, expected at most 1: a newer ebarf_ns made it"),
        (changed(version=0), "version is 0, expected an integer above 0"),
        (changed(events="a\x00b"), r"events is 'a\x00b', expected a file name"),
        (changed(events="\ud800.h5"), r"events is '\ud800.h5', expected a file name"),
        (changed(events="../events.h5"), "events is '../events.h5', expected a file in the same folder"),
        (changed(trajectory="/etc/passwd"), "trajectory is '/etc/passwd', expected a file in the same folder"),
        (camera(width=70_000, height=70_000), "camera.width is 70000, expected at most 67,108,864 pixels"),
        (camera(width=10**4000), "expected at most 67,108,864 pixels"),
        (camera(fx=1e300), "camera.fx is 1e+300, expected 0.0001 to"),
        (camera(cx=-1e300), "camera.cx is -1e+300, expected within ±"),
        (changed(bounds=[[-1e308] * 3, [1e308] * 3]), "on every axis, within ±1e+09"),
        (changed(contrast_threshold={"on": 1e300, "off": 0.2}), "on is 1e+300, expected a number from"),
        (changed(evnets="x"), "unknown key evnets"),
        (changed(trajectory="gone.txt"), "trajectory names 'gone.txt', but there is no file"),
        (changed(events=3), "events is 3, expected a file name"),
        (changed(groundtruth="gone.txt"), "groundtruth names 'gone.txt'"),
        (changed(camera=None), "camera is None, expected a JSON object"),
        (camera(model="fisheye"), "camera.model is 'fisheye', expected one of pinhole, radtan, equidistant"),
        (camera(width=0), "camera.width is 0, expected an integer above 0"),
        (camera(width=24.5), "camera.width is 24.5, expected an integer"),
        (camera(fx=-1), "camera.fx is -1, expected a finite number above 0"),
        (camera(cx=float("nan")), "camera.cx is nan, expected a finite number"),
        (camera(cy=10**400), "camera.cy is 1000"),
        (camera(cy="8"), "camera.cy is '8', expected a finite number"),
        (camera(distortion=[1, 2]), "camera.distortion is [1, 2], expected a list of 4 or 5 numbers"),
        (camera(k1=0.1), "unknown key camera.k1"),
        (changed(contrast_threshold={"on": 0.2}), "contrast_threshold.off is missing, expected a finite number above"),
        (changed(contrast_threshold={"on": 0, "off": 1}), "contrast_threshold.on is 0"),
        (changed(bounds=[[0, 0, 0], [1, 1, 0]]), "bounds is"),
        (changed(bounds=[[0, 0], [1, 1]]), "bounds is"),
        (changed(bounds=7), "bounds is 7, expected two corners"),
        ([], "the file is [], expected a JSON object"),
    ],
)  # fmt: skip
def test_wrong_scene_names_file_key_value_and_expectation(tmp_path: Path, scene: object, words: str):
    with pytest.raises(SceneError) as caught:
        read_scene(make(tmp_path, scene))
    message = str(caught.value)
    assert message.startswith(str(tmp_path / "scene.json")) and words in message and "\n" not in message


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        ({**FRAME, "t_us": 1.5}, "[0].t_us is 1.5, expected an integer"),
        ({**FRAME, "t_us": 10**30}, "expected microseconds within ±"),
        ({**FRAME, "file": "../frame.png"}, "[0].file is '../frame.png', expected a file in the same folder"),
        ({**FRAME, "intensity": "gamma"}, "[0].intensity is 'gamma', expected one of linear, srgb, log"),
        ({**FRAME, "event_camera_from_frame_camera": [[1, 0], [0, 1]]}, "expected a 4x4 matrix"),
        ({**FRAME, "exposure": 1}, "unknown key [0].exposure"),
        (5, "[0] is 5, expected a JSON object"),
    ],
)
def test_wrong_frame_is_named(tmp_path: Path, frame: object, words: str):
    with pytest.raises(SceneError, match="frames.json") as caught:
        read_scene(make(tmp_path, frames=[frame]))
    assert words in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe{}", b"[" * 100_000, b"[" + b"4" * 5_000 + b"]"])
def test_broken_json_is_named(tmp_path: Path, content: bytes):
    make(tmp_path)
    (tmp_path / "scene.json").write_bytes(content)
    with pytest.raises(SceneError, match="scene.json"):
        read_scene(tmp_path)


def test_a_key_that_appears_twice_is_named(tmp_path: Path):
    path = make(tmp_path) / "scene.json"
    path.write_text(path.read_text().replace("{", '{"events": "other.h5", ', 1))
    with pytest.raises(SceneError, match=r"scene.json: not valid JSON \(key events appears twice\)"):
        read_scene(tmp_path)


@pytest.mark.parametrize("name", ["scene.json", "events.h5", "trajectory.txt"])
def test_a_pipe_is_never_waited_for(tmp_path: Path, name: str):
    (make(tmp_path) / name).unlink(missing_ok=True)
    os.mkfifo(tmp_path / name)
    with pytest.raises(SceneError, match=r"scene.json: (a pipe or a device|.* which is not a file)"):
        read_scene(tmp_path)


def test_missing_folder_is_named(tmp_path: Path):
    with pytest.raises(SceneError, match="no such folder, expected a scene folder with scene.json in it$"):
        read_scene(tmp_path / "gone")


def test_a_folder_of_nearly_that_name_is_offered(tmp_path: Path):
    (tmp_path / "demo" / "scene").mkdir(parents=True)
    for typed in ("demo/scen", "demmo/scene"):
        with pytest.raises(SceneError) as caught:
            read_scene(tmp_path / typed)
        assert str(caught.value).endswith(f"; did you mean {tmp_path / 'demo' / 'scene'}?")


def test_frames_that_are_not_there_are_left_out_and_listed(tmp_path: Path):
    frames = [FRAME, {**FRAME, "file": "gone.png"}, {**FRAME, "depth": "gone.npy"}]
    scene = read_scene(make(tmp_path, frames=frames))
    assert [frame.path.name for frame in scene.frames] == ["a.png", "a.png"]
    assert scene.frames[1].depth is None
    assert [path.name for path in scene.missing] == ["gone.png", "gone.npy"]
    (tmp_path / "frames.json").unlink()
    scene = read_scene(tmp_path)
    assert scene.frames == () and scene.missing == (tmp_path / "frames.json",)
