"""Scenes and runs that tests share: made once a session, by the commands that users type."""

import io
import os
import socket
import subprocess
import sys
import time
import urllib.request
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import settings

from ebarf_ns.cli.entry import entrypoint
from tests import prepared

# Before torch is loaded, here and in the commands that tests run: several processes share the cores, and threads that
# spin while they wait for one another make steps twenty times as long.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

# How long an example takes says more of what else the machine does than of the code.
settings.register_profile("ebarf", deadline=None)
settings.load_profile("ebarf")

REPOSITORY = Path(__file__).parent.parent
DATA = Path(os.environ.get("EBARF_TEST_DATA", REPOSITORY.parent / "shared" / "data"))
TINY_TRAINING = [
    "--max-num-iterations=80",
    "--evaluations=2",
    "--pipeline.datamanager.train-num-rays-per-batch=512",
    "--pipeline.model.samples=24",
    "--pipeline.model.grid-table-size-log2=12",
    "--pipeline.model.grid-finest=64",
    "--pipeline.model.density-cells=32",
]


@dataclass(frozen=True)
class Finished:
    """What a command left behind."""

    code: int
    output: str
    errors: str


def run_command(*words: object, timeout_s: float = 300, cwd: Path | None = None) -> Finished:
    """Run a console script of this environment, as a user would; ebarf without a folder of its own in this process."""
    name, *arguments = map(str, words)
    if name == "ebarf" and cwd is None:
        return _run_ebarf(arguments)
    script = Path(sys.executable).parent / name
    environment = {**os.environ, "COLUMNS": "200", "PATH": f"{script.parent}{os.pathsep}{os.environ['PATH']}"}
    if prepared.AVAILABLE:
        return Finished(*prepared.run_script(name, arguments, cwd, environment, timeout_s))
    finished = subprocess.run(
        [script, *arguments], capture_output=True, text=True, timeout=timeout_s, cwd=cwd, env=environment, check=False
    )
    return Finished(finished.returncode, finished.stdout, finished.stderr)


def _run_ebarf(arguments: list[str]) -> Finished:
    """The ebarf command without the seconds that its imports take."""
    output, errors = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(output), redirect_stderr(errors):
        patch.setattr(sys, "argv", ["ebarf", *arguments])
        patch.setenv("COLUMNS", "200")
        try:
            entrypoint()
        except SystemExit as stopped:
            code = stopped.code if isinstance(stopped.code, int) else 0
        else:
            code = 0
    return Finished(code, output.getvalue(), errors.getvalue())


def run_ok(*words: object, timeout_s: float = 300, cwd: Path | None = None) -> str:
    """Run a command that must succeed, and return its standard output."""
    finished = run_command(*words, timeout_s=timeout_s, cwd=cwd)
    assert finished.code == 0, f"{words}\n{finished.output[-3000:]}\n{finished.errors[-3000:]}"
    return finished.output


def wait_for_page(address: str, process: subprocess.Popen, patience_s: float = 120) -> str:
    """What is served there, as soon as it is."""
    end = time.monotonic() + patience_s
    while time.monotonic() < end:
        assert process.poll() is None, process.stdout.read().decode() if process.stdout else ""
        try:
            with urllib.request.urlopen(address, timeout=5) as answer:
                return answer.read().decode(errors="replace")
        except OSError:
            time.sleep(1)
    raise AssertionError(f"{address} did not answer in {patience_s} s")


def free_port() -> int:
    """One that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a second of a simulated room at 48x36."""
    folder = tmp_path_factory.mktemp("scenes") / "tiny"
    run_ok(
        "ebarf", "simulate", folder, "--width=48", "--height=36", "--focal-px=41", "--duration-s=0.5", "--frames=3",
        cwd=folder.parent,
    )  # fmt: skip
    return folder


@pytest.fixture(scope="session")
def trained_run(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short ebarf training of the tiny scene, through ns-train."""
    output = tmp_path_factory.mktemp("runs")
    run_ok(
        "ns-train", "ebarf", "--data", tiny_scene, "--output-dir", output, "--experiment-name=tiny", "--timestamp=run",
        "--vis=tensorboard", *TINY_TRAINING,
    )  # fmt: skip
    return output / "tiny" / "ebarf" / "run"


@pytest.fixture
def slider_depth() -> Path:
    """The first events of slider_depth, where the recordings are at hand."""
    folder = DATA / "slider_depth"
    if not folder.is_dir():
        pytest.skip(f"no recordings at {DATA}; set EBARF_TEST_DATA to their folder")
    return folder
