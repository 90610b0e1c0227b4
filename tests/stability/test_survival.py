"""What a training survives, on real files, disks and processes: the table of docs/reliability.md, measured anew.

Run by ``pytest -m slow tests/stability/test_survival.py -s``; each test prints its line of the table. Fast versions of
all of them are among the ordinary tests.
"""

import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from ebarf_ns.errors import TrainingError
from ebarf_ns.nerf.checkpoints import checksum, newest_whole, read_checkpoint
from ebarf_ns.nerf.trainer import EbarfTrainer, EbarfTrainerConfig
from ebarf_ns.simulation.simulate import Simulation, simulate
from tests.conftest import REPOSITORY
from tests.nerf.test_training import config, same, state, trainer

pytestmark = pytest.mark.slow

SMALL = Simulation(width=24, height=18, focal_px=20.0, duration_s=0.4, frames=2, rays_per_pixel=4)
KILLS, DAMAGES, STEPS = 50, 40, 300
MANY_STEPS, MOST_GROWTH = 20_000, 0.02
EARLY, LATE = range(2000, 6001, 1000), range(16_000, MANY_STEPS + 1, 1000)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(SMALL, tmp_path_factory.mktemp("survival") / "scene").folder


@pytest.fixture(scope="module")
def undisturbed(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, torch.Tensor]:
    """Where a training ends that nothing happens to."""
    ready = trainer(saving(scene, tmp_path_factory.mktemp("undisturbed")))
    ready.train()
    return state(ready)


def saving(scene: Path, output: Path, steps: int = STEPS, every: int = 1) -> EbarfTrainerConfig:
    made = config(scene, output, steps=steps)
    made.steps_per_save = every
    return made


def resumed(made: EbarfTrainerConfig) -> EbarfTrainerConfig:
    folder = made.get_checkpoint_dir()
    made.load_dir = folder if any(folder.glob("step-*.ckpt")) else None
    return made


def say(line: str) -> None:
    sys.stderr.write(f"\n  {line}\n")


def train_and_tell(made: EbarfTrainerConfig, told: int) -> None:
    """Train in a forked process, with a byte written after each step."""
    code = 99
    try:
        ready = trainer(made)
        followed = ready.averaging.follow

        def follow(steps_done: int) -> None:
            followed(steps_done)
            os.write(told, b"!")

        ready.averaging.follow = follow
        ready.train()
        code = 0
    except SystemExit as stopped:
        code = stopped.code if isinstance(stopped.code, int) else 99
    finally:
        os._exit(code)


def disturb(scene: Path, output: Path, number: int, times: int) -> None:
    """Send a signal to one training after the other, a few steps after it has gone on; print what became of them.

    In a process that trains nothing itself: one that has run OpenMP may not be forked.
    """
    chance, codes, reached, damages = random.Random(number), [], [-1], 0
    while len(codes) < times and reached[-1] < STEPS - 20:
        began, told = os.pipe()
        child = os.fork()
        if child == 0:
            train_and_tell(resumed(saving(scene, output)), told)
        os.close(told)
        for _ in range(chance.randint(1, 8)):
            os.read(began, 1)
        time.sleep(chance.uniform(0.0, 0.1))
        os.kill(child, number)
        codes.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
        os.close(began)
        folder = saving(scene, output).get_checkpoint_dir()
        if any(folder.glob("step-*.ckpt")):
            path, damaged = newest_whole(folder)
            damages += len(damaged)
            reached.append(read_checkpoint(path)["step"])
    sys.stdout.write(json.dumps({"codes": codes, "reached": reached, "damages": damages}))


DISTURB = "import sys; from pathlib import Path; from tests.stability.test_survival import disturb; "
DISTURB += "disturb(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))"


@pytest.mark.parametrize(
    ("number", "code", "times"), [(signal.SIGKILL, -9, KILLS), (signal.SIGINT, 130, 10), (signal.SIGTERM, 143, 10)]
)
def test_signals_at_random_moments_lose_nothing(
    scene: Path, tmp_path: Path, undisturbed: dict[str, torch.Tensor], number: signal.Signals, code: int, times: int
):
    command = [sys.executable, "-c", DISTURB, scene, tmp_path, str(int(number)), str(times)]
    finished = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    found = json.loads(finished.stdout.splitlines()[-1])
    codes, reached = found["codes"], found["reached"]
    assert set(codes) == {code} and found["damages"] == 0
    assert reached == sorted(reached) and reached[-1] > len(codes) / 2
    ready = trainer(resumed(saving(scene, tmp_path)))
    ready.train()
    assert same(state(ready), undisturbed)
    run = ready.base_dir
    assert not [path for path in run.rglob(".*") if path.name != ".lock"]
    steps = [json.loads(line)["step"] for line in (run / "metrics.jsonl").read_text().splitlines()[1:]]
    assert steps[-1] == STEPS and STEPS // 2 in steps
    say(f"{len(codes)} times {number.name}, up to step {reached[-1]}: exit code {code}, no checkpoint damaged, ")
    say("the end is bitwise that of an undisturbed run")


FULL_DISK = """
import sys
from pathlib import Path
# A dependency may have left its own tests among the installed packages.
sys.path.insert(0, "REPOSITORY")
from tests.stability.test_survival import resumed, saving
from tests.nerf.test_training import trainer
made = resumed(saving(Path(sys.argv[1]), Path(sys.argv[2]), every=20))
trainer(made).train()
""".replace("REPOSITORY", str(REPOSITORY))


def in_namespace(script: str, *words: object) -> subprocess.CompletedProcess[str]:
    """Run a shell script that may mount what nobody else sees."""
    environment = {**os.environ, "PYTHON": sys.executable, "COLUMNS": "200"}
    command = ["unshare", "--mount", "sh", "-ec", script, "sh", *map(str, words)]
    return subprocess.run(command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=False)


def may_mount() -> bool:
    return bool(shutil.which("unshare")) and in_namespace("mount -t tmpfs tmpfs /mnt").returncode == 0


needs_mount = pytest.mark.skipif(not may_mount(), reason="mounting is not allowed here")


@needs_mount
def test_a_full_disk_leaves_the_checkpoint_before_and_training_goes_on_when_there_is_room(
    scene: Path, tmp_path: Path, undisturbed: dict[str, torch.Tensor]
):
    (tmp_path / "code.py").write_text(FULL_DISK)
    disk = tmp_path / "disk"
    disk.mkdir()
    script = """
        mount -t tmpfs -o size=$4k tmpfs "$1"
        $PYTHON "$3/code.py" "$2" "$1" >"$3/out" 2>"$3/full" && exit 7
        echo $? >"$3/code"
        find "$1" -name 'step-*.ckpt' -size +0 | sort >"$3/left"
        find "$1" -name '.*.*' >"$3/half"
        mount -o remount,size=100m "$1"
        $PYTHON "$3/code.py" "$2" "$1" >"$3/out2" 2>"$3/again"
        cp -r "$1/x" "$3/end"
    """
    for size_kib in (300, 500, 900):
        finished = in_namespace(script, disk, scene, tmp_path, size_kib)
        assert finished.returncode == 0, finished.stderr + (tmp_path / "again").read_text()
        # Tensorboard's own thread may complain as well.
        said = (tmp_path / "full").read_text()
        assert (tmp_path / "code").read_text() == "2\n"
        assert "error: " in said and ("No space left on device" in said or "room on the disk" in said)
        assert not (tmp_path / "half").read_text()
        end = read_checkpoint(max((tmp_path / "end").rglob("step-*.ckpt")))
        assert same({k: v for k, v in end["pipeline"].items() if k in undisturbed}, averaged(undisturbed, end))
        left = len((tmp_path / "left").read_text().splitlines())
        say(f"disk of {size_kib} KiB full: exit 2, {left} whole checkpoints left; {said.strip()[-120:]}")
        shutil.rmtree(tmp_path / "end")


def averaged(undisturbed: dict[str, torch.Tensor], end: dict) -> dict[str, torch.Tensor]:
    """A checkpoint's mean, once what was trained has been found to be as in the undisturbed run."""
    trained = [one for one in end["ebarf"]["trained"] if one.numel()]
    assert all(any(one.shape == known.shape and one.equal(known) for known in undisturbed.values()) for one in trained)
    return {k: v for k, v in end["pipeline"].items() if k in undisturbed}


@needs_mount
def test_a_folder_that_is_read_only_is_one_line(scene: Path, tmp_path: Path):
    (tmp_path / "code.py").write_text(FULL_DISK)
    disk = tmp_path / "disk"
    disk.mkdir()
    script = """
        mount -t tmpfs -o ro tmpfs "$1"
        $PYTHON "$3/code.py" "$2" "$1"
    """
    finished = in_namespace(script, disk, scene, tmp_path)
    said = finished.stderr.splitlines()[-1]
    assert finished.returncode == 2 and said.startswith("error: ") and "Read-only file system" in said
    say(f"read-only folder: exit 2; {said}")


def test_a_limit_to_sizes_of_files_is_a_full_disk(scene: Path, tmp_path: Path):
    (tmp_path / "code.py").write_text(FULL_DISK)

    def limited() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))

    finished = subprocess.run(
        [sys.executable, tmp_path / "code.py", scene, tmp_path],
        cwd=REPOSITORY, capture_output=True, text=True, check=False, preexec_fn=limited,
    )  # fmt: skip
    said = finished.stderr.splitlines()[-1]
    assert finished.returncode == 2 and said.startswith("error: ") and "Traceback" not in finished.stderr
    assert not list((tmp_path / "x").rglob("step-*.ckpt"))
    say(f"files of at most 60 kB: exit 2; {said[-150:]}")


def test_damaged_checkpoints_are_noticed(scene: Path, tmp_path: Path):
    ready = trainer(saving(scene, tmp_path, steps=4))
    ready.train()
    older, newest = sorted(ready.checkpoint_dir.iterdir())
    whole, chance = newest.read_bytes(), np.random.default_rng(0)
    content = checksum(read_checkpoint(newest))
    noticed = harmless = cut = 0
    for place in chance.integers(0, len(whole), DAMAGES):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(chance.integers(8))
        newest.write_bytes(damaged)
        found, wrong = newest_whole(newest.parent)
        noticed += found == older and len(wrong) == 1
        # Of what fills a zip file up, nothing depends.
        harmless += found == newest and checksum(read_checkpoint(newest)) == content
    for length in chance.integers(0, len(whole), DAMAGES):
        newest.write_bytes(whole[:length])
        cut += newest_whole(newest.parent)[0] == older
    assert noticed + harmless == DAMAGES and cut == DAMAGES and noticed >= 0.9 * DAMAGES
    say(f"one bit flipped: {noticed} of {DAMAGES} noticed, {harmless} in what fills the file up")
    say(f"cut off: {cut} of {DAMAGES} noticed")


def break_loss(ready: EbarfTrainer) -> Callable[[], None]:
    model = ready.pipeline.model
    good = model.get_loss_dict
    model.get_loss_dict = lambda *of: {k: v * float("nan") for k, v in good(*of).items()}  # pyright: ignore
    return lambda: setattr(model, "get_loss_dict", good)


def break_gradient(parameter: torch.Tensor) -> Callable[[], None]:
    return parameter.register_hook(lambda gradient: gradient * float("nan")).remove


@pytest.mark.parametrize("where", ["loss", "field gradient", "pose gradient", "parameters"])
def test_bad_numbers_end_a_run_with_a_good_checkpoint_from_which_it_goes_on(
    scene: Path, tmp_path: Path, undisturbed: dict[str, torch.Tensor], where: str
):
    ready = trainer(saving(scene, tmp_path, every=35))
    model, followed = ready.pipeline.model, ready.averaging.follow

    def then(steps_done: int) -> None:
        followed(steps_done)
        if steps_done == 40:
            if where == "loss":
                break_loss(ready)
            elif where == "parameters":
                with torch.no_grad():
                    ready.averaging.parameters[0].view(-1)[7] = torch.nan
            else:
                keyframes, table = model.camera_optimizer.correction, model.renderer.field.grid.table
                break_gradient(keyframes.requires_grad_() if where == "pose gradient" else table)

    ready.averaging.follow = then
    with pytest.raises(SystemExit) as stopped:
        ready.train()
    assert stopped.value.code == 2
    _, damaged = newest_whole(ready.checkpoint_dir)
    (replay,) = ready.base_dir.glob("replay-*.pt")
    assert not damaged
    # Gone on from before anything was broken, it is as if nothing had been.
    made = saving(scene, tmp_path / "again")
    made.load_checkpoint = min(ready.checkpoint_dir.iterdir())
    again = trainer(made)
    again.train()
    assert same(state(again), undisturbed)
    skipped = ready.optimizers.skipped
    say(f"NaN in {where}: {skipped} steps skipped, {replay.name}; gone on from before, the end is as undisturbed")


def test_another_scene_is_refused(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    changed = shutil.copytree(scene, tmp_path / "scene")
    trainer(saving(changed, tmp_path, steps=4)).train()
    with h5py.File(changed / "events.h5", "r+") as file:
        file["events/t"][-1] += 1  # pyright: ignore
    with pytest.raises(SystemExit) as stopped:
        trainer(resumed(saving(changed, tmp_path, steps=6)))
    said = capsys.readouterr().err.splitlines()[-1]
    assert stopped.value.code == 2 and "recording changed since" in said
    say(f"one event's time changed: exit 2; {said[:120]}")


TWO = """
import sys
from pathlib import Path
from tests.stability.test_survival import saving
from tests.nerf.test_training import trainer
trainer(saving(Path(sys.argv[1]), Path(sys.argv[2]))).train()
"""


def test_of_two_trainings_in_one_folder_one_ends_at_once(scene: Path, tmp_path: Path, undisturbed: dict):
    command = [sys.executable, "-c", TWO, scene, tmp_path]
    both = [
        subprocess.Popen(command, cwd=REPOSITORY, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
        for _ in range(2)
    ]
    said = [one.communicate()[1].splitlines()[-1:] for one in both]
    assert sorted(one.returncode for one in both) == [0, 2]
    (loser,) = [words[0] for one, words in zip(both, said, strict=True) if one.returncode == 2]
    assert "another training writes there" in loser or "holds a run" in loser
    end = read_checkpoint(max((tmp_path / "x").rglob("step-*.ckpt")))
    assert end["step"] == STEPS - 1 and averaged(undisturbed, end)
    say(f"two trainings in one folder: exit 0 and 2; {loser[:100]}")


def resident_mib() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20


def test_memory_stays_flat_over_twenty_thousand_steps(scene: Path, tmp_path: Path):
    made = saving(scene, tmp_path, steps=MANY_STEPS, every=1000)
    made.evaluations = MANY_STEPS // 1000
    ready = trainer(made)
    followed, resident = ready.averaging.follow, {}

    def then(steps_done: int) -> None:
        followed(steps_done)
        if steps_done % 1000 == 0:
            resident[steps_done] = resident_mib()

    ready.averaging.follow = then
    ready.train()
    # The allocator gives memory back now and then, so single values vary by 2 % without any growth.
    early, late = (float(np.median([resident[step] for step in steps])) for steps in (EARLY, LATE))
    growth = late / early - 1
    say(f"{early:.1f} MiB at 2,000 to 6,000 steps, {late:.1f} at 16,000 to {MANY_STEPS} ({growth:+.2%})")
    say("every 1,000 steps: " + " ".join(f"{mib:.0f}" for mib in resident.values()))
    assert growth <= MOST_GROWTH
    assert ready.optimizers.skipped == 0


def test_nothing_of_this_waits_for_ever(tmp_path: Path):
    os.mkfifo(tmp_path / "step-000000001.ckpt")
    with pytest.raises(TrainingError):
        newest_whole(tmp_path)
