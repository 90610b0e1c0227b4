"""A training that bad numbers end leaves a file, by which anybody finds where they begin."""

import json
import os
from pathlib import Path

import pytest
import torch

from ebarf_ns.errors import TrainingError
from ebarf_ns.nerf.replay import replay
from tests.conftest import run_command
from tests.nerf.test_training import config, trainer


def test_a_training_that_ends_by_a_broken_parameter_leaves_a_good_checkpoint_and_a_replay(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    made = config(tiny_scene, tmp_path, steps=50)
    made.steps_per_save = 2
    ready = trainer(made)
    followed = ready.averaging.follow

    def poisoned(steps_done: int) -> None:
        followed(steps_done)
        if steps_done == 5:
            with torch.no_grad():
                ready.pipeline.model.renderer.field.grid.table[:] = torch.nan

    monkeypatch.setattr(ready.averaging, "follow", poisoned)
    with pytest.raises(SystemExit) as stopped:
        ready.train()
    said = capsys.readouterr().err.splitlines()[-1]
    path = ready.base_dir / "replay-000000005.pt"
    assert stopped.value.code == 2 and said.startswith("error: parameters are no longer finite")
    assert f"ebarf replay {path}" in said and "step-000000002.ckpt resumes before it" in said
    finished = run_command("ebarf", "replay", path)
    assert finished.code == 0 and "parameters not finite: renderer.field.grid.table" in finished.output
    found = json.loads(run_command("ebarf", "replay", path, "--json").output)
    assert found["step"] == 5 and found["outputs_not_finite"][0] == "renderer.field.grid"
    assert "returned nan values" in found["anomaly"] and "ebarf_ns/" in found["anomaly"]
    assert "renderer.field.trunk.0.weight" in found["gradients_not_finite"]
    made.load_dir = ready.checkpoint_dir
    trainer(made).train()


def test_a_good_step_is_done_again_as_it_was(tiny_scene: Path, tmp_path: Path):
    from ebarf_ns.nerf.replay import write_replay

    ready = trainer(config(tiny_scene, tmp_path, steps=50))
    ready.pipeline.train()
    for step in range(3):
        ready.train_iteration(step)
    write_replay(tmp_path / "replay.pt", ready.pipeline, ready.optimizers.usual, 3)
    loss = float(ready.train_iteration(3)[1]["event_loss"].detach())
    found = replay(tmp_path / "replay.pt")
    # Up to the remembered density, which is brought up to date twice.
    assert found.losses["event_loss"] == pytest.approx(loss, rel=0.05)
    assert not found.anomaly and not found.gradients_not_finite and "are finite" in found.lines()[-1]


@pytest.mark.parametrize("what", ["nothing", "text", "checkpoint", "code", "newer"])
def test_a_file_that_is_no_replay_ends_in_one_line(tmp_path: Path, what: str):
    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "was here"),)

    path = tmp_path / "replay.pt"
    if what == "text":
        path.write_text("text")
    elif what != "nothing":
        torch.save({"checkpoint": {"step": 1}, "code": {"model": Evil()}, "newer": {"format": 9}}[what], path)
    with pytest.raises(TrainingError, match="replay.pt: .*(expected|damaged)"):
        replay(path)
    assert not (tmp_path / "was here").exists()
