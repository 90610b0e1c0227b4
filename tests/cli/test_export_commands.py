"""The commands that export a run, as users type them, on a short training; and how good a longer one's surfaces are."""

import json
import shutil
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from ebarf_ns.events.recording import read_recording
from ebarf_ns.geometry.trajectory import interpolate
from ebarf_ns.geometry.trajectory_file import read_tum
from tests.conftest import run_command, run_ok
from tests.export.subjects import ROOM, distance_to_room, read_ply

needs_ffmpeg = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="videos need ffmpeg")


def test_mesh_and_points_where_nothing_else_is_said(trained_run: Path):
    # After 80 steps, surfaces are haze.
    run_ok("ebarf", "mesh", trained_run, "--blur=1")
    run_ok("ebarf", "points", trained_run, "--blur=1")
    mesh = read_ply(trained_run / "exports" / "mesh.ply")
    cloud = read_ply(trained_run / "exports" / "points.ply")
    assert len(mesh.faces) > 500 and len(cloud.vertices) > 500
    # In the room, not in training coordinates, of which one is 2.2 m.
    assert np.ptp(np.asarray(cloud.vertices), axis=0).max() > 2.2


@needs_ffmpeg
def test_a_video_in_slow_motion(trained_run: Path, tmp_path: Path):
    run_ok("ebarf", "render", trained_run, "--output", tmp_path / "v.mp4", "--slow=4", "--end-us=100000", "--fps=20")
    capture = cv2.VideoCapture(str(tmp_path / "v.mp4"))
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == 9 and capture.get(cv2.CAP_PROP_FRAME_HEIGHT) == 36
    assert len((tmp_path / "v_timestamps.txt").read_text().split()) == 9


def test_predicted_events_are_a_recording(trained_run: Path, tiny_scene: Path, tmp_path: Path):
    finished = run_command("ebarf", "render", trained_run, "--events", tmp_path / "p.h5", "--end-us=100000")
    assert finished.code == 0, finished.errors
    assert "counts per pixel correlate by" in finished.errors
    predicted = read_recording(tmp_path / "p.h5", 48, 36)
    assert len(predicted) > 100 and predicted.t_us[-1] <= 100_000
    with h5py.File(tmp_path / "p.h5") as file:
        assert set(file["events"]) == {"x", "y", "t", "p"} and "ms_to_idx" in file  # pyright: ignore[reportArgumentType]
    finished = run_command("ebarf", "render", trained_run, "--events", tiny_scene / "events.h5")
    assert finished.code == 2 and "is the recording itself" in finished.errors


def test_the_exported_trajectory_is_the_refined_one(trained_run: Path, tmp_path: Path):
    run_ok("ebarf", "trajectory", "export", trained_run, "--format=tum", "--output", tmp_path / "t.txt")
    ours, refined = read_tum(tmp_path / "t.txt"), read_tum(trained_run / "trajectory_refined.txt")
    assert (ours.t_us == refined.t_us).all()
    assert float((ours.poses.position - refined.poses.position).abs().max()) < 1e-6


def test_a_data_set_for_nerfstudio_once(trained_run: Path, tmp_path: Path):
    words = ["ebarf", "trajectory", "export", trained_run, "--format=transforms", "--rate-hz=10", "--output"]
    finished = run_command(*words, tmp_path / "out")
    # After so short a training there may be no surface for the cloud: that is said.
    if finished.code:
        assert "sharp enough" in finished.errors and not (tmp_path / "out").exists()
        return
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    assert len(frames) == 6 and (tmp_path / "out" / frames[0]["file_path"]).is_file()
    finished = run_command(*words, tmp_path / "out")
    assert finished.code == 2 and "expected a new folder" in finished.errors


def test_a_run_that_was_moved_without_its_scene(trained_run: Path, tmp_path: Path):
    run = shutil.copytree(trained_run, tmp_path / "run")
    config = run / "config.yml"
    config.write_text(config.read_text().replace("- tiny\n", "- gone\n"))
    run_ok("ebarf", "trajectory", "export", run, "--format=kitti")
    assert len((run / "exports" / "trajectory_kitti.txt").read_text().splitlines()) == 11


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["mesh", "{tmp}"], "expected the folder of a training run"),
        (["mesh", "{run}", "--output", "{tmp}/mesh.obj"], "expected the name of a .ply file"),
        (["render", "{run}", "--output", "{tmp}/video"], "expected the name of an .mp4 file"),
        (["render", "{run}", "--format", "png", "--start-us", "999999999", "--output", "{tmp}/x"], "the span of the"),
    ],
)
def test_mistakes_are_one_line_and_nothing_is_written(trained_run: Path, tmp_path: Path, words: list[str], said: str):
    finished = run_command("ebarf", *(word.format(tmp=tmp_path, run=trained_run) for word in words))
    assert finished.code == 2 and said in finished.errors and finished.errors.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def demo_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo scene after 1,500 steps."""
    folder = tmp_path_factory.mktemp("demo")
    run_ok("ebarf", "simulate", folder / "scene", cwd=folder, timeout_s=1800)
    run_ok(
        "ns-train", "ebarf", "--data", folder / "scene", "--output-dir", folder, "--experiment-name=demo",
        "--timestamp=run", "--max-num-iterations=1500", "--vis=tensorboard", timeout_s=3600,
    )  # fmt: skip
    return folder / "demo" / "ebarf" / "run"


@pytest.mark.slow
@pytest.mark.parametrize(("blur", "median_m", "covered"), [(0.08, 0.03, 0.55), (0.045, 0.02, 0.2)])
def test_surfaces_of_the_demo_scene_are_true(demo_run: Path, tmp_path: Path, blur: float, median_m: float, covered):
    """In the 4 m room; at 2.5 m, a pixel is 2.3 cm, and the camera moved by 0.4 m."""
    truth = read_tum(demo_run.parents[2] / "scene" / "groundtruth.txt")
    refined = read_tum(demo_run / "trajectory_refined.txt")
    true, ours = interpolate(truth.t_us, truth.poses, refined.t_us).matrix().numpy(), refined.poses.matrix().numpy()
    rotation = Rotation.from_matrix(true[:, :, :3] @ ours[:, :, :3].transpose(0, 2, 1)).mean()
    turned = rotation.apply(ours[:, :, 3])
    turned, wanted = turned - turned.mean(axis=0), true[:, :, 3] - true[:, :, 3].mean(axis=0)
    scale = (turned * wanted).sum() / (turned**2).sum()
    shift = true[:, :, 3].mean(axis=0) - scale * rotation.apply(ours[:, :, 3]).mean(axis=0)
    seen = []
    for matrix in true:
        grid = np.stack(np.meshgrid(np.linspace(-0.57, 0.57, 24), np.linspace(-0.43, 0.43, 18)), axis=-1).reshape(-1, 2)
        direction = np.insert(grid, 2, 1.0, axis=1) @ matrix[:, :3].T
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        origin = np.ascontiguousarray(np.broadcast_to(matrix[:, 3], direction.shape))
        seen.append(origin + ROOM.cast(origin, direction)[1][:, None] * direction)
    for name in ("mesh", "points"):
        run_ok("ebarf", name, demo_run, "--output", tmp_path / f"{name}.ply", f"--blur={blur}")
        made = read_ply(tmp_path / f"{name}.ply")
        vertex = scale * rotation.apply(np.asarray(made.vertices)) + shift
        distance = distance_to_room(vertex)
        reached, _ = KDTree(vertex).query(np.concatenate(seen))
        print(f"{name}: {len(vertex)} at {np.median(distance):.4f} m, {np.mean(reached < 0.05):.2f} within 5 cm")
        assert np.median(distance) < median_m and np.mean(reached < 0.05) > covered
        # No walls along the cones of sight.
        assert np.percentile(distance, 99) < 0.3


@pytest.mark.slow
def test_predicted_events_are_those_recorded(demo_run: Path, tmp_path: Path):
    finished = run_command("ebarf", "render", demo_run, "--events", tmp_path / "p.h5", "--end-us=500000")
    assert finished.code == 0, finished.errors
    real = read_recording(demo_run.parents[2] / "scene" / "events.h5", 128, 96).between(0, 500_000)
    predicted = read_recording(tmp_path / "p.h5", 128, 96)
    assert len(predicted) == pytest.approx(len(real), rel=0.2)
    counts = [np.bincount(one.pixels(128), minlength=128 * 96) for one in (predicted, real)]
    assert np.corrcoef(counts)[0, 1] > 0.9
