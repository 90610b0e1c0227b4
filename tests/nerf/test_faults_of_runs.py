"""Faults around a run that must cost nothing: refused resumes, foreign files in its folder, outputs that end."""

import errno
import json
import os
import shutil
import signal
import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import pytest
import torch

from ebarf_ns.errors import EvaluationError, TrainingError
from ebarf_ns.nerf.checkpoints import newest_whole, read_checkpoint, read_plain, write_checkpoint, write_plain
from ebarf_ns.nerf.finished_run import open_run
from ebarf_ns.nerf.signals import output_may_end, signals_to
from tests.nerf.test_checkpoints import some_state, step_path
from tests.nerf.test_training import config, trainer


@pytest.fixture(scope="module")
def finished(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = config(tiny_scene, tmp_path_factory.mktemp("finished"), steps=4)
    made.steps_per_save = 2
    ready = trainer(made)
    ready.train()
    return ready.base_dir


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    return shutil.copytree(finished, tmp_path / "x" / "ebarf" / "run")


def content_of(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != ".lock"}


def test_a_refused_resume_leaves_the_run_as_it_was(
    run: Path, tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    before = content_of(run)
    made = config(tiny_scene, tmp_path, steps=8)
    made.load_dir = run / "nerfstudio_models"
    made.pipeline.model.grid_levels = 3  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(SystemExit) as stopped:
        trainer(made)
    assert stopped.value.code == 2 and "cannot go on from it" in capsys.readouterr().err
    assert content_of(run) == before and open_run(run).scene


def test_a_run_is_not_given_up_for_one_that_cannot_begin(run: Path, tmp_path: Path):
    before = content_of(run)
    made = config(tmp_path / "no such scene", tmp_path)
    made.overwrite = True
    with pytest.raises(SystemExit) as stopped:
        trainer(made)
    assert stopped.value.code == 2 and content_of(run) == before


def test_a_checkpoint_of_a_newer_version_is_no_damaged_one(
    run: Path, tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    *_, newest = sorted((run / "nerfstudio_models").iterdir())
    write_plain({**torch.load(newest, weights_only=True), "format": 99}, newest)
    before = content_of(run)
    made = config(tiny_scene, tmp_path, steps=8)
    made.load_dir = run / "nerfstudio_models"
    with pytest.raises(SystemExit) as stopped:
        trainer(made)
    assert stopped.value.code == 2 and "is of format 99, expected at most 1" in capsys.readouterr().err
    assert content_of(run) == before


def test_a_checkpoint_that_the_disk_does_not_give_is_no_damaged_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for step in (1, 2):
        write_checkpoint(some_state(step), step_path(tmp_path, step))

    def broken(*_: Any, **__: Any) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(torch, "load", broken)
    with pytest.raises(TrainingError, match=r"step-000000002.ckpt: cannot be read \(Input/output error\)"):
        newest_whole(step_path(tmp_path, 1).parent)


def test_what_else_lies_beside_checkpoints_stays_and_is_not_taken(run: Path, tiny_scene: Path, tmp_path: Path):
    folder = run / "nerfstudio_models"
    *_, newest = sorted(folder.iterdir())
    copy = Path(shutil.copy(newest, folder / "step-000000003 (copy).ckpt"))
    (folder / "notes.txt").write_text("mine")
    (folder / "step-000000099.ckpt").mkdir()
    made = config(tiny_scene, tmp_path, steps=6)
    made.load_dir = folder
    ready = trainer(made)
    ready.train()
    from nerfstudio.utils.eval_utils import eval_setup

    assert eval_setup(ready.base_dir / "config.yml", test_mode="test")[2].name == "step-000000005.ckpt"
    assert copy.is_file() and (folder / "notes.txt").is_file() and newest_whole(folder)[0].name == "step-000000005.ckpt"


def test_a_scene_that_vanishes_costs_no_step(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    ready = trainer(config(scene, tmp_path, steps=10))
    step_done = ready.averaging.follow

    def unplugged(steps_done: int) -> None:
        step_done(steps_done)
        if steps_done == 4:
            shutil.rmtree(scene)

    monkeypatch.setattr(ready.averaging, "follow", unplugged)
    with pytest.raises(SystemExit) as stopped:
        ready.train()
    assert stopped.value.code == 2 and "error: " in capsys.readouterr().err
    assert read_checkpoint(ready.checkpoint_dir / "step-000000004.ckpt")["step"] == 4


@pytest.mark.parametrize("cut", [30, 3])
def test_a_record_that_is_cut_off_is_made_anew(
    run: Path, tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], cut: int
):
    path = run / "metrics.jsonl"
    whole = path.read_bytes()
    path.write_bytes(whole[:-cut])
    made = config(tiny_scene, tmp_path, steps=6)
    made.load_dir = run / "nerfstudio_models"
    trainer(made).train()
    assert "metrics.jsonl:3: is cut off" in capsys.readouterr().err
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert lines[0] == json.loads(whole.splitlines()[0]) and [line["step"] for line in lines[1:]] == [2, 6]


@pytest.mark.parametrize("content", ["{", "[1]", "3"])
def test_records_without_a_header_are_one_line(
    run: Path, tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str
):
    (run / "metrics.jsonl").write_text(content)
    made = config(tiny_scene, tmp_path, steps=6)
    made.load_dir = run / "nerfstudio_models"
    with pytest.raises(SystemExit) as stopped:
        trainer(made)
    assert stopped.value.code == 2 and "expected the header of a run" in capsys.readouterr().err


@pytest.mark.parametrize(
    "hostile",
    [
        {"format": "x"},
        {"pipeline": {"x": torch.zeros(1).expand(10**7, 10**7)}},
        {"pipeline": {"x": torch.zeros(3, 3).to_sparse()}},
        {"pipeline": {"x": torch.zeros(3, device="meta")}},
        {"optimizers": {"fields": [torch.zeros(1).expand(10**6, 10**6)]}},
    ],
    ids=["format", "expanded", "sparse", "meta", "nested"],
)
def test_checkpoints_that_are_more_than_they_seem_are_one_line(hostile: dict, tmp_path: Path):
    path = tmp_path / "step-1.ckpt"
    torch.save({**some_state(1), **hostile}, path)
    with pytest.raises(TrainingError, match="expected a") as error:
        read_checkpoint(path)
    assert "\n" not in str(error.value)
    with pytest.raises(TrainingError, match="expected a"):
        read_plain(path, "replay file")


def test_a_checksum_that_is_none_is_damage(run: Path, capsys: pytest.CaptureFixture[str]):
    path = sorted((run / "nerfstudio_models").iterdir())[-1]
    state = torch.load(path, weights_only=True)
    state["pipeline"]["checksum"] = torch.zeros(2)
    del state["checksum"]
    write_plain(state, path)
    with pytest.raises(SystemExit) as stopped:
        open_run(run)
    assert stopped.value.code == 2 and "its checksum is not that of its content" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("grid_levels: 4", "grid_levels: [a]"),
        ("grid_levels: 4", "grid_levels: 5"),
        ("grid_table_size_log2: 10\n", "grid_table_size_log2: 60\n"),
        ("  datamanager: ", "  datamanager: hello\n  other: "),
        ("ebarf_ns.nerf.viewer_panel.ViewedPipeline", "ebarf_ns.nerf.trainer.EbarfTrainer"),
    ],
)
def test_a_configuration_of_something_else_is_one_line(run: Path, old: str, new: str):
    said = (run / "config.yml").read_text()
    assert old in said
    (run / "config.yml").write_text(said.replace(old, new))
    with pytest.raises(EvaluationError, match="expected") as error:
        open_run(run)
    assert "\n" not in str(error.value)


def test_a_configuration_of_one_line_is_none(run: Path):
    for content in ("!!python/object:ebarf_ns.nerf.trainer_config.EbarfTrainerConfig {method_name: x}", "pipeline: 3"):
        (run / "config.yml").write_text(content)
        with pytest.raises(EvaluationError):
            open_run(run)


def test_who_opens_a_run_past_a_damaged_checkpoint_says_so(run: Path, capsys: pytest.CaptureFixture[str]):
    older, newest = sorted((run / "nerfstudio_models").iterdir())
    newest.write_bytes(newest.read_bytes()[:-100])
    open_run(run)
    said = capsys.readouterr().err
    assert f"{newest}: is damaged" in said and f"{older.name} is used instead" in said


def test_output_that_nobody_takes_any_more_ends_nothing():
    read, write = os.pipe()
    with os.fdopen(write, "w") as stream:
        os.close(read)
        with redirect_stdout(stream), output_may_end():
            for _ in range(3):
                print("still training", flush=True)
            assert not sys.stdout.isatty()


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no such signal here")
def test_a_hang_up_is_heard_unless_it_was_to_be_ignored():
    heard = []
    # This process may have been begun by nohup.
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        with signals_to(heard.append):
            os.kill(os.getpid(), signal.SIGHUP)
        assert heard == [signal.SIGHUP]
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        with signals_to(heard.append):
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert heard == [signal.SIGHUP]


def test_paths_that_cannot_be_printed_are_one_line(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    with pytest.raises(SystemExit) as stopped:
        config(tiny_scene, tmp_path / "o[/x]").save_config()
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and "o[/x]" in said and said.count("\n") == 1
    trainer(config(tiny_scene, tmp_path / "o[b]", steps=2)).train()
    assert "o[b]/x/ebarf/run/report" in "".join(capsys.readouterr().out.split())
