"""Runs of earlier versions."""

import json
from pathlib import Path

import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup

from ebarf_ns.errors import TrainingError
from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.nerf.trainer import EbarfTrainer
from ebarf_ns.nerf.upgrades import completed
from tests.nerf.test_training import config, trainer

OLDER = ("camera_optimizer.clock_px", "camera_optimizer.hold", "sensor.time_constant", "sensor.deviations")


def made_older(ready: EbarfTrainer) -> None:
    """Leave a run as a version left it that knew less, had no checksums, and kept classes elsewhere."""
    (path,) = ready.checkpoint_dir.iterdir()
    state = torch.load(path, weights_only=True)
    state["pipeline"] = {k: v for k, v in state["pipeline"].items() if not k.endswith((*OLDER, "checksum"))}
    state["pipeline"]["_model.display_range"] = torch.tensor([-1.0, 1.0])
    del state["checksum"], state["format"], state["optimizers"]["camera_opt"]
    torch.save(state, path)
    config_file = ready.base_dir / "config.yml"
    config_file.write_text(config_file.read_text().replace("ebarf_ns.nerf.optimizers.", "ebarf_ns.nerf.trainer."))


def test_a_run_of_an_earlier_version_is_opened_and_gone_on_from(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    ready = trainer(config(tiny_scene, tmp_path, steps=3))
    ready.train()
    before = json.loads((ready.base_dir / "metrics.jsonl").read_text().splitlines()[-1])
    keyframes = read_tum(ready.base_dir / "trajectory_refined.txt")
    made_older(ready)
    _, pipeline, _, step = eval_setup(ready.base_dir / "config.yml", test_mode="test")
    said = " ".join(capsys.readouterr().out.split())
    assert step == 2 and "is of an earlier version" in said and "clock_px" in said
    refined: torch.Tensor = pipeline.trajectory(refined=True).poses.position  # pyright: ignore
    assert torch.allclose(refined, keyframes.poses.position, atol=1e-8)
    assert abs(pipeline.evaluate()["psnr"] - before["psnr"]) < 1e-4  # pyright: ignore
    again = config(tiny_scene, tmp_path, steps=5)
    again.load_dir = ready.checkpoint_dir
    trainer(again).train()
    assert json.loads((ready.base_dir / "metrics.jsonl").read_text().splitlines()[-1])["step"] == 5


def test_what_no_version_lacked_is_refused():
    fresh = {"_model.renderer.field.grid.table": torch.ones(3), "_model.camera_optimizer.hold": torch.zeros(())}
    with pytest.raises(TrainingError, match=r"it: lacks _model.renderer.field.grid.table, expected .* same flags"):
        completed({}, fresh, "it")
    with pytest.raises(TrainingError, match=r"it: holds _model.intrinsics.correction"):
        completed({**fresh, "_model.intrinsics.correction": torch.zeros(1, 3)}, fresh, "it")


def test_a_state_of_several_processes_is_one_of_this_version():
    fresh = {"_model.renderer.field.grid.table": torch.zeros(3), "cost": torch.zeros(2)}
    several = {"_model.module.renderer.field.grid.table": torch.ones(3), "cost": torch.ones(2)}
    state, added = completed(several, fresh, "it")
    assert not added and state["_model.renderer.field.grid.table"].equal(torch.ones(3)) and len(state) == 2
