"""What a run leaves on disk, whatever happens to it."""

import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch

from ebarf_ns.errors import TrainingError
from ebarf_ns.nerf.checkpoints import checksum, newest_whole, read_checkpoint, sealed, unsealed, write_checkpoint
from ebarf_ns.nerf.run_folder import remove_checkpoints, take_folder
from tests.nerf.test_training import config, trainer


def some_state(step: int, seed: int = 0) -> dict:
    random = torch.Generator().manual_seed(seed)
    table = torch.randn(2000, 4, generator=random)
    halves = torch.randn(50, generator=random).bfloat16()
    optimizer = {"state": {0: {"step": 3, "mean": table * 0.1}}, "param_groups": [{"lr": 0.01, "betas": (0.9, 0.99)}]}
    return {"step": step, "pipeline": {"table": table, "halves": halves}, "optimizers": {"fields": optimizer}}


def step_path(folder: Path, step: int) -> Path:
    return folder / "nerfstudio_models" / f"step-{step:09d}.ckpt"


def test_the_last_two_are_kept_and_are_what_was_written(tmp_path: Path):
    for step in (5, 20, 100):
        write_checkpoint(some_state(step, step), step_path(tmp_path, step))
    folder = step_path(tmp_path, 0).parent
    assert sorted(folder.iterdir()) == [step_path(tmp_path, 20), step_path(tmp_path, 100)]
    found = read_checkpoint(step_path(tmp_path, 100))
    assert unsealed(found["pipeline"], "it")["table"].equal(some_state(100, 100)["pipeline"]["table"])
    assert found["optimizers"] is not None and newest_whole(folder) == (step_path(tmp_path, 100), [])


def test_what_a_training_left_behind_that_goes_on_from_before_it_goes(tmp_path: Path):
    for step in (5, 20, 100, 50):
        write_checkpoint(some_state(step, step), step_path(tmp_path, step))
    assert sorted(step_path(tmp_path, 0).parent.iterdir()) == [step_path(tmp_path, 20), step_path(tmp_path, 50)]


def test_a_flipped_bit_is_noticed_wherever_it_matters_and_the_checkpoint_before_is_taken(tmp_path: Path):
    for step in (1, 2):
        write_checkpoint(some_state(step), step_path(tmp_path, step))
    path, random = step_path(tmp_path, 2), np.random.default_rng(0)
    whole, content = path.read_bytes(), checksum(read_checkpoint(path))
    noticed = 0
    for place in random.integers(0, len(whole), 40):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(random.integers(8))
        path.write_bytes(damaged)
        try:
            # A zip file has bytes that mean nothing: dates, and what fills it up.
            assert checksum(read_checkpoint(path)) == content
        except TrainingError as error:
            noticed += 1
            assert str(path) in str(error)
            found, wrong = newest_whole(path.parent)
            assert found == step_path(tmp_path, 1) and len(wrong) == 1
    assert noticed >= 35


@pytest.mark.parametrize("left", [0, 1, 1000, -1])
def test_a_cut_off_checkpoint_is_passed_over(tmp_path: Path, left: int):
    for step in (1, 2):
        write_checkpoint(some_state(step), step_path(tmp_path, step))
    path = step_path(tmp_path, 2)
    path.write_bytes(path.read_bytes()[:left])
    assert newest_whole(path.parent)[0] == step_path(tmp_path, 1)


def test_what_nerfstudio_reads_alone_has_its_own_checksum():
    pipeline = sealed(some_state(1)["pipeline"])
    assert "checksum" not in unsealed(pipeline, "it")
    pipeline["table"][3, 1] += 1e-6
    with pytest.raises(TrainingError, match="it: is damaged"):
        unsealed(pipeline, "it")
    poisoned = {"table": torch.tensor([1.0, torch.nan])}
    with pytest.raises(TrainingError, match="not finite, in table"):
        unsealed(sealed(poisoned), "it")


def test_older_formats_are_read_and_newer_ones_refused(tmp_path: Path):
    torch.save(some_state(1), tmp_path / "step-1.ckpt")
    assert read_checkpoint(tmp_path / "step-1.ckpt")["step"] == 1
    torch.save({**some_state(1), "format": 99}, tmp_path / "step-1.ckpt")
    with pytest.raises(TrainingError, match="is of format 99, expected at most"):
        read_checkpoint(tmp_path / "step-1.ckpt")


def test_no_code_is_run_from_a_checkpoint(tmp_path: Path):
    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "was here"),)

    torch.save({**some_state(1), "evil": Evil()}, tmp_path / "step-1.ckpt")
    with pytest.raises(TrainingError, match="is damaged, or no checkpoint"):
        read_checkpoint(tmp_path / "step-1.ckpt")
    assert not (tmp_path / "was here").exists()


def test_a_full_disk_leaves_what_was_there_and_is_said_in_one_line(tmp_path: Path):
    resource = pytest.importorskip("resource")
    write_checkpoint(some_state(1), step_path(tmp_path, 1))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        # A limit to files' sizes looks like a full disk to whoever writes.
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))
        with pytest.raises(TrainingError, match="cannot be written.*; expected room on the disk") as failed:
            write_checkpoint(some_state(2), step_path(tmp_path, 2))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, handler)
    assert "step-000000002.ckpt" in str(failed.value)
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["step-000000001.ckpt"]
    assert read_checkpoint(step_path(tmp_path, 1))["step"] == 1


def test_a_folder_that_cannot_be_written_is_one_line(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit) as stopped:
        trainer(config(tiny_scene, tmp_path / "file" / "runs"))
    said = capsys.readouterr().err.splitlines()[-1]
    assert stopped.value.code == 2 and said.startswith("error: ") and said.endswith("Not a directory")


def test_a_folder_has_one_writer_and_loses_what_a_killed_one_left_half_written(tmp_path: Path):
    first = take_folder(tmp_path, goes_on=False, overwrite=False)
    with pytest.raises(TrainingError, match="another training writes there"):
        take_folder(tmp_path, goes_on=False, overwrite=True)
    first.release()
    write_checkpoint(some_state(1), step_path(tmp_path, 1))
    (tmp_path / ".step-000000009.a1b2c3_d.ckpt").write_text("half")
    (tmp_path / "step-000000009.ckpt").write_text("not yet in its folder")
    (tmp_path / ".scene.a1b2c3_d").mkdir()
    (tmp_path / "config.yml").write_text("kept")
    with pytest.raises(TrainingError, match="holds a run, up to step-000000001.ckpt"):
        take_folder(tmp_path, goes_on=False, overwrite=False)
    take_folder(tmp_path, goes_on=True, overwrite=False).release()
    assert sorted(p.name for p in tmp_path.iterdir()) == [".lock", "config.yml", "nerfstudio_models"]
    take_folder(tmp_path, goes_on=False, overwrite=True).release()
    assert step_path(tmp_path, 1).is_file()
    remove_checkpoints(tmp_path)
    assert not list(step_path(tmp_path, 1).parent.iterdir())


@pytest.mark.parametrize("phase", ["plan", "compile", "alignment", "evaluation", "saving", "report"])
def test_a_signal_in_any_phase_ends_a_run_in_order(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, phase: str
):
    from ebarf_ns.nerf import trainer as room

    def interrupted(place: object, name: str) -> None:
        done = getattr(place, name)

        def then(*of: Any, **named: Any) -> Any:
            monkeypatch.setattr(place, name, done)
            os.kill(os.getpid(), signal.SIGTERM)
            return done(*of, **named)

        monkeypatch.setattr(place, name, then)

    place, name = {
        "plan": (room, "plan_run"),
        "compile": (room.EbarfPipeline, "get_train_loss_dict"),
        "alignment": (room, "align"),
        "evaluation": (room.EbarfPipeline, "evaluate"),
        "saving": (room, "write_checkpoint"),
        "report": (room, "write_report"),
    }[phase]
    interrupted(place, name)
    made = config(tiny_scene, tmp_path, steps=30)
    made.pipeline.model.camera_optimizer.align_steps = 10  # pyright: ignore[reportAttributeAccessIssue]
    handlers = [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(SystemExit) as stopped:
        trainer(made).train()
    assert stopped.value.code == 143
    assert [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)] == handlers
    checkpoints = sorted(made.get_checkpoint_dir().glob("step-*.ckpt"))
    assert bool(checkpoints) == (phase not in ("plan", "alignment"))
    monkeypatch.undo()
    again = config(tiny_scene, tmp_path, steps=31)
    again.load_dir = made.get_checkpoint_dir() if checkpoints else None
    trainer(again).train()
    assert json.loads((tmp_path / "x/ebarf/run/metrics.jsonl").read_text().splitlines()[-1])["step"] == 31


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_signal_ends_a_run_whole(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, code: int
):
    ready = trainer(config(tiny_scene, tmp_path, steps=1000))
    step_done = ready.averaging.follow

    def interrupted(steps_done: int) -> None:
        step_done(steps_done)
        if steps_done == 3:
            os.kill(os.getpid(), number)

    monkeypatch.setattr(ready.averaging, "follow", interrupted)
    before = signal.getsignal(number)
    if before == signal.SIG_IGN:
        pytest.skip("this process is to ignore the signal, as nohup has it")
    with pytest.raises(SystemExit) as stopped:
        ready.train()
    assert stopped.value.code == code and signal.getsignal(number) == before
    assert read_checkpoint(ready.checkpoint_dir / "step-000000002.ckpt")["step"] == 2
    assert json.loads((ready.base_dir / "metrics.jsonl").read_text().splitlines()[-1])["step"] == 3
    assert (ready.base_dir / "trajectory_refined.txt").is_file()
    assert (ready.base_dir / "report" / "report.html").is_file()
    again = config(tiny_scene, tmp_path, steps=5)
    again.load_dir = ready.checkpoint_dir
    trainer(again).train()
    assert json.loads((ready.base_dir / "metrics.jsonl").read_text().splitlines()[-1])["step"] == 5


def test_a_run_knows_its_scene(tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    first = trainer(config(scene, tmp_path, steps=2))
    first.train()
    with (scene / "trajectory.txt").open("a") as file:
        file.write("# another one\n")
    again = config(scene, tmp_path, steps=3)
    again.load_dir = first.checkpoint_dir
    with pytest.raises(SystemExit) as stopped:
        trainer(again)
    assert stopped.value.code == 2 and "trajectory changed since" in capsys.readouterr().err
    again.allow_changed_scene = True
    trainer(again).train()
    headers = []
    for name in ("one", "two"):
        ready = trainer(config(scene, tmp_path / name, steps=1))
        ready.train()
        headers.append(json.loads((ready.base_dir / "metrics.jsonl").read_text().splitlines()[0]))
    assert headers[0]["config_digest"] == headers[1]["config_digest"]
    assert headers[0]["scene_digest"] == headers[1]["scene_digest"] and len(headers[0]["scene_digest"]) == 3


def test_a_script_that_opens_a_run_takes_the_newest_whole_checkpoint_and_says_what_changed(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    from nerfstudio.utils.eval_utils import eval_setup

    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    made = config(scene, tmp_path, steps=4)
    made.steps_per_save = 2
    ready = trainer(made)
    ready.train()
    older, newest = sorted(ready.checkpoint_dir.iterdir())
    content = bytearray(newest.read_bytes())
    content[len(content) // 2] ^= 1
    newest.write_bytes(content)
    with h5py.File(scene / "events.h5", "r+") as file:
        file["events/p"][:10] = 1 - file["events/p"][:10]  # pyright: ignore
    _, pipeline, path, step = eval_setup(ready.base_dir / "config.yml", test_mode="test")
    assert path == older and step == 2
    found = capsys.readouterr()
    assert f"{newest.name}:isdamaged" in "".join(found.out.split())
    assert f"{scene}: recording changed since" in found.err
    older.write_bytes(b"")
    with pytest.raises(SystemExit) as stopped:
        eval_setup(ready.base_dir / "config.yml", test_mode="test")
    assert stopped.value.code == 2 and newest.name in capsys.readouterr().err


def test_a_second_training_leaves_the_first_ones_folder_as_it_is(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    first = trainer(config(tiny_scene, tmp_path, steps=3))
    before = {path: path.read_bytes() for path in first.base_dir.rglob("*") if path.is_file()}
    second = config(tiny_scene, tmp_path, steps=3)
    second.save_config()
    with pytest.raises(SystemExit) as stopped:
        trainer(second)
    assert stopped.value.code == 2 and "another training writes there" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in first.base_dir.rglob("*") if path.is_file()} == before
    first.train()


def test_a_parameter_that_is_not_finite_is_never_saved(tiny_scene: Path, tmp_path: Path):
    ready = trainer(config(tiny_scene, tmp_path, steps=2))
    ready.train()
    before = {path: path.read_bytes() for path in ready.checkpoint_dir.iterdir()}
    ready.steps_done = 3
    with torch.no_grad():
        ready.averaging.parameters[0].view(-1)[0] = torch.nan
    ready.averaging.mean = None
    ready.save_checkpoint(2)
    assert {path: path.read_bytes() for path in ready.checkpoint_dir.iterdir()} == before
