"""The first word of the ebarf command, and ebarf train."""

import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from ebarf_ns.cli import train_command
from ebarf_ns.cli.entry import COMMANDS
from ebarf_ns.cli.main import entrypoint as commands
from tests.conftest import TINY_TRAINING, run_command, run_ok

ENTRY = "from ebarf_ns.cli.entry import entrypoint; entrypoint()"


def test_help_needs_no_library():
    heavy = "torch numpy scipy cv2 rich tyro nerfstudio".split()
    script = (
        f"import sys; sys.argv[1:] = ['--help']; {ENTRY}; sys.exit([one for one in {heavy} if one in sys.modules] or 0)"
    )
    finished = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stderr
    first = finished.stdout.split("\n\n")[1]
    assert first.startswith("Train a NeRF on the events of a moving event camera")
    assert re.findall(r"^  ebarf (\w+)", finished.stdout, re.M) == ["process", "inspect", "train"]


def test_no_word_is_a_question_for_help():
    assert run_ok("ebarf") == run_ok("ebarf", "--help")


def test_all_commands_are_listed_and_no_others(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(sys, "argv", ["ebarf", "--help"])
    with pytest.raises(SystemExit):
        commands()
    (listed,) = re.findall(r"\{([\w,-]+)\}", "".join(capsys.readouterr().out.split()))[:1]
    assert {*listed.split(","), "train"} == set(COMMANDS)
    for name in COMMANDS:
        assert "usage" in run_ok("ebarf", name, "--help").lower()


def test_a_command_that_is_none_is_one_line():
    finished = run_command("ebarf", "inspekt")
    assert finished.code == 2 and finished.errors.count("\n") == 1
    assert finished.errors.startswith("error: inspekt is no command") and finished.errors.endswith("mean inspect?\n")


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The words that an ns-train with exit code 7 was started with."""
    words: list[list[str]] = []
    ns_train = SimpleNamespace(load=lambda: lambda: words.append(list(sys.argv)) or 7)
    monkeypatch.setattr(train_command, "entry_points", lambda **_: (ns_train,))
    return words


def test_train_hands_all_flags_on_and_the_code_back(tiny_scene: Path, started: list[list[str]]):
    finished = run_command("ebarf", "train", tiny_scene, "--max-train-seconds", 5, "--vis=tensorboard")
    command = ["ns-train", "ebarf", "--data", str(tiny_scene), "--max-train-seconds", "5", "--vis=tensorboard"]
    assert started == [command] and finished.code == 7
    assert finished.errors == " ".join(command) + "\n"


def test_a_scene_that_cannot_be_trained_on_is_told_before_nerfstudio_starts(
    tiny_scene: Path, tmp_path: Path, started: list[list[str]]
):
    other_clock = shutil.copytree(tiny_scene, tmp_path / "other clock")
    lines = [line for line in (other_clock / "trajectory.txt").read_text().splitlines() if not line.startswith("#")]
    (other_clock / "trajectory.txt").write_text("\n".join(f"7{line}" for line in lines))
    (tmp_path / "recording.raw").touch()
    for words, expected in (
        ([], "no scene named"),
        (["--vis", "viewer"], "no scene named"),
        ([tmp_path / "other clok"], f"did you mean {other_clock}?"),
        ([other_clock], "none of the events"),
        ([tmp_path / "recording.raw"], "ebarf process auto"),
    ):
        finished = run_command("ebarf", "train", *words)
        assert finished.code == 2 and expected in finished.errors and not started


@pytest.mark.slow
def test_train_trains(tiny_scene: Path, tmp_path: Path):
    words = ["train", tiny_scene, "--output-dir", tmp_path / "müde runs", "--vis=tensorboard", *TINY_TRAINING]
    command = [sys.executable, "-c", ENTRY, *map(str, words)]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stderr[-2000:]
    (report,) = (tmp_path / "müde runs").rglob("report.html")
    assert report.stat().st_size > 10_000
