"""Synthetic dataset folders with the keys, types and clocks of their authors become scenes."""

import json
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from scipy.spatial.transform import Rotation

from ebarf_ns.errors import EbarfError, RecordingError, SceneError
from ebarf_ns.events.recording import read_recording
from ebarf_ns.formats.calibration import read_calibration, read_cameras
from ebarf_ns.formats.intake import Intake
from ebarf_ns.formats.process import ProcessSettings, process
from ebarf_ns.formats.raw_inspection import inspect_recording
from ebarf_ns.formats.recognise import open_recording
from ebarf_ns.formats.trajectory_formats import TrajectoryFormat
from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.inspection import inspect_scene
from ebarf_ns.scene import read_scene
from tests.conftest import DATA, REPOSITORY, run_command, run_ok
from tests.formats import writers
from tests.formats.test_recognise import bag1, messages, types

STEREO = [("sensor_msgs", "Image"), ("std_msgs", "Header"), ("builtin_interfaces", "Time")]
COMPRESSED = [("sensor_msgs", "CompressedImage"), *STEREO[1:]]
EVENTS: list[writers.Event] = [(t, t // 1000 % 64, t // 3000 % 48, t // 7000 % 2) for t in range(0, 2_000_000, 1000)]
POSES = [(t, 0.1 * t / 1e6, np.sin(t / 1e6), 0.0) for t in range(0, 2_100_000, 8333)]
TURNS = [Rotation.from_rotvec([0.1 * t / 1e6, 0.2, 0.05 * t / 1e6]) for t, *_ in POSES]


def columns() -> dict[str, np.ndarray]:
    t, x, y, p = (np.array(column) for column in zip(*EVENTS, strict=True))
    return {"t": t.astype(np.int64), "x": x.astype(np.uint16), "y": y.astype(np.uint16), "p": p.astype(np.uint8)}


def write_h5(path: Path, group: str, shift_us: int = 0) -> None:
    with h5py.File(path, "w") as file:
        for name, column in columns().items():
            file[f"{group}/{name}"] = column + shift_us if name == "t" else column


def poses(unit: str, shift_us: int = 0, turn: Rotation | None = None) -> str:
    lines = []
    for (t, *position), of_camera in zip(POSES, TURNS, strict=True):
        t += shift_us  # noqa: PLW2901
        time = {"s": f"{t // 10**6}.{t % 10**6:06d}", "us": f"{t}", "ns": f"{1000 * t}"}[unit]
        quat = (of_camera * turn if turn else of_camera).as_quat()
        lines.append(f"{time} {' '.join(f'{v:.9f}' for v in (*position, *quat))}\n")
    return "".join(lines)


def picture(path: Path, side: int = 16) -> None:
    path.parent.mkdir(exist_ok=True, parents=True)
    cv2.imwrite(str(path), np.arange(side * side, dtype=np.uint8).reshape(side, side))


def basalt(turn: Rotation) -> dict:
    """TUM-VIE's layout, with event cameras as small as the test recording."""
    qx, qy, qz, qw = turn.as_quat().tolist()
    pose = {"px": 0.1, "py": 0.0, "pz": -0.05, "qx": qx, "qy": qy, "qz": qz, "qw": qw}
    still = {"px": 0.0, "py": 0.0, "pz": 0.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "qw": 1.0}
    lens = {"fx": 60.0, "fy": 60.0, "cx": 32.0, "cy": 24.0, "k1": -0.1, "k2": 0.07, "k3": -0.2, "k4": 0.18}
    intrinsics = [{"camera_type": "kb4", "intrinsics": lens}] * 4
    size = [[16, 16], [16, 16], [64, 48], [64, 48]]
    return {"value0": {"intrinsics": intrinsics, "resolution": size, "T_imu_cam": [still, still, pose, pose]}}


def tumvie(folder: Path) -> Path:
    folder.mkdir()
    write_h5(folder / "mocap-desk2-events_left.h5", "events")
    turn = Rotation.from_rotvec([0.3, -0.2, 0.1])
    (folder / "camera-calibrationA.json").write_text(json.dumps(basalt(turn)))
    qx, qy, qz, qw = turn.as_quat().tolist()
    marker = {"px": 0.1, "py": 0.0, "pz": -0.05, "qx": qx, "qy": qy, "qz": qz, "qw": qw}
    (folder / "mocap-imu-calibrationA.json").write_text(json.dumps({"value0": {"T_imu_marker": marker}}))
    ground = folder / "vi_gt_data"
    for k in range(10):
        picture(ground / "left_images" / f"{k:05d}.jpg")
    times = "# timestamps [us]\n" + "".join(f"{150_000 * k}\n" for k in range(10))
    (ground / "image_timestamps_left.txt").write_text(times)
    (ground / "mocap_data.txt").write_text("#timestamp [us] px py pz qx qy qz qw\n" + poses("us"))
    return folder


def eds(folder: Path) -> Path:
    folder.mkdir()
    start_us = 1_600_000_000_000_000
    write_h5(folder / "events.h5", "/", start_us)
    (folder / "stamped_groundtruth.txt").write_text("# t px py pz qx qy qz qw\n" + poses("s", start_us))
    (folder / "images").mkdir()
    for k in range(3):
        cv2.imwrite(str(folder / "images" / f"frame_{k:010d}.png"), np.full((480, 640), 50 * k, np.uint8))
    (folder / "images_timestamps.txt").write_text("".join(f"{start_us + 500_000 * k}\n" for k in (1, 2, 3)))
    return folder


def evo(path: Path) -> Path:
    return bag1(path.with_suffix(".bag"), EVENTS, (240, 180))


def esim(folder: Path) -> Path:
    (folder / "events").mkdir(parents=True)
    column = columns()
    rows = np.stack([column["x"], column["y"], column["t"] * 1000, 2 * column["p"].astype(int) - 1], axis=1)
    for k, part in enumerate(np.array_split(rows, 4)):
        np.save(folder / "events" / f"{k:010d}.npy", part.astype(float))
    (folder / "room_poses_all.txt").write_text("# t_ns px py pz qx qy qz qw\n" + poses("ns"))
    return folder


def robust(folder: Path) -> Path:
    folder.mkdir()
    column = columns()
    position = np.stack([column["x"], column["y"]], axis=1)
    np.savez(folder / "raw_events.npz", position=position, timestamp=1000 * column["t"], polarity=column["p"] > 0)
    np.savez(
        folder / "camera_poses.npz",
        T_wc_position=np.array([one[1:] for one in POSES], np.float32),
        T_wc_orientation=np.array([turn.as_quat() for turn in TURNS], np.float32),
        T_wc_timestamp=np.array([1000 * one[0] for one in POSES]),
    )
    np.savez(
        folder / "camera_calibration.npz",
        intrinsics=np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), distortion_params=np.array([]),
        distortion_model="plumb_bob", img_height=48, img_width=64, pos_contrast_threshold=0.25,
        neg_contrast_threshold=0.3, refractory_period=0, bayer_pattern="",
    )  # fmt: skip
    return folder


def calibration(folder: Path) -> Path:
    path = folder / "camera.json"
    camera = {"model": "pinhole", "width": 64, "height": 48, "fx": 60, "fy": 60, "cx": 32, "cy": 24, "distortion": []}
    path.write_text(json.dumps({"camera": camera}))
    return path


MADE = {"tumvie": tumvie, "eds": eds, "esim": esim, "robust-e-nerf": robust}


@pytest.mark.parametrize("layout", list(MADE))
@pytest.mark.parametrize("named", [True, False])
def test_a_dataset_becomes_a_scene(tmp_path: Path, layout: str, named: bool):
    source = MADE[layout](tmp_path / "source")
    before = {path: path.stat().st_mtime_ns for path in source.rglob("*")}
    settings = ProcessSettings(camera=calibration(tmp_path) if layout in ("eds", "esim") else None)
    said = process(layout if named else "auto", source, tmp_path / "scene", settings)  # pyright: ignore[reportArgumentType]
    assert {path: path.stat().st_mtime_ns for path in source.rglob("*")} == before
    scene = read_scene(tmp_path / "scene")
    recording, expected = read_recording(scene.events, 64, 48), writers.recording(EVENTS)
    assert np.array_equal(recording.t_us - recording.t_us[0], expected.t_us) and np.array_equal(recording.x, expected.x)
    keyframes = read_tum(scene.trajectory)
    assert np.allclose(keyframes.poses.position[:5].numpy(), [one[1:] for one in POSES[:5]], atol=1e-6)
    turned = Rotation.from_quat(keyframes.poses.quat_wxyz[:5, [1, 2, 3, 0]].numpy())
    assert (turned * Rotation.concatenate(TURNS[:5]).inv()).magnitude().max() < 1e-6
    assert scene.groundtruth and any("2,000 events read, 2,000 kept" in sentence for sentence in said)
    summary = inspect_scene(tmp_path / "scene")
    assert summary.events == 2000 and summary.keyframes > 200
    if layout == "tumvie":
        assert len(scene.frames) == 10 and scene.frames[0].camera.width == 16 and scene.camera.model == "equidistant"
    if layout == "robust-e-nerf":
        assert scene.contrast_threshold and scene.contrast_threshold.off == 0.3


def test_a_scene_of_a_recording_and_an_odometry(tmp_path: Path):
    writers.raw(tmp_path / "a.raw", "3.0", writers.evt3(EVENTS), size=(64, 48))
    (tmp_path / "odometry.txt").write_text(poses("s"))
    out = run_command(
        "ebarf", "process", "auto", tmp_path / "a.raw", "--output", tmp_path / "scene", "--camera",
        calibration(tmp_path), "--trajectory", tmp_path / "odometry.txt", "--contrast-threshold", 0.2, 0.25,
        "--farthest", 3.0, "--end-us", 1_000_000,
    )  # fmt: skip
    assert out.code == 0 and "left out: 999 events outside the time window" in out.errors, out.errors
    scene = read_scene(tmp_path / "scene")
    assert scene.bounds and np.array(scene.bounds)[1].max() > 2.5 and scene.groundtruth is None
    assert scene.contrast_threshold and scene.contrast_threshold.on == 0.2


@pytest.mark.parametrize("path", sorted((REPOSITORY / "configs").glob("*.yaml")), ids=lambda path: path.stem)
def test_configurations_of_public_scenes(tmp_path: Path, path: Path):
    name = path.stem.split("_")[0]
    source = evo(tmp_path / "source") if name == "evo" else MADE[name](tmp_path / "source")
    words = ["ebarf", "process", "--config", path, "--source", source, "--output", tmp_path / "scene"]
    if name == "evo":
        (tmp_path / "odometry.txt").write_text(poses("s"))
        words += ["--trajectory", tmp_path / "odometry.txt"]
    if name == "eds":
        # The real camera is larger than the test recording.
        words += ["--start-us", 1_600_000_000_000_000]
    else:
        words += ["--start-us", 0]
    run_ok(*words)
    scene = read_scene(tmp_path / "scene")
    assert scene.camera.width == {"eds": 640, "evo": 240}.get(name, 64)
    assert (scene.contrast_threshold is None) == (path.stem in ("eds_00", "evo_flyingroom"))
    if name == "eds":
        assert [frame.camera.fx for frame in scene.frames] == pytest.approx([766.536] * 3, abs=1e-3)
        # The frame camera is 4.4 mm behind the event camera.
        assert scene.frames[0].event_camera_from_frame_camera[2][3] == pytest.approx(-0.0044167, abs=1e-6)


def test_a_reference_determines_an_unknown_time_unit(tmp_path: Path):
    source = tumvie(tmp_path / "source")
    lines = [line.split() for line in poses("us").splitlines()]
    permuted = "".join(f"{float(t)} {x} {y} {z} {qy} {qz} {qw} {qx}\n" for t, x, y, z, qx, qy, qz, qw in lines)
    (tmp_path / "devo.txt").write_text(permuted)
    said = process("tumvie", source, tmp_path / "scene", ProcessSettings(trajectory=tmp_path / "devo.txt"))
    assert any("yzwx" in sentence for sentence in said)
    keyframes = read_tum(tmp_path / "scene" / "trajectory.txt")
    back = Rotation.from_quat(keyframes.poses.quat_wxyz[0, [1, 2, 3, 0]].numpy())
    assert (back * TURNS[0].inv()).magnitude() < 1e-6


def test_format_flags_apply_to_the_trajectory_and_not_to_the_reference(tmp_path: Path):
    source = tumvie(tmp_path / "source")
    wxyz = [line.split() for line in poses("s").splitlines()]
    lines = "".join(f"{t} {x} {y} {z} {qw} {qx} {qy} {qz}\n" for t, x, y, z, qx, qy, qz, qw in wxyz)
    (tmp_path / "odometry.txt").write_text(lines)
    (tmp_path / "reference.txt").write_text(poses("s"))
    settings = ProcessSettings(
        trajectory=tmp_path / "odometry.txt",
        trajectory_format=TrajectoryFormat(quaternion="wxyz"),
        groundtruth=tmp_path / "reference.txt",
    )
    process("tumvie", source, tmp_path / "scene", settings)
    for name in ("trajectory.txt", "groundtruth.txt"):
        back = Rotation.from_quat(read_tum(tmp_path / "scene" / name).poses.quat_wxyz[0, [1, 2, 3, 0]].numpy())
        assert (back * TURNS[0].inv()).magnitude() < 1e-6


def test_the_right_camera_of_tum_vie_with_a_calibration_from_elsewhere_and_no_frames(tmp_path: Path):
    source = tumvie(tmp_path / "source")
    for name in ("camera-calibrationA.json", "mocap-imu-calibrationA.json"):
        (source / name).rename(tmp_path / name)
    (source / "mocap-desk2-events_left.h5").rename(source / "mocap-desk2-events_right.h5")
    (source / "vi_gt_data" / "image_timestamps_right.txt").write_text("1\n2\n")  # and no pictures
    settings = ProcessSettings(camera=tmp_path / "camera-calibrationA.json", part="right", frames=False)
    process("tumvie", source, tmp_path / "scene", settings)
    scene = read_scene(tmp_path / "scene")
    assert scene.camera.width == 64 and scene.groundtruth and not scene.frames
    with pytest.raises(SceneError, match="part 'middle', expected one of left, right"):
        process("tumvie", source, tmp_path / "other", ProcessSettings(part="middle"))


def test_a_given_calibration_takes_precedence_over_the_folders_own(tmp_path: Path):
    source = robust(tmp_path / "source")
    (source / "camera_calibration.npz").unlink()
    process("robust-e-nerf", source, tmp_path / "scene", ProcessSettings(camera=calibration(tmp_path)))
    scene = read_scene(tmp_path / "scene")
    assert scene.camera.fx == 60 and scene.contrast_threshold is None


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (ProcessSettings(contrast_threshold=(0.2, 0.0)), "--contrast-threshold OFF is 0.0, expected a finite number"),
        (ProcessSettings(contrast_threshold=(float("nan"), 0.2)), "--contrast-threshold ON is nan"),
        (ProcessSettings(bounds=((1, 1, 1), (0, 2, 2))), "--bounds is .* expected a first corner below the second"),
        (ProcessSettings(farthest=-1.0), "--farthest is -1.0"),
        (ProcessSettings(), "expected --camera"),
        (ProcessSettings(camera=Path("gone.json")), "gone.json"),
        (ProcessSettings(events=Intake(start_us=10**9)), "expected --camera"),
    ],
)
def test_missing_parts_are_reported_and_leave_no_folder(tmp_path: Path, settings: ProcessSettings, words: str):
    with pytest.raises(EbarfError, match=words):
        process("esim", esim(tmp_path / "source"), tmp_path / "scene", settings)
    assert [path.name for path in tmp_path.iterdir()] == ["source"]


def test_two_sizes_of_one_sensor_are_an_error(tmp_path: Path):
    writers.raw(tmp_path / "a.raw", "2.0", writers.evt2(EVENTS), size=(1280, 720))
    with pytest.raises(SceneError, match="1280 x 720 pixels, the calibration 64 x 48"):
        process("raw", tmp_path / "a.raw", tmp_path / "scene", ProcessSettings(camera=calibration(tmp_path)))


def test_a_trajectory_on_another_clock_is_an_error(tmp_path: Path):
    (tmp_path / "late.txt").write_text(poses("s", 10**12))
    settings = ProcessSettings(camera=calibration(tmp_path), trajectory=tmp_path / "late.txt")
    with pytest.raises(EbarfError, match="on the same clock"):
        process("esim", esim(tmp_path / "source"), tmp_path / "scene", settings)


def odometry(tmp_path: Path, text: str, **settings: Any) -> tuple[list[str], list[str]]:
    """Notes on the trajectory, and suspicions about its scene."""
    (tmp_path / "odometry.txt").write_text(text)
    known = ProcessSettings(camera=calibration(tmp_path), trajectory=tmp_path / "odometry.txt", **settings)
    source = tmp_path / "source"
    if not source.exists():
        esim(source)
    said = process("esim", source, tmp_path / "scene", known)
    return said, inspect_scene(tmp_path / "scene").suspicions


def test_events_between_two_poses_are_in_another_unit(tmp_path: Path):
    every_10_ms = [line.split() for line in poses("s").splitlines()]
    text = "".join(" ".join([f"{10 * k}", *line[1:]]) + "\n" for k, line in enumerate(every_10_ms))
    with pytest.raises(EbarfError, match=r"in s and in ms; expected --pose-time-unit.*: 1 in s, 200 in ms\)"):
        odometry(tmp_path, text)
    with pytest.raises(
        EbarfError, match="beside a trajectory over 63000.000 s; expected .* or another --pose-time-unit"
    ):
        sparse = "".join(" ".join([f"{250 * k}", *line[1:]]) + "\n" for k, line in enumerate(every_10_ms))
        odometry(tmp_path, sparse, trajectory_format=TrajectoryFormat("s"))
    assert not (tmp_path / "scene").exists()
    said, suspicions = odometry(tmp_path, text, trajectory_format=TrajectoryFormat("ms"))
    assert any("201 keyframes around the events" in sentence for sentence in said), said
    assert not any("another unit" in sentence for sentence in suspicions)


def test_a_window_between_two_poses_is_a_suspicion(tmp_path: Path):
    window = Intake(start_us=100_000, end_us=104_000)
    said, suspicions = odometry(tmp_path, poses("s"), events=window)
    assert any("0 of them among the events" in sentence for sentence in said), said
    assert any("lie between keyframes 0 and 1, 8.33 ms apart: times in another unit?" in one for one in suspicions)


def test_a_late_trajectory_is_said_to_leave_events_out(tmp_path: Path):
    for sentences in odometry(tmp_path, "".join(poses("s").splitlines(keepends=True)[120:])):
        assert any("50% of the events lie outside the trajectory's span" in sentence for sentence in sentences)
    (tmp_path / "scene").rename(tmp_path / "late")
    for sentences in odometry(tmp_path, poses("s")):
        assert not any("outside the trajectory's span" in sentence for sentence in sentences)


def test_a_discontinuous_trajectory_is_reported_and_suspected(tmp_path: Path):
    lines = [line.split() for line in poses("s").splitlines()]
    text = "".join(" ".join([t, f"{float(x) + 3 * (k > 99)}", *rest]) + "\n" for k, (t, x, *rest) in enumerate(lines))
    for sentences in odometry(tmp_path, text):
        assert any("between keyframes 99 and 100 (8.33 ms" in sentence for sentence in sentences), sentences


def test_a_scene_saved_with_byte_order_marks_is_read(tmp_path: Path):
    odometry(tmp_path, poses("s"))
    for name in ("scene.json", "trajectory.txt"):
        path = tmp_path / "scene" / name
        path.write_bytes(path.read_text().replace("\n", "\r\n").encode("utf-8-sig"))
    assert inspect_scene(tmp_path / "scene").keyframes > 200


def test_a_zip_is_as_good_as_its_folder(tmp_path: Path):
    esim(tmp_path / "source")
    shutil.make_archive(str(tmp_path / "source"), "zip", tmp_path, "source")
    with zipfile.ZipFile(tmp_path / "source.zip", "a") as archive:
        archive.writestr("__MACOSX/source/._events", b"as macOS adds it")
    said = process("esim", tmp_path / "source.zip", tmp_path / "scene", ProcessSettings(camera=calibration(tmp_path)))
    assert any("2,000 kept" in sentence for sentence in said)


def test_errors_after_unpacking_do_not_blame_the_zip(tmp_path: Path):
    esim(tmp_path / "source")
    shutil.make_archive(str(tmp_path / "source"), "zip", tmp_path, "source")
    (tmp_path / "file").write_text("where a folder should be")
    settings = ProcessSettings(camera=calibration(tmp_path))
    with pytest.raises(OSError, match="file"):
        process("esim", tmp_path / "source.zip", tmp_path / "file" / "scene", settings)


def test_frames_of_a_bag_are_those_beside_its_events(tmp_path: Path):
    path = stereo_bag(tmp_path / "stereo.bag")
    (tmp_path / "odometry.txt").write_text(poses("s"))
    (tmp_path / "camera.json").write_text(calibration(tmp_path).read_text())
    for side, grey in (("left", 10), ("right", 200)):
        settings = ProcessSettings(
            camera=tmp_path / "camera.json", trajectory=tmp_path / "odometry.txt", part=f"/davis/{side}/events"
        )
        said = process("bag", path, tmp_path / side, settings)
        topic = f"/davis/{side}/image_color: those of /davis/{side}/image_raw are taken"
        assert f"left out: 2 frames of {topic}" in said
        pictures = [cv2.imread(str(frame.path), -1) for frame in read_scene(tmp_path / side).frames]
        assert len(pictures) == 2 and all((one == grey).all() for one in pictures if one is not None)


GREY = np.arange(48 * 64).reshape(48, 64) % 180 + 20
BAYER_ON = {"bayer_rggb8": (0, 0), "bayer_bggr8": (1, 1), "bayer_grbg8": (0, 1), "bayer_gbrg8": (1, 0)}
"""Position of the first red pixel."""


def image_bag(
    path: Path, encoding: str, pixels: np.ndarray, size: tuple[int, int] = (64, 48), big: bool = False
) -> Path:
    """Events and two images with the given fields."""
    store = types(1)
    image, header, time = (store.types[f"{of}/msg/{name}"] for of, name in STEREO)
    with Writer1(path) as bag:
        events = bag.add_connection("/dvs/events", "dvs_msgs/msg/EventArray", typestore=store)
        for k, message in enumerate(messages(store, EVENTS, (64, 48))):
            bag.write(events, 10**9 + k, store.serialize_ros1(message, "dvs_msgs/msg/EventArray"))
        topic = bag.add_connection("/dvs/image_raw", "sensor_msgs/msg/Image", typestore=store)
        for second in (0, 1):
            head, data = header(0, time(second, 500_000_000), ""), np.frombuffer(pixels.tobytes(), np.uint8)
            message = image(head, size[1], size[0], encoding, int(big), pixels.nbytes // len(pixels), data)
            bag.write(topic, 10**9 + second, store.serialize_ros1(message, "sensor_msgs/msg/Image"))
    return path


def frames_and_sentences(tmp_path: Path, bag: Path) -> tuple[list[np.ndarray], str]:
    (tmp_path / "odometry.txt").write_text(poses("s"))
    settings = ProcessSettings(camera=calibration(tmp_path), trajectory=tmp_path / "odometry.txt")
    said = process("bag", bag, tmp_path / "scene", settings)
    frames = [cv2.imread(str(frame.path), cv2.IMREAD_UNCHANGED) for frame in read_scene(tmp_path / "scene").frames]
    assert inspect_scene(tmp_path / "scene").events == 2000
    return [frame for frame in frames if frame is not None], " ".join(said)


@pytest.mark.parametrize("encoding", ["mono8", "8UC1", "bgr8", "rgb8", "bgra8", "rgba8", "bayer_rggb8", "bayer_gbrg8"])
def test_frames_of_a_bag_are_grey_whatever_their_encoding(tmp_path: Path, encoding: str):
    channels = {"bgr8": 3, "rgb8": 3, "bgra8": 4, "rgba8": 4}.get(encoding, 1)
    # For a Bayer pattern, only a uniform image has a known result.
    grey = np.full_like(GREY, 77) if "bayer" in encoding else GREY
    pixels = np.repeat(grey[..., None], channels, axis=-1).astype(np.uint8)
    found, said = frames_and_sentences(tmp_path, image_bag(tmp_path / "a.bag", encoding, pixels))
    assert len(found) == 2 and all(np.abs(one.astype(int) - grey).max() <= 1 for one in found), said
    assert "2 of 2 frames within their span" in said and "frames of" not in said


@pytest.mark.parametrize("encoding", [*BAYER_ON, "rgb8", "bgr8", "rgba8"])
def test_red_is_taken_for_red(tmp_path: Path, encoding: str):
    """Red contributes 30 % to grey, blue 11 %."""
    if encoding in BAYER_ON:
        pixels, (row, column) = np.zeros((48, 64), np.uint8), BAYER_ON[encoding]
        pixels[row::2, column::2] = 200
    else:
        pixels = np.zeros((48, 64, len(encoding) - 1), np.uint8)
        pixels[..., encoding.index("r")] = 200
    found, _ = frames_and_sentences(tmp_path, image_bag(tmp_path / "a.bag", encoding, pixels))
    assert all(one[8:-8, 8:-8].mean() == pytest.approx(60, abs=2) for one in found) and len(found) == 2


@pytest.mark.parametrize("big", [False, True])
def test_ten_bit_frames_in_sixteen_bits_are_scaled_to_full_range(tmp_path: Path, big: bool):
    pixels = (5 * GREY).astype(">u2" if big else "<u2")
    found, _ = frames_and_sentences(tmp_path, image_bag(tmp_path / "a.bag", "mono16", pixels, big=big))
    assert len(found) == 2 and all((one == 5 * GREY * 2**6).all() and one.dtype == np.uint16 for one in found)


@pytest.mark.parametrize(
    ("encoding", "pixels", "size", "words"),
    [
        ("yuv422", np.zeros((48, 128), np.uint8), (64, 48), "encoded as 'yuv422', expected one of mono8, 8UC1"),
        ("mono8", np.zeros((48, 192), np.uint8), (64, 48), "mono8 of 64 x 48 pixels in 9,216 bytes with rows of 192"),
        ("mono8", np.zeros((30, 64), np.uint8), (64, 48), "in 1,920 bytes with rows of 64, expected 3,072"),
        ("rgb8", np.zeros((48, 64), np.uint8), (64, 48), "expected 9,216 with rows of 192"),
        ("mono8", np.zeros((20, 30), np.uint8), (30, 20), "30 x 20 pixels, expected the event sensor's 64 x 48"),
    ],
)
def test_skipped_frames_of_a_bag_are_counted(
    tmp_path: Path, encoding: str, pixels: np.ndarray, size: tuple[int, int], words: str
):
    found, said = frames_and_sentences(tmp_path, image_bag(tmp_path / "a.bag", encoding, pixels, size))
    assert not found and "left out: 2 frames of /dvs/image_raw: " in said and words in said


@pytest.mark.parametrize(("spoilt", "count"), [(False, 2), (True, 0)])
def test_compressed_frames_of_a_bag_are_read(tmp_path: Path, spoilt: bool, count: int):
    store = types(1)
    image, header, time = (store.types[f"{of}/msg/{name}"] for of, name in COMPRESSED)
    data = cv2.imencode(".png", GREY.astype(np.uint8))[1]
    with Writer1(tmp_path / "a.bag") as bag:
        events = bag.add_connection("/dvs/events", "dvs_msgs/msg/EventArray", typestore=store)
        for k, message in enumerate(messages(store, EVENTS, (64, 48))):
            bag.write(events, 10**9 + k, store.serialize_ros1(message, "dvs_msgs/msg/EventArray"))
        kind = "sensor_msgs/msg/CompressedImage"
        topic = bag.add_connection("/dvs/image_raw/compressed", kind, typestore=store)
        for second in (0, 1):
            message = image(header(0, time(second, 500_000_000), ""), "mono8; png", data[: 9 if spoilt else None])
            bag.write(topic, 10**9 + second, store.serialize_ros1(message, kind))
    found, said = frames_and_sentences(tmp_path, tmp_path / "a.bag")
    assert len(found) == count and all((one == GREY).all() for one in found)
    assert ("left out: 2 frames of /dvs/image_raw/compressed: compressed as 'mono8; png', which" in said) == spoilt


def ecd(folder: Path) -> Path:
    folder.mkdir()
    (folder / "events.txt").write_text("".join(f"{t / 1e6:.6f} {x} {y} {p}\n" for t, x, y, p in EVENTS))
    (folder / "calib.txt").write_text("60 60 32 24 0 0 0 0 0")
    (folder / "groundtruth.txt").write_text(poses("s"))
    for k, size in enumerate([(48, 64), (48, 64), (180, 240)]):
        (folder / "images").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / "images" / f"{k}.png"), np.full(size, 50 + k, np.uint8))
    (folder / "images.txt").write_text("".join(f"0.{k + 1} images/{k}.png\n" for k in range(3)))
    return folder


def test_a_calibration_without_a_sensor_size_is_completed_by_the_dataset(tmp_path: Path):
    source = ecd(tmp_path / "source")
    process("ecd", source, tmp_path / "scene", ProcessSettings(camera=source / "calib.txt"))
    camera = read_scene(tmp_path / "scene").camera
    assert (camera.width, camera.height, camera.fx) == (240, 180, 60)


def test_frames_of_another_size_are_left_out_and_counted(tmp_path: Path):
    settings = ProcessSettings(sensor_size=(64, 48))
    said = " ".join(process("ecd", ecd(tmp_path / "source"), tmp_path / "scene", settings))
    assert "left out: 1 frame of 240 x 180 pixels, expected their camera's 64 x 48" in said
    assert "3 of 3 frames within their span, 2 imported" in said
    assert len(read_scene(tmp_path / "scene").frames) == 2 and inspect_scene(tmp_path / "scene").events == 2000


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("images/0.png", b"no picture", "0.png: cannot be read as an image, expected one, or --no-frames"),
        ("images.txt", b"inf images/0.png\n", "images.txt:1: .*existing file, or --no-frames"),
        ("images.txt", b"0.1 images/gone.png\n", "images.txt:1: .*existing file, or --no-frames"),
        ("images.txt", b"\xff\xfe0.1", "images.txt: byte 0 is not UTF-8 text"),
    ],
)
def test_unreadable_frames_leave_no_scene_and_do_not_matter_without_frames(
    tmp_path: Path, name: str, content: bytes, words: str
):
    source = ecd(tmp_path / "source")
    (source / name).write_bytes(content)
    with pytest.raises(SceneError, match=words):
        process("ecd", source, tmp_path / "scene", ProcessSettings(sensor_size=(64, 48)))
    assert [path.name for path in tmp_path.iterdir()] == ["source"]
    process("ecd", source, tmp_path / "scene", ProcessSettings(sensor_size=(64, 48), frames=False))
    assert not read_scene(tmp_path / "scene").frames


def stereo_bag(path: Path) -> Path:
    """Two event cameras, each with colour and grey images."""
    store = types(1)
    image, header, time = (store.types[f"{of}/msg/{name}"] for of, name in STEREO)
    with Writer1(path) as bag:
        for side, grey in (("left", 10), ("right", 200)):
            events = bag.add_connection(f"/davis/{side}/events", "dvs_msgs/msg/EventArray", typestore=store)
            for k, message in enumerate(messages(store, EVENTS, (64, 48))):
                bag.write(events, 10**9 + k, store.serialize_ros1(message, "dvs_msgs/msg/EventArray"))
            for name, encoding, channels in (("image_color", "bgr8", 3), ("image_raw", "mono8", 1)):
                topic = bag.add_connection(f"/davis/{side}/{name}", "sensor_msgs/msg/Image", typestore=store)
                for second in (0, 1):
                    pixels = np.full(64 * 48 * channels, grey, np.uint8)
                    head = header(0, time(second, 500_000_000), side)
                    message = image(head, 48, 64, encoding, 0, 64 * channels, pixels)
                    content = store.serialize_ros1(message, "sensor_msgs/msg/Image")
                    bag.write(topic, 10**9 + second, content)
    return path


def test_an_equidistant_lens_without_coefficients_is_not_a_pinhole(tmp_path: Path):
    text = CALIBRATIONS["kalibr.yaml"][0].replace("[0.1, 0.0, 0.0, 0.0]", "[0.0, 0.0, 0.0, 0.0]")
    (tmp_path / "kalibr.yaml").write_text(text)
    camera = read_calibration(tmp_path / "kalibr.yaml").camera
    assert camera.model == "equidistant" and camera.distortion == (0, 0, 0, 0)


CALIBRATIONS = {
    "kalibr.yaml": (
        "cam0:\n  camera_model: pinhole\n  intrinsics: [60.0, 61.0, 32.0, 24.0]\n  distortion_model: equidistant\n"
        "  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]\n  resolution: [64, 48]\n",
        "equidistant",
    ),
    "dsec.yaml": (
        "intrinsics:\n  cam0:\n    camera_matrix: [60.0, 61.0, 32.0, 24.0]\n    resolution: [64, 48]\n"
        "    distortion_model: radtan\n    distortion_coeffs: [-0.1, 0.1, 0.0, 0.0]\n",
        "radtan",
    ),
    "ros.yaml": (
        "image_width: 64\nimage_height: 48\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        "  data: [60.0, 0, 32.0, 0, 61.0, 24.0, 0, 0, 1]\ndistortion_model: plumb_bob\n"
        "distortion_coefficients:\n  data: [-0.1, 0.1, 0.0, 0.0, 0.0]\n",
        "radtan",
    ),
}


@pytest.mark.parametrize("name", list(CALIBRATIONS))
def test_foreign_calibrations(tmp_path: Path, name: str):
    text, model = CALIBRATIONS[name]
    (tmp_path / name).write_text(text)
    camera = read_calibration(tmp_path / name).camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (64, 48, 60, 61, 32, 24)
    assert camera.model == model


def test_calibrations_within_a_recording_of_m3ed(tmp_path: Path):
    with h5py.File(tmp_path / "data.h5", "w") as file:
        for name, shift in (("prophesee/left", 0.0), ("ovc/left", 0.1)):
            calibration = file.create_group(f"{name}/calib")
            calibration["intrinsics"], calibration["resolution"] = [60.0, 61.0, 32.0, 24.0], [64, 48]
            calibration["distortion_model"], calibration["distortion_coeffs"] = "radtan", [-0.1, 0.1, 0.0, 0.0]
            pose = np.eye(4)
            pose[0, 3] = shift
            calibration["T_to_prophesee_left"] = pose
        file.create_group("ouster/calib")["T_to_prophesee_left"] = np.eye(4)
    found = read_cameras(tmp_path / "data.h5")
    assert set(found) == {"prophesee/left", "ovc/left"} and found["ovc/left"].camera.model == "radtan"
    pose = found["ovc/left"].rig_from_camera
    assert pose is not None and pose[0, 3] == 0.1
    with pytest.raises(SceneError, match="expected --camera-name with one of ovc/left, prophesee/left"):
        read_calibration(tmp_path / "data.h5")
    (tmp_path / "none.h5").write_bytes(b"nothing")
    with pytest.raises(SceneError, match="cannot be read"):
        read_calibration(tmp_path / "none.h5")


def test_where_kalibrs_cameras_are(tmp_path: Path):
    found = read_cameras(REPOSITORY / "configs" / "cameras" / "eds.yaml")
    first, second = found["cam0"].rig_from_camera, found["cam1"].rig_from_camera
    assert first is not None and second is not None and np.array_equal(first, np.eye(4))
    assert np.linalg.inv(second)[0, 2] == pytest.approx(-0.014246672)
    alone = "cam0:\n  intrinsics: [60.0, 61.0, 32.0, 24.0]\n  resolution: [64, 48]\n"
    (tmp_path / "alone.yaml").write_text(alone)
    assert read_calibration(tmp_path / "alone.yaml").rig_from_camera is None
    on_imu = alone + "  T_cam_imu: [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    (tmp_path / "imu.yaml").write_text(on_imu)
    pose = read_calibration(tmp_path / "imu.yaml").rig_from_camera
    assert pose is not None and pose[0, 3] == -0.1


@pytest.mark.parametrize("side", ["A", "B"])
def test_real_calibrations_of_tum_vie(side: str):
    path = DATA / "calibration" / "tumvie" / f"camera-calibration{side}.json"
    if not path.is_file():
        pytest.skip(f"no calibrations at {DATA}; set EBARF_TEST_DATA to their folder")
    found = read_calibration(path, "2")
    assert (found.camera.width, found.camera.height) == (1280, 720) and 1000 < found.camera.fx < 1100
    assert found.rig_from_camera is not None and np.isclose(np.linalg.det(found.rig_from_camera), 1)


def saved(tmp_path: Path, factor: float, dtype: type = int) -> tuple[Path, ProcessSettings]:
    """2 s of events with times in another unit, and poses."""
    (tmp_path / "t.txt").write_text(poses("s"))
    np.savez(tmp_path / "a.npz", **columns() | {"t": (columns()["t"] * factor).astype(dtype)})  # pyright: ignore[reportArgumentType]
    return tmp_path / "a.npz", ProcessSettings(trajectory=tmp_path / "t.txt", camera=calibration(tmp_path))


@pytest.mark.parametrize(
    ("factor", "dtype", "said", "unit"),
    [(1e-3, int, "us", "ms"), (1e3, int, "us", "ns"), (1e-3, float, "us", "ms"), (1.0, float, "us", "us")],
)
def test_a_guessed_unit_is_checked_against_the_trajectory(
    tmp_path: Path, factor: float, dtype: type, said: str, unit: str
):
    path, settings = saved(tmp_path, factor, dtype)
    if said != unit:
        expected = rf"if their times are in {said}, beside .* expected --event-time-unit with {unit} \("
        with pytest.raises(RecordingError, match=expected):
            process("auto", path, tmp_path / "scene", settings)
        assert not (tmp_path / "scene").exists()
        settings = replace(settings, event_time_unit=unit)  # pyright: ignore[reportArgumentType]
    sentences = process("auto", path, tmp_path / "scene", settings)
    assert f"npz, times in {unit}: 2,000 events read, 2,000 kept, over 1.999 s" in sentences
    assert not any("suspicious" in sentence for sentence in sentences)


def test_a_stated_unit_is_used_and_doubted_by_inspection(tmp_path: Path):
    path, settings = saved(tmp_path, 1e-3)
    process("auto", path, tmp_path / "scene", replace(settings, event_time_unit="us"))
    (doubt,) = [one for one in inspect_scene(tmp_path / "scene").suspicions if "--event-time-unit" in one]
    assert doubt.startswith("all events, 2 ms of them, lie between keyframes")


def test_numbers_of_frames_are_suspicious_before_there_is_a_scene(tmp_path: Path):
    path, _ = saved(tmp_path, 1e-4)
    (doubt,) = [one for one in inspect_recording(lambda: open_recording(path)).suspicions if "--event-time-unit" in one]
    assert doubt.startswith("200 distinct times for 2,000 events, over 0.199 ms if they are in us")


def test_a_folder_of_npz_files_is_a_recording(tmp_path: Path):
    folder = tmp_path / "pairs"
    folder.mkdir()
    for k in range(4):
        some = {name: column[500 * k : 500 * k + 500] for name, column in columns().items()}
        np.savez(folder / f"{k:06d}.npz", **some)  # pyright: ignore[reportArgumentType]
    (tmp_path / "t.txt").write_text(poses("s"))
    settings = ProcessSettings(trajectory=tmp_path / "t.txt", camera=calibration(tmp_path))
    said = process("auto", folder, tmp_path / "scene", settings)
    assert said[0] == "4 npz files, times in us: 2,000 events read, 2,000 kept, over 1.999 s"


def test_flags_of_columns_and_flips(tmp_path: Path):
    rows = np.stack([columns()[name] for name in "yxpt"], 1)
    np.savetxt(tmp_path / "a.txt", rows, "%d")
    (tmp_path / "t.txt").write_text(poses("s"))
    out = run_command(
        "ebarf", "process", "auto", tmp_path / "a.txt", "--output", tmp_path / "scene", "--camera",
        calibration(tmp_path), "--trajectory", tmp_path / "t.txt", "--event-columns", "y x p t", "--flip-x",
        "--flip-polarity",
    )  # fmt: skip
    assert out.code == 0 and "columns y x p t, as stated" in out.errors, out.errors
    assert "flipped, as asked: polarity, x" in out.errors
    recording, expected = read_recording(tmp_path / "scene" / "events.h5", 64, 48), writers.recording(EVENTS)
    assert np.array_equal(recording.x, 63 - expected.x) and np.array_equal(recording.polarity, -expected.polarity)
    assert np.array_equal(recording.y, expected.y)


def test_a_raw_recording_is_inspected(tmp_path: Path):
    path = writers.raw(tmp_path / "a.raw", "2.0", writers.evt2(EVENTS), size=None)
    summary = json.loads(run_ok("ebarf", "inspect", path, "--picture", tmp_path / "sheet.png", "--json"))
    assert summary["events"] == 2000 and (summary["width"], summary["height"]) == (64, 48)
    assert (summary["start_us"], summary["end_us"]) == (0, 1_999_000) and sum(summary["rate"]) == 2000
    sheet = cv2.imread(str(tmp_path / "sheet.png"), cv2.IMREAD_GRAYSCALE)
    assert sheet is not None and len(np.unique(sheet)) > 2


def test_swapped_columns_of_a_real_file_are_caught(tmp_path: Path):
    swapped = DATA / "readers" / "swapped_xy.hdf5"
    if not swapped.is_file():
        pytest.skip(f"no recordings at {DATA}; set EBARF_TEST_DATA to their folder")
    (tmp_path / "t.txt").write_text(poses("s"))
    (tmp_path / "calib.txt").write_text("200 200 172 129 0 0 0 0 0")
    settings = ProcessSettings(
        trajectory=tmp_path / "t.txt", camera=tmp_path / "calib.txt", sensor_size=(346, 128),
        trajectory_format=TrajectoryFormat("s"),
    )  # fmt: skip
    with pytest.raises(RecordingError, match="the sensor height"):
        process("hdf5", swapped, tmp_path / "scene", settings)


def test_a_crop_is_of_events_camera_and_its_frames(tmp_path: Path):
    settings = ProcessSettings(sensor_size=(64, 48), events=Intake(crop=(8, 4, 56, 40)))
    process("ecd", ecd(tmp_path / "source"), tmp_path / "scene", settings)
    scene = read_scene(tmp_path / "scene")
    assert (scene.camera.width, scene.camera.height, scene.camera.cx, scene.camera.cy) == (48, 36, 24.0, 20.0)
    read_recording(scene.events, 48, 36)
    assert len(scene.frames) == 2
    for frame in scene.frames:
        assert frame.camera == scene.camera and cv2.imread(str(frame.path)).shape[:2] == (36, 48)


def test_a_crop_beyond_the_sensor_is_an_error(tmp_path: Path):
    settings = ProcessSettings(sensor_size=(64, 48), events=Intake(crop=(8, 4, 65, 40)))
    with pytest.raises(SceneError, match="--crop is 8 4 65 40, expected X0 Y0 X1 Y1 with 0 <= X0 < X1 <= 64"):
        process("ecd", ecd(tmp_path / "source"), tmp_path / "scene", settings)
    assert not (tmp_path / "scene").exists()
