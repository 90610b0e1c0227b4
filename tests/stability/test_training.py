"""Trainings that are killed, broken, resumed or fed the worst: cases 25 to 29, and the stiff scenes."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ebarf_ns.errors import TrainingError
from ebarf_ns.events.recording import Recording, read_recording, write_recording
from ebarf_ns.geometry.trajectory import Poses, Trajectory, interpolate
from ebarf_ns.geometry.trajectory_file import read_tum, write_tum
from ebarf_ns.nerf.trainer import EbarfTrainer, EbarfTrainerConfig
from ebarf_ns.simulation.catalogue import Place
from ebarf_ns.simulation.motion import HandheldMotion
from ebarf_ns.simulation.room import Room
from ebarf_ns.simulation.sensor import SensorModel
from ebarf_ns.simulation.simulate import Simulation, simulate
from ebarf_ns.simulation.trajectory_errors import TrajectoryErrors
from tests.conftest import REPOSITORY
from tests.nerf.test_training import config, same, state, trainer

KILLS = 50
STEPS, RAYS = 80, 1024
UNITS_AGREE = 0.15
FAR_AGREES = 0.25
LEARNED, SOMETHING_LEARNED, NOTHING_LEARNED = 0.5, 0.95, 0.5
LOST_DEG = 10.0
SMALL = Simulation(width=24, height=18, focal_px=20.0, duration_s=0.4, frames=2, rays_per_pixel=4)


@pytest.fixture(scope="module")
def small_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(SMALL, tmp_path_factory.mktemp("stiff") / "scene").folder


def newest_checkpoint(folder: Path) -> dict:
    return torch.load(max(folder.glob("step-*.ckpt")), weights_only=True)


def test_case_25_a_kill_while_saving_always_leaves_a_whole_checkpoint(small_scene: Path, tmp_path: Path):
    ready = trainer(config(small_scene, tmp_path))
    ready.steps_done = 1
    ready.save_checkpoint(0)
    chance = random.Random(0)
    for _ in range(KILLS):
        child = os.fork()
        if child == 0:
            # Forked in the midst of a test run: nothing but saving, and no way out but the kill.
            while True:
                ready.steps_done += 1
                ready.save_checkpoint(0)
        time.sleep(chance.uniform(0.0, 0.03))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        assert newest_checkpoint(ready.checkpoint_dir)["ebarf"]["event_pairs"] == 0


def test_case_25_a_full_disk_leaves_the_older_checkpoint(
    small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    ready = trainer(config(small_scene, tmp_path))
    ready.steps_done = 5
    ready.save_checkpoint(0)

    def fill(state: dict, path: Path) -> None:
        path.write_bytes(b"half of a checkpoint")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", fill)
    ready.steps_done = 9
    with pytest.raises(TrainingError, match="No space left on device.*; expected room on the disk"):
        ready.save_checkpoint(0)
    assert [path.name for path in ready.checkpoint_dir.iterdir()] == ["step-000000004.ckpt"]
    assert newest_checkpoint(ready.checkpoint_dir)["step"] == 4 and not list(ready.base_dir.glob("*.ckpt"))


def test_case_25_a_full_disk_leaves_the_evaluations_before_it_and_is_one_line(
    small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    ready = trainer(config(small_scene, tmp_path))
    write = Path.write_text

    def fill(path: Path, text: str, **options: str) -> None:
        full = "metrics" in path.name and len(text.splitlines()) > 2
        write(path, text[: len(text) // 2] if full else text, **options)
        if full:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", fill)
    with pytest.raises(SystemExit) as stopped:
        ready.train()
    assert stopped.value.code == 2 and "metrics.jsonl: No space left on device\n" in capsys.readouterr().err
    header, first = [json.loads(line) for line in (ready.base_dir / "metrics.jsonl").read_text().splitlines()]
    assert header["method"] == "ebarf" and first["step"] == ready.steps_done // 2


RESUME = """
import sys
from pathlib import Path
import torch
from tests.nerf.test_training import config, state, trainer
scene, output, checkpoints = map(Path, sys.argv[1:])
made = config(scene, output)
made.load_dir, made.threads = checkpoints, 1
ready = trainer(made)
assert ready.steps_done == 7
ready.train()
torch.save(state(ready), output / "end.pt")
"""


def test_case_26_a_run_resumed_in_another_process_ends_bitwise_where_an_uninterrupted_one_does(
    small_scene: Path, tmp_path: Path
):
    # As many threads in each, whatever else the machine has to do: sums come out the same.
    made = [config(small_scene, tmp_path / name) for name in ("whole", "first")]
    for one in made:
        one.threads = 1
    whole, first = trainer(made[0]), trainer(made[1])
    whole.train()
    for step in range(7):
        first.pipeline.train()
        first.train_iteration(step)
    first.save_checkpoint(6)
    (tmp_path / "second").mkdir()
    command = [sys.executable, "-c", RESUME, small_scene, tmp_path / "second", first.checkpoint_dir]
    subprocess.run(command, check=True, cwd=REPOSITORY, stdout=subprocess.DEVNULL)
    assert same(state(whole), torch.load(tmp_path / "second" / "end.pt", weights_only=True))


@pytest.mark.parametrize("broken", ["loss", "field", "poses"])
def test_case_27_a_step_with_a_broken_gradient_changes_nothing(
    small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str
):
    ready = trainer(config(small_scene, tmp_path))
    ready.pipeline.train()
    ready.train_iteration(0)
    model, before = ready.pipeline.model, state(ready)
    moments = [str(one.state_dict()["state"]) for one in ready.optimizers.optimizers.values()]
    if broken == "loss":
        good = model.get_loss_dict
        monkeypatch.setattr(model, "get_loss_dict", lambda *of: {k: v * float("inf") for k, v in good(*of).items()})
        undo = monkeypatch.undo
    else:
        poisoned = model.camera_optimizer.correction if broken == "poses" else model.renderer.field.grid.table
        undo = poisoned.register_hook(lambda gradient: gradient * float("nan")).remove
    remembered = {name for name in before if "density_grid" in name or "display_range" in name}
    # Keyframes learn in even steps.
    ready.train_iteration(2)
    after = state(ready)
    assert all(torch.equal(before[name], after[name]) for name in before if name not in remembered)
    assert moments == [str(one.state_dict()["state"]) for one in ready.optimizers.optimizers.values()]
    assert ready.optimizers.skipped == 1
    undo()
    ready.train_iteration(4)
    assert not same(after, state(ready)) and ready.optimizers.skipped_in_a_row == 0


def test_case_27_ten_broken_steps_in_a_row_end_the_run_and_can_be_done_again(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    def watched(made: EbarfTrainerConfig) -> tuple[EbarfTrainer, list[torch.Tensor]]:
        ready, batches = trainer(made), []
        ready.pipeline.model.register_forward_pre_hook(lambda _, rays: batches.append(rays[0].directions.clone()))
        return ready, batches

    ready, broken_batches = watched(config(small_scene, tmp_path, steps=50))
    ready.pipeline.model.camera_optimizer.correction.register_hook(lambda gradient: gradient * float("inf"))
    with pytest.raises(SystemExit) as stopped:
        ready.train()
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and "10 training steps in a row" in said
    again = config(small_scene, tmp_path / "again", steps=50)
    (again.load_checkpoint,) = ready.checkpoint_dir.glob("*.ckpt")
    assert again.load_checkpoint.name in said.replace("\n", "")
    resumed, batches = watched(again)
    resumed.pipeline.train()
    resumed.train_iteration(resumed._start_step)
    assert torch.equal(batches[0], broken_batches[-1])


def test_case_28_poses_without_gradients_under_mixed_precision_do_not_end_the_run(small_scene: Path, tmp_path: Path):
    made = config(small_scene, tmp_path, steps=6)
    made.mixed_precision = made.use_grad_scaler = True
    ready = trainer(made)
    ready.pipeline.model.camera_optimizer.correction.requires_grad_(False)
    ready.train()
    assert ready.steps_done == 6


MODEL_CHANGES = {
    "loss": "normalized", "brightness": "lin_log", "intensity_range": "unit", "view_dependent": True, "grid_levels": 5,
    "grid_features": 2, "grid_coarsest": 5, "grid_finest": 40, "grid_table_size_log2": 11, "sampling": "uniform",
    "samples": 9, "coarse_samples": 64, "uniform_share": 0.5, "density_cells": 20, "near": 0.3,
    "most_hidden": 1e-3, "huber_delta": None, "contract": True, "precision": "bfloat16", "render_variance": 20.0,
    "broad_cells": 0, "threshold_ratio": 1.3,
}  # fmt: skip
POSE_CHANGES = {"smooth": False, "interpolation": "cubic", "mode": "off", "keyframe_stride": 3}
DATA_CHANGES = {
    "train_num_rays_per_batch": 64, "longest_pair": 3, "silent_share": 0.0, "refractory_us": 2000,
    "doubles_us": 40,    "heldout_share": 0.2, "seed": 5,
}  # fmt: skip


def first_losses(made: EbarfTrainerConfig) -> list[float]:
    torch.manual_seed(0)
    ready = made.setup(local_rank=0, world_size=1)
    ready.setup()
    ready.pipeline.train()
    return [float(ready.train_iteration(step)[0].detach()) for step in range(3)]


@pytest.fixture(scope="module")
def unchanged(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> list[float]:
    return first_losses(config(small_scene, tmp_path_factory.mktemp("unchanged"), steps=3))


@pytest.mark.parametrize("key", [*MODEL_CHANGES, *DATA_CHANGES, *POSE_CHANGES])
def test_case_29_every_field_of_the_configuration_changes_the_run(
    small_scene: Path, tmp_path: Path, unchanged: list[float], key: str
):
    made = config(small_scene, tmp_path, steps=3)
    if key in MODEL_CHANGES:
        setattr(made.pipeline.model, key, MODEL_CHANGES[key])
    if key in DATA_CHANGES:
        setattr(made.machine if key == "seed" else made.pipeline.datamanager, key, DATA_CHANGES[key])
    if key in POSE_CHANGES:
        setattr(made.pipeline.model.camera_optimizer, key, POSE_CHANGES[key])  # pyright: ignore[reportAttributeAccessIssue]
    assert first_losses(made) != unchanged, f"{key} changed nothing"


def test_case_29_pixels_that_never_fire_are_joined_where_there_are_any(small_scene: Path, tmp_path: Path):
    def half(given: Recording) -> Recording:
        return given.select(given.x.astype(int) + given.y < 25)

    scene = variant(small_scene, tmp_path / "scene", events=half)
    losses = []
    for share in (0.0, 0.3):
        made = config(scene, tmp_path / str(share), steps=3)
        made.pipeline.datamanager.blank_share = share  # pyright: ignore[reportAttributeAccessIssue]
        losses.append(first_losses(made))
    assert losses[0] != losses[1]


# The worst that scenes can be: finite to the end, and an honest report.


def variant(
    source: Path,
    folder: Path,
    events: Callable[[Recording], Recording] = lambda recording: recording,
    trajectory: Callable[[Trajectory], Trajectory] = lambda trajectory: trajectory,
    **changes: object,
) -> Path:
    """A copy of a scene with other events, other trajectories (both alike) and other entries in scene.json."""
    shutil.copytree(source, folder)
    write_recording(folder / "events.h5", [events(read_recording(folder / "events.h5", SMALL.width, SMALL.height))])
    for name in ("trajectory.txt", "groundtruth.txt"):
        write_tum(folder / name, trajectory(read_tum(folder / name)))
    content = json.loads((folder / "scene.json").read_text())
    (folder / "scene.json").write_text(json.dumps({**content, **changes}))
    return folder


def trained(scene: Path, output: Path, **model: object) -> dict:
    """The last evaluation of a short training of what users get, all of whose numbers must be finite or null."""
    made = config(scene, output, steps=STEPS)
    made.pipeline.datamanager.train_num_rays_per_batch = RAYS  # pyright: ignore[reportAttributeAccessIssue]
    for name, value in model.items():
        setattr(made.pipeline.model, name, value)
    ready = trainer(made)
    ready.train()
    run = output / "x" / "ebarf" / "run"
    *_, last = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert last["step"] == STEPS and last["skipped_steps"] == 0
    assert all(np.isfinite(value) for value in last.values() if isinstance(value, int | float))
    refined = read_tum(run / "trajectory_refined.txt")
    assert torch.isfinite(refined.poses.position).all() and torch.isfinite(refined.poses.quat_wxyz).all()
    assert all(
        torch.isfinite(value).all() for value in ready.pipeline.state_dict().values() if value.is_floating_point()
    )
    assert (run / "report" / "report.html").is_file()
    return last


def resampled(t_us: torch.Tensor) -> Callable[[Trajectory], Trajectory]:
    return lambda given: Trajectory(t_us, interpolate(given.t_us, given.poses, t_us))


def test_keyframes_a_microsecond_apart(small_scene: Path, tmp_path: Path):
    t_us = torch.tensor([0, 100_000, 100_001, 200_000, 200_001, 200_002, 400_000])
    last = trained(variant(small_scene, tmp_path / "scene", trajectory=resampled(t_us)), tmp_path)
    assert last["heldout_event_loss"] < LEARNED


def test_ten_thousand_keyframes(small_scene: Path, tmp_path: Path):
    t_us = torch.arange(10_000) * 40
    last = trained(variant(small_scene, tmp_path / "scene", trajectory=resampled(t_us)), tmp_path)
    assert last["heldout_event_loss"] < LEARNED and last["rotation_deg"] < LOST_DEG


def test_noisy_keyframes_of_a_long_recording(tmp_path: Path):
    """More keyframes than inverse roots a step, while the field is young and gradients grow fast."""
    simulate(replace(SMALL, duration_s=10.0, keyframe_rate_hz=40), tmp_path / "scene")
    last = trained(tmp_path / "scene", tmp_path)
    assert last["heldout_event_loss"] < SOMETHING_LEARNED
    assert last["rotation_deg"] < LOST_DEG and last["corrected_rotation_deg"] < LOST_DEG


def test_one_keyframe_interval_holds_all_events(small_scene: Path, tmp_path: Path):
    last = trained(variant(small_scene, tmp_path / "scene", trajectory=resampled(torch.tensor([0, 400_000]))), tmp_path)
    # Two poses cannot be aligned: no number is better than a wrong one.
    assert last["ate_m"] is None and last["heldout_event_loss"] < LEARNED


@pytest.mark.parametrize("threshold", [0.01, 2.0])
def test_thresholds_far_from_usual(tmp_path: Path, threshold: float):
    duration_s = 0.1 if threshold < 0.1 else 2.0
    sensor = SensorModel(threshold_on=threshold, threshold_off=threshold)
    simulate(replace(SMALL, sensor=sensor, duration_s=duration_s), tmp_path / "scene")
    assert trained(tmp_path / "scene", tmp_path)["heldout_event_loss"] < SOMETHING_LEARNED


def test_radiance_over_six_decades(tmp_path: Path):
    room = Room(window=(-1.2, -0.4, 0.6, 1.0), daylight=1e6)
    scene = simulate(SMALL, tmp_path / "scene", place=Place(room, HandheldMotion()))
    assert trained(scene.folder, tmp_path)["heldout_event_loss"] < SOMETHING_LEARNED


def test_a_hot_pixel_with_a_million_events(small_scene: Path, tmp_path: Path):
    def with_hot_pixel(given: Recording) -> Recording:
        hot = 1_000_000
        t_us = np.r_[given.t_us, np.random.default_rng(0).integers(0, 400_000, hot)]
        order = np.argsort(t_us, kind="stable")
        x, y = (np.r_[column, np.full(hot, 7, np.uint16)][order] for column in (given.x, given.y))
        polarity = np.r_[given.polarity, np.resize(np.array([1, -1], np.int8), hot)][order]
        return Recording(x, y, t_us[order], polarity)

    clean = trained(small_scene, tmp_path / "clean")
    scene = variant(small_scene, tmp_path / "scene", events=with_hot_pixel)
    hot = trained(scene, tmp_path / "hot")
    assert hot["rotation_deg"] < 1.3 * clean["rotation_deg"] and hot["psnr"] > clean["psnr"] - 2
    header = json.loads((tmp_path / "hot/x/ebarf/run/metrics.jsonl").read_text().splitlines()[0])
    assert header["hot_pixels_left_out"] == 1
    made = config(scene, tmp_path / "kept", steps=1)
    made.pipeline.datamanager.leave_out_hot_pixels = False  # pyright: ignore[reportAttributeAccessIssue]
    assert trainer(made).pipeline.datamanager.hot_pixels_left_out == 0


def test_all_polarities_equal(small_scene: Path, tmp_path: Path):
    def brighter(given: Recording) -> Recording:
        return replace(given, polarity=np.ones_like(given.polarity))

    last = trained(variant(small_scene, tmp_path / "scene", events=brighter), tmp_path)
    assert last["heldout_event_loss"] < LEARNED and last["implied_threshold_off"] is None


def test_pure_rotation(tmp_path: Path):
    motion = HandheldMotion(sway_m=(0.0, 0.0, 0.0), turn_rad=0.3)
    scene = simulate(SMALL, tmp_path / "scene", place=Place(Room(), motion))
    last = trained(scene.folder, tmp_path)
    # There is no path whose scale could be aligned; rotations still are.
    assert last["ate_m"] is None and last["scale"] is None and last["heldout_event_loss"] < LEARNED
    assert last["rotation_deg"] < LOST_DEG


def test_no_motion(small_scene: Path, tmp_path: Path):
    def still(given: Trajectory) -> Trajectory:
        return Trajectory(given.t_us, Poses(*(column[:1].expand(len(given.t_us), -1) for column in given.poses)))

    last = trained(variant(small_scene, tmp_path / "scene", trajectory=still, bounds=None), tmp_path, contract=True)
    # The events are of a motion that the trajectory knows nothing of: nothing can explain them, and that is said.
    assert last["heldout_event_loss"] > NOTHING_LEARNED and last["ate_m"] is None


def test_a_kilometre_away_and_half_a_century_late(small_scene: Path, tmp_path: Path):
    shift_us, shift_m = 1_700_000_000 * 10**6, 1000.0

    def far(given: Trajectory) -> Trajectory:
        return Trajectory(given.t_us + shift_us, Poses(given.poses.position + shift_m, given.poses.quat_wxyz))

    def late(given: Recording) -> Recording:
        return replace(given, t_us=given.t_us + shift_us)

    bounds = (np.array(json.loads((small_scene / "scene.json").read_text())["bounds"]) + shift_m).tolist()
    scene = variant(small_scene, tmp_path / "scene", events=late, trajectory=far, bounds=bounds)
    frames = json.loads((scene / "frames.json").read_text())
    (scene / "frames.json").write_text(json.dumps([{**one, "t_us": one["t_us"] + shift_us} for one in frames]))
    here, there = trained(small_scene, tmp_path / "here"), trained(scene, tmp_path / "there")
    for name in ("heldout_event_loss", "ate_m", "rotation_deg", "psnr"):
        assert there[name] == pytest.approx(here[name], rel=FAR_AGREES), name


@pytest.mark.parametrize("size", [1e-3 / 4, 1e4 / 4])
def test_a_scene_of_a_millimetre_and_one_of_ten_kilometres(small_scene: Path, tmp_path: Path, size: float):
    def scaled(given: Trajectory) -> Trajectory:
        return Trajectory(given.t_us, Poses(size * given.poses.position, given.poses.quat_wxyz))

    bounds = (size * np.array(json.loads((small_scene / "scene.json").read_text())["bounds"])).tolist()
    scene = variant(small_scene, tmp_path / "scene", trajectory=scaled, bounds=bounds)
    here, there = trained(small_scene, tmp_path / "here"), trained(scene, tmp_path / "there")
    assert there["ate_m"] == pytest.approx(size * here["ate_m"], rel=UNITS_AGREE)
    for name in ("heldout_event_loss", "rotation_deg", "psnr"):
        assert there[name] == pytest.approx(here[name], rel=UNITS_AGREE), name


def test_an_error_so_large_that_nothing_can_converge_is_reported_as_such(small_scene: Path, tmp_path: Path):
    scene = tmp_path / "scene"
    shutil.copytree(small_scene, scene)
    given = read_tum(scene / "trajectory.txt")
    quat = Rotation.random(len(given.t_us), np.random.default_rng(0)).as_quat()[:, [3, 0, 1, 2]]
    write_tum(scene / "trajectory.txt", Trajectory(given.t_us, Poses(given.poses.position, torch.from_numpy(quat))))
    last = trained(scene, tmp_path)
    assert last["rotation_deg"] > LOST_DEG and last["heldout_event_loss"] > NOTHING_LEARNED


def test_drift_of_thresholds_costs_no_more_than_a_fifth(tmp_path: Path):
    """Case 20: C drifts by 20 % either way within the recording."""
    ends = []
    for drift in (0.0, 0.4):
        sensor = SensorModel(threshold_drift=drift)
        errors = TrajectoryErrors(position_noise=0.03, rotation_noise_rad=0.03)
        scene = simulate(replace(SMALL, sensor=sensor, errors=errors, duration_s=0.8), tmp_path / f"scene{drift}")
        ends.append(trained(scene.folder, tmp_path / f"run{drift}"))
    assert ends[1]["ate_m"] <= 1.2 * ends[0]["ate_m"]


SENSORS = {
    "a ratio of 3": SensorModel(threshold_on=0.45, threshold_off=0.15),
    "blind longer than most intervals": SensorModel(refractory_us=30_000),
    "slower than what moves": SensorModel(cutoff_hz=3.0),
    "dark pixels slower than bright ones": SensorModel(cutoff_hz=50.0, cutoff_reference=0.5),
}


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
def test_extreme_sensors_are_trained_to_the_end_and_judged_by_what_is_known_of_them(
    sensor: SensorModel, tmp_path: Path
):
    scene = simulate(replace(SMALL, sensor=sensor, tell_thresholds=False), tmp_path / "scene")
    last = trained(scene.folder, tmp_path)
    assert 0 < last["heldout_event_loss"] <= 1 and np.isfinite([last["psnr"], last["log_correlation"]]).all()


def test_a_clock_of_milliseconds(small_scene: Path, tmp_path: Path):
    def stepped(given: Recording) -> Recording:
        return replace(given, t_us=given.t_us // 1000 * 1000)

    last = trained(variant(small_scene, tmp_path / "scene", events=stepped), tmp_path)
    assert last["heldout_event_loss"] < SOMETHING_LEARNED


def test_all_pixels_silent_but_a_few(small_scene: Path, tmp_path: Path):
    def few(given: Recording) -> Recording:
        return given.select((given.x % 16 == 8) & (given.y % 12 == 6))

    last = trained(variant(small_scene, tmp_path / "scene", events=few), tmp_path)
    assert last["heldout_event_loss"] is None or 0 <= last["heldout_event_loss"] <= 1
