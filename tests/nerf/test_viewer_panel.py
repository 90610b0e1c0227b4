"""The panel with the viewer's own server: what it draws, shows and does, and that it costs nothing unless looked at."""

import base64
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.nerf.trainer import EbarfTrainer
from ebarf_ns.nerf.viewer_pictures import curves
from ebarf_ns.nerf.viewer_scene import DrawnScene
from tests.conftest import free_port
from tests.nerf.test_training import config, trainer
from tests.nerf.viewer_client import ViewerClient

BLUE, ORANGE, GREEN = 0x1F77B4, 0xFF7F0E, 0x2CA02C


@pytest.fixture(scope="module")
def training(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[EbarfTrainer]:
    """A trainer with its viewer, built and a few steps old, that steps when told to."""
    made = config(tiny_scene, tmp_path_factory.mktemp("viewer"), steps=1000)
    made.vis, made.viewer.websocket_port, made.evaluations = "viewer", free_port(), 0
    ready = trainer(made)
    ready._init_viewer_state()
    for step in range(3):
        one_step(ready, step)
    yield ready
    assert ready.viewer_state is not None
    ready.viewer_state.viser_server.stop()  # pyright: ignore[reportAttributeAccessIssue]


def one_step(ready: EbarfTrainer, step: int) -> None:
    """As nerfstudio's loop does it."""
    with ready.train_lock:
        ready.pipeline.train()
        ready.train_iteration(step)
        for callback in ready.callbacks:
            callback.run_callback(step)


@pytest.fixture
def client(training: EbarfTrainer) -> Iterator[ViewerClient]:
    port = training.config.viewer.websocket_port
    assert port is not None
    with ViewerClient(port) as connected:
        yield connected


def test_nothing_is_read_or_drawn_before_somebody_looks(training: EbarfTrainer):
    panel: Any = training.pipeline.viewer_panel
    started = time.perf_counter()
    for step in range(1000):
        panel.after_step(step)
    assert (time.perf_counter() - started) / 1000 < 1e-4
    assert not panel._drawn.frustums


def test_of_a_thousand_keyframes_512_are_drawn_from_the_first_to_the_last():
    given = torch.arange(1000)
    pipeline: Any = SimpleNamespace(model=SimpleNamespace(camera_optimizer=SimpleNamespace(given=given)))
    server: Any = None
    for most, count in ((-1, 512), (2000, 512), (100, 100)):
        drawn = DrawnScene(pipeline, server, most, 0.1).keyframes
        assert len(drawn) == count and drawn[0] == 0 and drawn[-1] == 999 and int(drawn.diff().min()) >= 1


def test_the_first_view_stands_at_the_trajectorys_middle_and_has_the_cameras_field_of_view(client: ViewerClient):
    middle = training_pose(client)
    camera = client.wait_for("SetCameraFovMessage")
    # 36 pixels of 48x36, focal length 41.
    assert camera["fov"] == pytest.approx(2 * np.arctan(18 / 41), abs=1e-6)
    assert np.allclose(client.wait_for("SetCameraPositionMessage")["position"], middle, atol=0.02)


def training_pose(client: ViewerClient) -> np.ndarray:
    """The middle of the refined line as it is drawn."""
    line = np.array(client.wait_for("CatmullRomSplineMessage", lambda one: one["name"] == "/refined/line")["positions"])
    return (line[(len(line) - 1) // 2] + line[len(line) // 2]) / 2


def test_three_trajectories_are_drawn_each_in_its_colour(client: ViewerClient, tiny_scene: Path):
    client.wait_for("CatmullRomSplineMessage", lambda one: one["color"] == GREEN)
    initial = client.wait_for("CatmullRomSplineMessage", lambda one: one["color"] == BLUE)
    refined = client.wait_for("CatmullRomSplineMessage", lambda one: one["color"] == ORANGE)
    assert (initial["name"], refined["name"]) == ("/initial/line", "/refined/line")
    given = read_tum(tiny_scene / "trajectory.txt").poses.position.numpy()
    # The same line, but for training's place and scale.
    drawn = np.array(initial["positions"])
    scale = np.linalg.norm(drawn[-1] - drawn[0]) / np.linalg.norm(given[-1] - given[0])
    assert np.allclose((drawn - drawn[0]) / scale, given - given[0], atol=1e-4)
    # No corner is rounded: as many segments as there are between the points.
    assert initial["segments"] == len(drawn) - 1
    dashes = {one["name"] for one in client.all("CatmullRomSplineMessage", lambda one: one["color"] == GREEN)}
    assert len(dashes) >= 5 and all(name.startswith("/reference/") for name in dashes)


def test_keyframes_show_their_events_in_the_cameras_field_of_view(client: ViewerClient):
    client.wait_for("CameraFrustumMessage", more_than=10)
    frustums = client.all("CameraFrustumMessage")
    assert len({one["name"] for one in frustums}) == 11
    for one in frustums:
        assert one["fov"] == pytest.approx(2 * np.arctan(18 / 41)) and one["aspect"] == pytest.approx(48 / 36)
        picture = cv2.imdecode(np.frombuffer(one["image_binary"], np.uint8), cv2.IMREAD_GRAYSCALE)
        assert picture is not None and picture.shape == (36, 48) and picture.std() > 3


def test_trajectories_can_be_hidden(client: ViewerClient):
    client.wait_for("CatmullRomSplineMessage")
    client.set("initial, blue", False)
    hidden = client.wait_for(
        "SetSceneNodeVisibilityMessage", lambda one: one["name"] == "/initial" and not one["visible"]
    )
    assert hidden
    client.set("initial, blue", True)


def test_the_slider_shows_another_moment_and_moves_the_camera_there(client: ViewerClient):
    client.wait_for("GuiUpdateMessage", lambda one: "data:image/png" in one["updates"].get("markdown", ""))
    before, positions = client.pictures()[-1], len(client.all("SetCameraPositionMessage"))
    client.set("time [s]", 0.1)
    client.wait_for("SetCameraPositionMessage", more_than=positions)
    after = client.wait_for(
        "GuiUpdateMessage", lambda one: "0.100 s on the clock" in one["updates"].get("markdown", "")
    )
    assert after["updates"]["markdown"] != before
    encoded = after["updates"]["markdown"].split("base64,")[1].rstrip(")")
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(encoded), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    height, width = picture.shape
    quarters = [picture[y : y + height // 2, x : x + width // 2] for y in (0, height // 2) for x in (0, width // 2)]
    # Events, events predicted (none, by a field so young), log brightness, and the frame.
    assert [quarter[40:-10, 10:-10].std() > 2 for quarter in quarters][::3] == [True, True]
    assert all(quarter.std() > 2 for quarter in quarters)


def test_the_button_sends_the_refined_trajectory_whole(client: ViewerClient, training: EbarfTrainer, tmp_path: Path):
    client.wait_for("GuiAddButtonMessage", lambda one: one["label"] == "Save refined trajectory")
    client.set("Save refined trajectory", True)
    start = client.wait_for("FileTransferStart")
    parts = client.wait_for("FileTransferPart")
    assert start["filename"] == "trajectory_refined.txt" and len(parts["content"]) == start["size_bytes"]
    (tmp_path / "saved.txt").write_bytes(parts["content"])
    saved, now = read_tum(tmp_path / "saved.txt"), training.pipeline.trajectory()
    assert np.allclose(saved.poses.position, now.poses.position, atol=1e-6) and len(saved.t_us) == 11


def test_frozen_poses_stay_until_released(client: ViewerClient, training: EbarfTrainer):
    optimizer = training.pipeline.model.camera_optimizer
    client.wait_for("GuiAddButtonMessage", lambda one: one["label"] == "Freeze poses")
    client.set("Freeze poses", True)
    wait_until(lambda: optimizer.frozen)
    before = optimizer.correction.detach().clone()
    for step in range(10, 16):
        one_step(training, step)
    assert optimizer.correction.equal(before)
    client.set("Release poses", True)
    wait_until(lambda: not optimizer.frozen)
    for step in range(20, 24):
        one_step(training, step)
    assert not optimizer.correction.equal(before)


def test_lines_and_curves_follow_the_training(client: ViewerClient, training: EbarfTrainer):
    is_line = lambda one: one["name"] == "/refined/line"  # noqa: E731
    client.wait_for("CatmullRomSplineMessage", is_line)
    wait_until(lambda: len(client.pictures()) >= 2)
    lines, pictures = len(client.all("CatmullRomSplineMessage", is_line)), len(client.pictures())
    end, step = time.monotonic() + 60, 100
    while time.monotonic() < end and len(client.all("CatmullRomSplineMessage", is_line)) <= lines + 1:
        one_step(training, step)
        step += 1
    first, *_, last = client.all("CatmullRomSplineMessage", is_line)
    assert first["positions"] != last["positions"]
    wait_until(lambda: len(client.pictures()) > pictures)


def test_curves_show_what_there_is():
    records = [{"step": 1, "loss": 2.0}, {"step": 5, "loss": 1.0, "corrected_position": 0.1, "ate_m": 0.2}]
    empty, some = (cv2.imdecode(np.frombuffer(curves(one), np.uint8), cv2.IMREAD_COLOR) for one in ([], records))
    assert some.shape == (900, 600, 3)
    # Orange in the first and third quarter, green in the third.
    hue = cv2.cvtColor(some, cv2.COLOR_BGR2HSV)
    for color, quarters in (((14, 242), [True, False, True, False]), ((60, 182), [False, False, True, False])):
        there = (abs(hue[..., 0].astype(int) - color[0]) < 6) & (hue[..., 1] > 150)
        assert [bool(quarter.sum() > 20) for quarter in np.split(there, 4)] == quarters
    assert cv2.cvtColor(empty, cv2.COLOR_BGR2HSV)[..., 1].max() < 50


def test_exposure_brightens_what_is_rendered(client: ViewerClient, training: EbarfTrainer):
    client.wait_for("GuiAddSliderMessage", lambda one: one["label"] == "exposure [stops]")
    grey = training.pipeline.model.grey(training.pipeline.model.display_range.mean())
    client.set("exposure [stops]", 0.5)
    wait_until(lambda: training.pipeline.model.exposure == 0.5)
    assert training.pipeline.model.grey(training.pipeline.model.display_range.mean()) > grey
    client.set("exposure [stops]", 0.0)


def test_buttons_of_cameras_that_are_not_there_yet_do_no_harm(training: EbarfTrainer):
    viewer = training.viewer_state
    assert viewer is not None and viewer.camera_handles == {}  # pyright: ignore[reportAttributeAccessIssue]
    viewer.set_camera_visibility(False)  # pyright: ignore[reportAttributeAccessIssue]
    viewer.update_camera_poses()  # pyright: ignore[reportAttributeAccessIssue]


def wait_until(true: Callable[[], bool], patience_s: float = 60) -> None:
    end = time.monotonic() + patience_s
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)
