"""Training through the trainer itself, in this process: budget, resume, guard, schedules, and what is left behind."""

import copy
import json
import shutil
from dataclasses import replace
from functools import reduce
from pathlib import Path

import pytest
import torch

from ebarf_ns.errors import TrainingError
from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.nerf import method
from ebarf_ns.nerf.guard import GuardedOptimizers
from ebarf_ns.nerf.optimizers import FusedAdamConfig
from ebarf_ns.nerf.trainer import EbarfTrainer, EbarfTrainerConfig
from ebarf_ns.simulation.sensor import SensorModel
from ebarf_ns.simulation.simulate import Simulation, simulate


def config(scene: Path, output: Path, name: str = "ebarf", steps: int = 12) -> EbarfTrainerConfig:
    specification = {"ebarf": method.ebarf, "ebarf-paper": method.ebarf_paper, "enerf": method.enerf}[name]
    made = copy.deepcopy(specification.config)
    assert isinstance(made, EbarfTrainerConfig)
    made.data = made.pipeline.datamanager.data = scene
    made.output_dir, made.experiment_name, made.timestamp = output, "x", "run"
    made.vis = "tensorboard"
    made.viewer.quit_on_train_completion = True
    made.logging.local_writer.enable = False
    made.max_num_iterations, made.evaluations, made.machine.device_type = steps, 2, "cpu"
    model = made.pipeline.model
    model.grid_table_size_log2, model.samples, model.density_cells = 10, 8, 16  # pyright: ignore[reportAttributeAccessIssue]
    model.grid_levels, model.grid_finest, model.precision = 4, 32, "float32"  # pyright: ignore[reportAttributeAccessIssue]
    datamanager = made.pipeline.datamanager
    datamanager.train_num_rays_per_batch, datamanager.eval_num_rays_per_batch = 128, 512  # pyright: ignore[reportAttributeAccessIssue]
    return made


def trainer(made: EbarfTrainerConfig) -> EbarfTrainer:
    torch.manual_seed(made.machine.seed)
    # Part of a circle of imports that must not begin with it.
    from nerfstudio.utils import writer

    # Nerfstudio would go on writing for every run that this process ever began.
    writer.EVENT_WRITERS.clear()
    ready = made.setup(local_rank=0, world_size=1)
    ready.setup()
    return ready


def state(ready: EbarfTrainer) -> dict[str, torch.Tensor]:
    """Everything a checkpoint holds of the pipeline but what it cost."""
    return {
        name: value.clone() for name, value in ready.pipeline.state_dict().items() if name not in ("cost", "checksum")
    }


def saved(ready: EbarfTrainer) -> dict[str, torch.Tensor]:
    """The same of its one checkpoint."""
    (path,) = ready.checkpoint_dir.iterdir()
    kept = torch.load(path, weights_only=True)["pipeline"]
    return {name: value for name, value in kept.items() if name not in ("cost", "checksum")}


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


@pytest.mark.parametrize("name", ["ebarf", "ebarf-paper", "enerf"])
def test_each_method_leaves_trajectories_metrics_and_report(tiny_scene: Path, tmp_path: Path, name: str):
    made = config(tiny_scene, tmp_path, name)
    trainer(made).train()
    run = tmp_path / "x" / name / "run"
    header, *evaluations = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert header["method"] == name and len(evaluations) == 2
    last = evaluations[-1]
    assert last["step"] == 12 and last["event_pairs"] == 12 * 64 and last["skipped_steps"] == 0
    assert 0 < last["heldout_event_loss"] <= 1.001 and last["psnr"] > 5 and last["ate_m"] > 0
    initial, refined = (read_tum(run / f"trajectory_{which}.txt") for which in ("initial", "refined"))
    given = read_tum(tiny_scene / "trajectory.txt")
    assert torch.equal(initial.t_us, given.t_us)
    assert torch.allclose(initial.poses.position, given.poses.position, atol=1e-5)
    moved = (refined.poses.position - initial.poses.position).abs().max()
    assert moved < 1e-5 if name == "enerf" else moved > 1e-4
    assert (run / "report" / "report.html").stat().st_size > 10_000


def test_a_ratio_of_thresholds_stands_where_it_is_stated_and_is_counted_where_it_is_not(tmp_path: Path):
    sensor = SensorModel(threshold_on=0.3, threshold_off=0.2)
    made = Simulation(width=48, height=36, focal_px=41.0, frames=1, rays_per_pixel=4, sensor=sensor)
    scene = simulate(made, tmp_path / "scene").folder
    stated = json.loads((scene / "scene.json").read_text())
    ratios = {}
    for name, threshold in (("wrong", {"on": 0.2, "off": 0.2}), ("untold", None)):
        (scene / "scene.json").write_text(json.dumps({**stated, "contrast_threshold": threshold}))
        ready = trainer(config(scene, tmp_path / name, steps=300))
        ready.train()
        on, off = ready.pipeline.model.sensor()
        ratios[name] = float(on / off)
    assert ratios["wrong"] == 1 and ratios["untold"] == pytest.approx(1.5, rel=0.1)


@pytest.mark.slow
def test_a_time_constant_is_found_where_there_is_one_and_not_where_there_is_none(tmp_path: Path):
    found = {}
    for cutoff_hz in (0.0, 30.0):
        sensor = SensorModel(cutoff_hz=cutoff_hz, cutoff_reference=0.3 if cutoff_hz else 0.0)
        size = {"width": 48, "height": 36, "focal_px": 41.0}
        made = Simulation(speed=3, duration_s=1, frames=1, rays_per_pixel=4, sensor=sensor, **size)
        scene = simulate(made, tmp_path / f"{cutoff_hz} Hz").folder
        (scene / "trajectory.txt").write_bytes((scene / "groundtruth.txt").read_bytes())
        for given_us in (None, 0.0) if cutoff_hz else (None,):
            chosen = config(scene, tmp_path / f"run {cutoff_hz} {given_us}", steps=400)
            model, chosen.pipeline.datamanager.train_num_rays_per_batch = chosen.pipeline.model, 512  # pyright: ignore[reportAttributeAccessIssue]
            model.grid_table_size_log2, model.grid_levels, model.grid_finest, model.samples = 13, 6, 128, 12  # pyright: ignore[reportAttributeAccessIssue]
            model.camera_optimizer.mode, model.time_constant_us = "off", given_us  # pyright: ignore[reportAttributeAccessIssue]
            ready = trainer(chosen)
            ready.train()
            found[cutoff_hz, given_us] = ready.pipeline.evaluate()
    assert found[0.0, None]["time_constant_us"] < 200 and found[30.0, None]["time_constant_us"] > 1000
    assert found[30.0, None]["heldout_event_loss"] < 0.9 * found[30.0, 0.0]["heldout_event_loss"]


@pytest.mark.slow
def test_unknown_thresholds_are_found_up_to_their_scale(tmp_path: Path):
    sensor = SensorModel(threshold_on=0.4, threshold_off=0.25)
    tiny = Simulation(width=48, height=36, focal_px=41.0, frames=3, rays_per_pixel=4, sensor=sensor)
    ends = []
    for told in (True, False):
        scene = simulate(replace(tiny, tell_thresholds=told), tmp_path / f"told {told}").folder
        made = config(scene, tmp_path / f"run, told {told}", steps=1500)
        # What a field cannot show is missing in the changes that tell the ratio.
        model = made.pipeline.model
        model.grid_table_size_log2, model.grid_levels, model.grid_finest, model.samples = 14, 6, 128, 24  # pyright: ignore[reportAttributeAccessIssue]
        ready = trainer(made)
        ready.train()
        on, off = ready.pipeline.model.sensor()
        assert float(on / off) == pytest.approx(1.6, rel=0.1)
        ends.append(ready.pipeline.evaluate())
    told, found = ends
    # Trainings of so small a scene differ by half a decibel from time to time.
    assert found["psnr"] == pytest.approx(told["psnr"], abs=2.0)
    assert found["heldout_event_loss"] == pytest.approx(told["heldout_event_loss"], rel=0.1)


def test_frames_outside_the_trajectory_are_placed_by_the_reference_and_reported_apart(tiny_scene: Path, tmp_path: Path):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    lines = (scene / "trajectory.txt").read_text().splitlines()
    (scene / "trajectory.txt").write_text("\n".join(lines[:8]))
    frames = json.loads((scene / "frames.json").read_text())
    # Of one more, not even the reference tells.
    (scene / "frames.json").write_text(json.dumps([*frames, {**frames[-1], "t_us": 10**7}]))
    ready = trainer(config(scene, tmp_path, steps=40))
    ready.train()
    results = ready.pipeline.evaluate()
    assert results["frames"] == 2 and results["frames_outside_span"] == 1
    # Less is seen of it, but a wrong place would show nothing of the room at all.
    assert results["psnr_outside_span"] and 8 < results["psnr_outside_span"] < 60


def test_seconds_end_a_run_and_drive_its_schedules(tiny_scene: Path, tmp_path: Path):
    made = config(tiny_scene, tmp_path, steps=10**6)
    made.max_train_seconds = 1.5
    made.optimizers["fields"]["scheduler"].lr_final_ratio = 0.1
    ready = trainer(made)
    ready.train()
    assert ready.train_seconds >= 1.5 and ready.steps_done < 10**5
    assert ready.progress() >= 1
    rate = ready.optimizers.optimizers["fields"].param_groups[0]["lr"]
    assert rate < 0.3 * made.optimizers["fields"]["optimizer"].lr


def test_equal_seeds_give_equal_runs_and_others_do_not(tiny_scene: Path, tmp_path: Path):
    ends = []
    for seed in (1, 1, 2):
        made = config(tiny_scene, tmp_path / str(len(ends)))
        made.machine.seed = seed
        ready = trainer(made)
        ready.train()
        ends.append(state(ready))
    assert same(ends[0], ends[1]) and not same(ends[0], ends[2])


def test_a_used_up_budget_is_said_in_one_line(tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    done = trainer(config(tiny_scene, tmp_path))
    done.train()
    made = config(tiny_scene, tmp_path / "again")
    made.load_dir = done.checkpoint_dir
    with pytest.raises(SystemExit) as stopped:
        trainer(made)
    assert stopped.value.code == 2 and "has used its budget (12 steps" in capsys.readouterr().err


def test_a_run_is_begun_anew_in_its_folder_only_when_told_so_and_leaves_one_record(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    made = config(tiny_scene, tmp_path, steps=4)
    trainer(made).train()
    before = (tmp_path / "x" / "ebarf" / "run" / "metrics.jsonl").read_bytes()
    with pytest.raises(SystemExit) as stopped:
        trainer(config(tiny_scene, tmp_path, steps=4))
    assert stopped.value.code == 2 and "holds a run, up to step-000000003.ckpt; expected" in capsys.readouterr().err
    assert (tmp_path / "x" / "ebarf" / "run" / "metrics.jsonl").read_bytes() == before
    made.overwrite, made.max_num_iterations = True, 2
    trainer(made).train()
    assert [path.name for path in (made.get_checkpoint_dir()).iterdir()] == ["step-000000001.ckpt"]
    lines = [json.loads(line) for line in (tmp_path / "x" / "ebarf" / "run" / "metrics.jsonl").read_text().splitlines()]
    assert ["versions" in line for line in lines] == [True, False, False]


def test_a_recording_too_short_to_hold_anything_back_still_trains(tiny_scene: Path, tmp_path: Path):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    content = json.loads((scene / "scene.json").read_text())
    (scene / "scene.json").write_text(json.dumps({**content, "frames": None, "groundtruth": None}))
    made = config(scene, tmp_path, steps=4)
    made.pipeline.datamanager.heldout_share = 0.0  # pyright: ignore[reportAttributeAccessIssue]
    trainer(made).train()
    run = tmp_path / "x" / "ebarf" / "run"
    assert json.loads((run / "metrics.jsonl").read_text().splitlines()[-1])["heldout_event_loss"] is None
    assert (run / "report" / "report.html").is_file() and list((run / "nerfstudio_models").iterdir())


@pytest.mark.parametrize(("flag", "value"), [("max_num_iterations", 0), ("max_train_seconds", -1.0)])
def test_no_budget_is_an_error(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], flag: str, value: float
):
    made = config(tiny_scene, tmp_path)
    setattr(made, flag, value)
    with pytest.raises(SystemExit):
        trainer(made)
    assert f"--{flag.replace('_', '-')} is {value}, expected more than 0" in capsys.readouterr().err


def test_a_checkpoint_loads_without_pickled_code(tiny_scene: Path, tmp_path: Path):
    ready = trainer(config(tiny_scene, tmp_path))
    ready.train()
    (path,) = ready.checkpoint_dir.iterdir()
    assert torch.load(path, weights_only=True)["step"] == 11
    assert not list(ready.base_dir.glob("*.ckpt"))


def test_a_checkpoint_holds_the_mean_of_the_last_steps_which_training_is_not_told(tiny_scene: Path, tmp_path: Path):
    def trained(steps: int, averaged_steps: int) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
        made = config(tiny_scene, tmp_path / f"{steps} {averaged_steps}", steps=steps)
        made.averaged_steps = averaged_steps
        ready = trainer(made)
        ready.train()
        made.load_dir, made.max_num_iterations = ready.checkpoint_dir, steps + 1
        assert same(state(trainer(made)), state(ready))
        return state(ready), saved(ready)

    (first, _), (second, alone), (again, mean) = trained(1, 100), trained(2, 1), trained(2, 100)
    assert same(second, alone) and same(second, again)
    tables = [name for name in mean if name.endswith("grid.table")]
    assert tables and not torch.equal(mean[tables[0]], second[tables[0]])
    for name in tables:
        assert torch.allclose(mean[name], first[name].lerp(second[name], 10 / 11), atol=1e-7)


def test_the_viewer_left_open_after_training_shows_what_was_saved(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    from nerfstudio.engine.trainer import Trainer

    shown: list[dict[str, torch.Tensor]] = []
    monkeypatch.setattr(Trainer, "_train_complete_viewer", lambda training: shown.append(state(training)))
    made = config(tiny_scene, tmp_path)
    made.viewer.quit_on_train_completion = False
    ready = trainer(made)
    ready.train()
    assert same(shown[0], saved(ready)) and not same(shown[0], state(ready))


def test_pairs_share_distances_and_jitter(tiny_scene: Path, tmp_path: Path):
    ready = trainer(config(tiny_scene, tmp_path))
    model = ready.pipeline.model.train()
    model.begin_step(0, seed=0)
    bundle, _ = ready.pipeline.datamanager.next_train(0)
    model.camera_optimizer.apply_to_raybundle(bundle)
    from ebarf_ns.radiance.ray_sampling import Rays

    before, after = model.renderer.sample_edges(Rays(bundle.origins, bundle.directions), model.random).chunk(2)
    assert torch.equal(before, after)


def test_the_fast_paths_train_as_the_torch_reference_does(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Kernels for encoding and sampling against plain torch, in float32: chaos apart, one and the same training."""
    from ebarf_ns.radiance import ray_sampling, ray_sampling_numba

    ends = []
    for name in ("kernels", "reference"):
        ready = trainer(config(tiny_scene, tmp_path / name, steps=60))
        if name == "reference":
            ready.pipeline.model.renderer.field.grid.backend = "torch"
            monkeypatch.setattr(ray_sampling_numba, "importance_edges", ray_sampling.importance_edges)
        ready.train()
        ends.append(ready.pipeline.evaluate())
    fast, reference = ends
    assert fast["psnr"] != reference["psnr"]
    assert fast["psnr"] == pytest.approx(reference["psnr"], abs=0.3)
    assert fast["heldout_event_loss"] == pytest.approx(reference["heldout_event_loss"], rel=0.03)
    assert fast["ate_m"] == pytest.approx(reference["ate_m"], rel=0.02)


@pytest.mark.parametrize(
    ("part", "field", "value"),
    [("machine", "seed", -1), ("pipeline.datamanager", "longest_pair", 0), ("pipeline.model", "near", 0.0),
     ("pipeline.model", "grid_finest", 0), ("pipeline.model", "coarse_samples", 0),
     ("pipeline.datamanager", "train_num_rays_per_batch", 1), ("pipeline.datamanager", "index_memory_gib", 0.0)],
)  # fmt: skip
def test_settings_that_make_no_sense_are_named(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], part: str, field: str, value: float
):
    made = config(tiny_scene, tmp_path)
    setattr(reduce(getattr, part.split("."), made), field, value)
    with pytest.raises(SystemExit):
        trainer(made)
    assert f"--{part}.{field}".replace("_", "-") + f" is {value}, expected at least" in capsys.readouterr().err


def test_silence_without_a_unit_is_named(tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    made = config(tiny_scene, tmp_path, "ebarf-paper")
    made.pipeline.datamanager.silent_share = 0.125  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(SystemExit):
        trainer(made)
    assert "--pipeline.datamanager.silent-share is 0.125, expected 0 with" in capsys.readouterr().err


@pytest.mark.parametrize("folder", ["its own", "another"])
def test_a_resumed_run_keeps_its_plan_and_its_records(tiny_scene: Path, tmp_path: Path, folder: str):
    made = config(tiny_scene, tmp_path, steps=4)
    made.pipeline.model.grid_finest = 77  # pyright: ignore[reportAttributeAccessIssue]
    first = trainer(made)
    first.train()
    record = json.loads((first.base_dir / "metrics.jsonl").read_text().splitlines()[-1])
    with (first.base_dir / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({**record, "step": 5}) + "\n")  # killed after the step after its last checkpoint
    again = config(tiny_scene, tmp_path if folder == "its own" else tmp_path / "second", steps=8)
    again.load_dir = first.checkpoint_dir
    for name in ("grid_finest", "samples"):
        setattr(again.pipeline.model, name, None)
    if folder == "its own":
        (first.base_dir / "config.yml").write_text("as ns-train writes it before there is a plan")
    second = trainer(again)
    assert second.pipeline.model.renderer.field.grid.shape.finest == 77
    reasons = {line.field: line.reason for line in second.plan}
    assert reasons["pipeline.model.grid_finest"] == "as in the run resumed"
    second.train()
    _, *records = map(json.loads, (second.base_dir / "metrics.jsonl").read_text().splitlines())
    assert [record["step"] for record in records] == ([2, 4, 8] if folder == "its own" else [8])


@pytest.mark.parametrize("given", ["load_checkpoint", "load_step"])
def test_a_checkpoint_that_is_none_is_named(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], given: str
):
    made = config(tiny_scene, tmp_path)
    if given == "load_step":
        made.load_dir, made.load_step = tmp_path, 7
    else:
        made.load_checkpoint = tmp_path / "step-000000007.ckpt"
    with pytest.raises(SystemExit) as stopped:
        trainer(made)
    assert stopped.value.code == 2 and "step-000000007.ckpt: is no file, expected" in capsys.readouterr().err


@pytest.mark.parametrize("what", ["text", "a list", "of other flags"])
def test_what_cannot_be_gone_on_from_ends_in_one_line(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], what: str
):
    made = config(tiny_scene, tmp_path, steps=1)
    path = tmp_path / "step-000000007.ckpt"
    if what == "text":
        path.write_text("no checkpoint")
    elif what == "a list":
        torch.save([1, 2], path)
    else:
        first = trainer(made)
        first.train()
        path = first.checkpoint_dir / "step-000000000.ckpt"
        made = config(tiny_scene, tmp_path / "second")
        made.pipeline.model.grid_features = 2  # pyright: ignore[reportAttributeAccessIssue]
    made.load_checkpoint = path
    with pytest.raises(SystemExit) as stopped:
        trainer(made)
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and said.count("\n") == 1
    if what == "of other flags":
        assert f"{path.name}: cannot go on from it" in said and "with the flags it was made by" in said
        assert "by: --pipeline.model.grid-features 4 (now 2)" in said
    else:
        assert f"{path.name}: is damaged, or no checkpoint" in said


def test_a_gradient_beyond_reason_is_skipped_unless_it_stays_so():
    parameter = torch.nn.Parameter(torch.zeros(5))
    optimizers = GuardedOptimizers(
        {"x": {"optimizer": FusedAdamConfig(lr=0.01), "scheduler": None}}, {"x": [parameter]}
    )
    scaler = torch.amp.GradScaler(enabled=False)

    def step(size: float) -> int:
        before = optimizers.skipped
        parameter.grad = torch.full((5,), size)
        optimizers.optimizer_scaler_step_some(scaler, ["x"])
        return optimizers.skipped - before

    assert not any(step(1.0) for _ in range(30))
    moments = {name: value.clone() for name, value in optimizers.optimizers["x"].state[parameter].items()}
    assert step(1e25) and step(torch.inf) == 1 and not step(2.0)
    assert step(1e6) and not step(0.5)
    after = optimizers.optimizers["x"].state[parameter]
    assert after["step"] == moments["step"] + 2 and float(after["exp_avg_sq"].max()) < 5
    assert [step(1e6) for _ in range(4)] == [1, 1, 0, 0]


def test_one_percent_of_the_last_thousand_steps_may_be_skipped_and_no_more():
    parameter = torch.nn.Parameter(torch.zeros(5))
    optimizers = GuardedOptimizers(
        {"x": {"optimizer": FusedAdamConfig(lr=0.01), "scheduler": None}}, {"x": [parameter]}
    )
    scaler = torch.amp.GradScaler(enabled=False)

    def step(size: float) -> None:
        parameter.grad = torch.full((5,), size)
        optimizers.optimizer_scaler_step_some(scaler, ["x"])

    for _ in range(30):
        for number in range(100):
            step(torch.nan if number == 50 else 1.0)
    assert optimizers.skipped == 30
    again = GuardedOptimizers({"x": {"optimizer": FusedAdamConfig(lr=0.01), "scheduler": None}}, {"x": [parameter]})
    again.load_guard_state(optimizers.guard_state())
    optimizers = again
    with pytest.raises(TrainingError, match="11 of the last 1000 steps had gradients that are not finite"):
        step(torch.nan)


def test_a_parameter_that_is_not_finite_is_found_wherever_it_is():
    small, large = torch.nn.Parameter(torch.zeros(5)), torch.nn.Parameter(torch.zeros(300, 700))
    optimizers = GuardedOptimizers(
        {"x": {"optimizer": FusedAdamConfig(lr=0.01), "scheduler": None}}, {"x": [small, large]}
    )
    for step in range(100):
        optimizers.check_parameters(step)
    with torch.no_grad():
        large[123, 456] = torch.nan
    with pytest.raises(TrainingError, match="no longer finite"):
        for step in range(64):
            optimizers.check_parameters(step)
    with torch.no_grad():
        large[123, 456], small[0] = 0.0, torch.inf
    with pytest.raises(TrainingError, match="no longer finite"):
        optimizers.check_parameters(0)


def test_a_step_in_which_no_group_is_due_is_not_a_broken_one():
    optimizers = GuardedOptimizers({}, {})
    optimizers.optimizer_scaler_step_some(torch.amp.GradScaler(enabled=False), [])
    assert optimizers.skipped == 0


def test_learned_intrinsics_are_written_as_scene_json_has_them_and_learned_on_when_resumed(
    tiny_scene: Path, tmp_path: Path
):
    made = config(tiny_scene, tmp_path)
    made.learn_intrinsics = True
    ready = trainer(made)
    ready.train()
    given = json.loads((tiny_scene / "scene.json").read_text())["camera"]
    refined = json.loads((ready.base_dir / "camera_refined.json").read_text())
    assert refined.keys() == given.keys() and refined["width"] == given["width"]
    assert 0 < abs(refined["fx"] / given["fx"] - 1) < 0.05
    assert refined["fx"] / refined["fy"] == pytest.approx(given["fx"] / given["fy"])
    more = config(tiny_scene, tmp_path, steps=16)
    more.learn_intrinsics, more.load_dir = True, ready.checkpoint_dir
    resumed = trainer(more)
    assert resumed.pipeline.model.intrinsics
    assert resumed.pipeline.model.intrinsics.refined().fx == pytest.approx(refined["fx"], rel=1e-3)
