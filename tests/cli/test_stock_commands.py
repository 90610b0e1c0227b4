"""Every stock nerfstudio command, unpatched, on a trained tiny scene; what comes out is opened and judged."""

import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pytest
import torch

from ebarf_ns.evaluation.trajectory_error import trajectory_error
from ebarf_ns.geometry.trajectory_file import read_tum
from tests.conftest import TINY_TRAINING, free_port, run_command, run_ok, wait_for_page

needs_ffmpeg = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ns-render needs ffmpeg")


def config(run: Path) -> list[object]:
    return ["--load-config", run / "config.yml"]


def assert_shows_something(path: Path) -> None:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None, path
    grey = image[..., :3].mean(axis=-1)
    assert grey.std() > 5, f"{path} is nearly constant: {grey.mean():.1f} +- {grey.std():.1f}"


def frames_of(video: Path) -> list[np.ndarray]:
    capture, frames = cv2.VideoCapture(str(video)), []
    while True:
        there, frame = capture.read()
        if not there:
            return frames
        frames.append(frame)


def camera_path(folder: Path) -> Path:
    """Two views from where the camera was, as the viewer writes them."""
    view = np.array([[0.0, 0, -1, -0.5], [-1, 0, 0, 0], [0, 1, 0, 0.1], [0, 0, 0, 1]])
    shifted = view.copy()
    shifted[1, 3] += 0.1
    path = {
        "camera_type": "perspective", "render_height": 36, "render_width": 48, "fps": 4, "seconds": 0.5,
        "camera_path": [
            {"camera_to_world": pose.ravel().tolist(), "fov": 50, "aspect": 48 / 36} for pose in (view, shifted)
        ],
    }  # fmt: skip
    (folder / "path.json").write_text(json.dumps(path))
    return folder / "path.json"


def test_train_refines_the_poses(trained_run: Path, tiny_scene: Path):
    truth = read_tum(tiny_scene / "groundtruth.txt")
    before, after = (
        trajectory_error(read_tum(trained_run / f"trajectory_{which}.txt"), truth, "sim3")
        for which in ("initial", "refined")
    )
    assert after.ate_m < before.ate_m and after.rotation_deg < before.rotation_deg
    for picture in (trained_run / "renders").glob("*.png"):
        assert_shows_something(picture)
    assert any(trained_run.glob("events.out.tfevents.*"))


def test_train_with_the_viewer(tiny_scene: Path, tmp_path: Path):
    run_ok(
        "ns-train", "ebarf", "--data", tiny_scene, "--output-dir", tmp_path, "--timestamp=run",
        "--vis=viewer+tensorboard", "--viewer.websocket-port", free_port(),
        "--viewer.quit-on-train-completion=True", *TINY_TRAINING, "--max-num-iterations=20",
        "--steps-per-eval-image=10", "--steps-per-eval-batch=10", "--steps-per-eval-all-images=10",
    )  # fmt: skip
    assert (tmp_path / tiny_scene.name / "ebarf" / "run" / "metrics.jsonl").is_file()


def test_train_resumes(trained_run: Path, tiny_scene: Path, tmp_path: Path):
    run_ok(
        "ns-train", "ebarf", "--data", tiny_scene, "--output-dir", tmp_path, "--timestamp=more", "--vis=tensorboard",
        "--load-dir", trained_run / "nerfstudio_models", *TINY_TRAINING, "--max-num-iterations=100",
    )  # fmt: skip
    lines = (tmp_path / tiny_scene.name / "ebarf" / "more" / "metrics.jsonl").read_text().splitlines()
    assert json.loads(lines[-1])["step"] == 100


def test_eval(trained_run: Path, tmp_path: Path):
    run_ok("ns-eval", *config(trained_run), "--output-path", tmp_path / "eval.json", "--render-output-path", tmp_path)
    results = json.loads((tmp_path / "eval.json").read_text())["results"]
    recorded = json.loads((trained_run / "metrics.jsonl").read_text().splitlines()[-1])
    for name in ("psnr", "ssim", "heldout_event_loss", "ate_m", "rotation_deg"):
        assert results[name] == pytest.approx(recorded[name], rel=1e-3)
    assert results["alignment"] == "sim3"
    assert results["event_pairs"] == recorded["event_pairs"] and results["train_seconds"] > 0
    assert len(list(tmp_path.glob("*.png"))) == 3


@needs_ffmpeg
@pytest.mark.parametrize("kind", ["camera-path", "interpolate", "spiral"])
def test_render_video(trained_run: Path, tmp_path: Path, kind: str):
    options = {
        "camera-path": ["--camera-path-filename", camera_path(tmp_path)],
        "interpolate": ["--interpolation-steps=2"],
        "spiral": ["--seconds=0.3", "--frame-rate=10", "--radius=0.05"],
    }[kind]
    video = tmp_path / "out.mp4"
    run_ok("ns-render", kind, *config(trained_run), "--output-path", video, *options)
    frames = frames_of(video)
    assert len(frames) >= 2 and all(frame.std() > 5 for frame in frames)


@needs_ffmpeg
@pytest.mark.parametrize("split", ["test", "train"])
def test_render_dataset(trained_run: Path, tmp_path: Path, split: str):
    run_ok(
        "ns-render", "dataset", *config(trained_run), "--output-path", tmp_path, "--split", split,
        "--rendered-output-names", "rgb", "depth", "gt-rgb",
    )  # fmt: skip
    pictures = sorted((tmp_path / split / "rgb").iterdir())
    assert len(pictures) == (3 if split == "test" else 11)
    for picture in pictures:
        assert_shows_something(picture)


def test_export_pointcloud(trained_run: Path, tmp_path: Path):
    run_ok(
        "ns-export", "pointcloud", *config(trained_run), "--output-dir", tmp_path, "--num-points=3000",
        "--num-rays-per-batch=2048", "--save-world-frame=True",
    )  # fmt: skip
    cloud = o3d.io.read_point_cloud(tmp_path / "point_cloud.ply")
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    assert len(points) > 2000 and np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-3)
    assert normals.std(axis=0).min() > 0.1
    # In the world frame, the cloud lies within the scene's bounds and is not all in one place.
    assert (points > -2.3).all() and (points < 2.3).all() and points.std(axis=0).min() > 0.05


def test_export_tsdf(trained_run: Path, tmp_path: Path):
    run_ok(
        "ns-export", "tsdf", *config(trained_run), "--output-dir", tmp_path, "--resolution=32",
        "--target-num-faces=500", "--unwrap-method=custom", "--num-pixels-per-side=256",
    )  # fmt: skip
    mesh = o3d.io.read_triangle_mesh(tmp_path / "tsdf_mesh.ply")
    assert len(mesh.vertices) > 50 and len(mesh.triangles) > 50


def test_export_poisson(trained_run: Path, tmp_path: Path):
    run_ok(
        "ns-export", "poisson", *config(trained_run), "--output-dir", tmp_path, "--num-points=3000",
        "--num-rays-per-batch=2048", "--normal-method=open3d", "--texture-method=point_cloud",
        "--target-num-faces=1000",
    )  # fmt: skip
    mesh = o3d.io.read_triangle_mesh(tmp_path / "poisson_mesh.ply")
    assert len(mesh.vertices) > 50


def test_export_cameras_are_the_refined_keyframes(trained_run: Path, tmp_path: Path):
    run_ok("ns-export", "cameras", *config(trained_run), "--output-dir", tmp_path)
    exported = json.loads((tmp_path / "transforms_train.json").read_text())
    normalization = json.loads((trained_run / "dataparser_transforms.json").read_text())
    position = torch.tensor([frame["transform"] for frame in exported])[:, :3, 3].double()
    world = position / normalization["scale"] - torch.tensor(normalization["transform"])[:, 3]
    refined = read_tum(trained_run / "trajectory_refined.txt").poses.position
    initial = read_tum(trained_run / "trajectory_initial.txt").poses.position
    assert torch.allclose(world, refined, atol=1e-4) and not torch.allclose(world, initial, atol=1e-3)


def test_export_marching_cubes_says_what_it_is_for(trained_run: Path, tmp_path: Path):
    finished = run_command("ns-export", "marching-cubes", *config(trained_run), "--output-dir", tmp_path)
    assert finished.code == 2 and "Traceback" not in finished.errors + finished.output
    assert "error: ns-export marching-cubes is for signed distance fields" in finished.errors


@needs_ffmpeg
@pytest.mark.slow
def test_every_command_shows_the_same_moment_from_the_same_place(trained_run: Path, tmp_path: Path):
    run, images = config(trained_run), ["--image-format=png"]
    run_ok(
        "ns-render", "dataset", *run, "--output-path", tmp_path / "dataset", "--split=test", *images,
        "--rendered-output-names", "rgb",
    )  # fmt: skip
    run_ok(
        "ns-render", "interpolate", *run, "--output-path", tmp_path / "interpolate", "--interpolation-steps=2",
        "--output-format=images", *images,
    )  # fmt: skip
    # So small that it is the view that it begins with.
    run_ok(
        "ns-render", "spiral", *run, "--output-path", tmp_path / "spiral", "--output-format=images", *images,
        "--seconds=0.2", "--frame-rate=10", "--radius=1e-6",
    )  # fmt: skip
    run_ok("ns-export", "cameras", *run, "--output-dir", tmp_path)
    (pose,) = [json.loads((tmp_path / "transforms_eval.json").read_text())[0]["transform"]]
    (tmp_path / "path.json").write_text(json.dumps(path_of_one_view(trained_run, pose)))
    run_ok(
        "ns-render", "camera-path", *run, "--camera-path-filename", tmp_path / "path.json", "--output-path",
        tmp_path / "path", "--output-format=images", *images,
    )  # fmt: skip
    first = {kind: sorted((tmp_path / kind).rglob("*.png"))[0] for kind in ("dataset", "interpolate", "spiral", "path")}
    shown = {kind: cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(int) for kind, path in first.items()}
    assert shown["dataset"].std() > 20
    for kind in ("interpolate", "spiral", "path"):
        assert np.abs(shown[kind] - shown["dataset"]).max() <= 3, kind


def path_of_one_view(run: Path, pose: list[list[float]]) -> dict:
    """The event camera at a pose of ``ns-export cameras``, as a path that the viewer could have written."""
    camera = json.loads((run / "scene" / "scene.json").read_text())["camera"]
    fov = float(np.rad2deg(2 * np.arctan(camera["height"] / 2 / camera["fy"])))
    view = {"camera_to_world": [*sum(pose, []), 0, 0, 0, 1], "fov": fov, "aspect": camera["width"] / camera["height"]}
    size = {"render_height": camera["height"], "render_width": camera["width"]}
    return {"camera_type": "perspective", **size, "fps": 4, "seconds": 0.25, "camera_path": [view, view]}


@pytest.fixture
def without_recording(trained_run: Path, tiny_scene: Path, tmp_path: Path) -> Iterator[Path]:
    """The trained run, as long as its recording is away."""
    shutil.move(tiny_scene / "events.h5", tmp_path / "events.h5")
    yield trained_run
    shutil.move(tmp_path / "events.h5", tiny_scene / "events.h5")


def test_a_run_outlives_its_recording(without_recording: Path, tmp_path: Path):
    run = config(without_recording)
    run_ok("ns-eval", *run, "--output-path", tmp_path / "eval.json")
    results = json.loads((tmp_path / "eval.json").read_text())["results"]
    assert results["heldout_event_loss"] is None and results["psnr"] > 5
    run_ok("ns-export", "pointcloud", *run, "--output-dir", tmp_path / "cloud", "--num-points=3000")


@pytest.fixture
def without_scene(trained_run: Path, tiny_scene: Path, tmp_path: Path) -> Iterator[Path]:
    """The trained run, as long as its scene is elsewhere."""
    shutil.move(tiny_scene, tmp_path / "elsewhere")
    yield trained_run
    shutil.move(tmp_path / "elsewhere", tiny_scene)


@needs_ffmpeg
def test_a_run_is_opened_without_its_scene_and_says_where_it_looked(
    without_scene: Path, tiny_scene: Path, tmp_path: Path
):
    options = ["--camera-path-filename", camera_path(tmp_path), "--output-path", tmp_path / "out.mp4"]
    finished = run_command("ns-render", "camera-path", *config(without_scene), *options)
    assert finished.code == 0 and all(frame.std() > 5 for frame in frames_of(tmp_path / "out.mp4"))
    said = " ".join(finished.errors.split())
    assert f"{tiny_scene}: no such folder" in said
    (line,) = re.findall(
        rf"change line (\d+) of {without_scene / 'config.yml'} to '    data: NEW PLACE'", finished.errors
    )
    changed = (without_scene / "config.yml").read_text().splitlines()
    changed[int(line) - 1] = f"    data: {tmp_path / 'elsewhere'}"
    (tmp_path / "config.yml").write_text("\n".join(changed) + "\n")
    run_ok("ns-eval", "--load-config", tmp_path / "config.yml", "--output-path", tmp_path / "eval.json")
    assert json.loads((tmp_path / "eval.json").read_text())["results"]["psnr"] > 5


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--machine.device-type=mps"], "--machine.device-type is mps, expected one that is here: "),
        (["--machine.num-devices=99"], "--machine.num-devices is 99, expected 1 to "),
    ],
)
@pytest.mark.skipif(torch.backends.mps.is_available(), reason="has what must be missing")
def test_a_device_that_is_not_here_is_said_before_anything_is_written(
    tiny_scene: Path, tmp_path: Path, flags: list[str], words: str
):
    finished = run_command(
        "ns-train", "ebarf", "--data", tiny_scene, "--output-dir", tmp_path / "runs", "--vis=tensorboard", *flags
    )
    assert finished.code == 2 and finished.errors.strip().splitlines()[-1].startswith(f"error: {words}")
    assert "Traceback" not in finished.errors + finished.output and not list(tmp_path.iterdir())


def test_viewer_serves_its_page(trained_run: Path):
    port = free_port()
    script = Path(sys.executable).parent / "ns-viewer"
    process = subprocess.Popen(
        [script, "--load-config", trained_run / "config.yml", "--viewer.websocket-port", str(port)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=os.environ,
    )  # fmt: skip
    try:
        page = wait_for_page(f"http://127.0.0.1:{port}", process)
        assert "<title>" in page.lower()
        # Long enough for the scene to be built and a first picture to be rendered.
        time.sleep(3)
        assert process.poll() is None
    finally:
        process.kill()
        process.wait()
