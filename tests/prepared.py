"""Console scripts in processes that have their imports already: forks of one process that has done nothing else.

nerfstudio takes about 9 s to import, and the tests start it some hundred times. A fork of a process that has imported
it, and has computed nothing yet, is otherwise like a new one. Some tests start commands anew all the same: make demo,
signals, viewers, what is said first, what is imported when.
"""

import atexit
import multiprocessing
import os
import subprocess
import sys
import tempfile
from importlib.metadata import entry_points
from multiprocessing import forkserver
from pathlib import Path
from unittest.mock import patch

AVAILABLE = sys.platform == "linux"


def run_script(
    name: str, arguments: list[str], cwd: Path | None, environment: dict[str, str], timeout_s: float
) -> tuple[int, str, str]:
    """A console script's exit code, output and errors; TimeoutExpired if it takes longer."""
    prepared = multiprocessing.get_context("forkserver")
    prepared.set_forkserver_preload(["nerfstudio.scripts.train", "ebarf_ns.cli.main"])
    # rich reads the terminal's width when it is imported.
    with patch.dict(os.environ, environment):
        forkserver.ensure_running()
    with tempfile.TemporaryDirectory() as folder:
        output, errors = Path(folder, "output"), Path(folder, "errors")
        process = prepared.Process(
            target=_run, args=(name, arguments, str(cwd or Path.cwd()), environment, str(output), str(errors))
        )
        process.start()
        process.join(timeout_s)
        if process.exitcode is None:
            process.kill()
            process.join()
            raise subprocess.TimeoutExpired([name, *arguments], timeout_s)
        return process.exitcode, output.read_text(), errors.read_text()


def _run(name: str, arguments: list[str], cwd: str, environment: dict[str, str], output: str, errors: str) -> None:
    for path, descriptor in ((output, 1), (errors, 2)):
        with open(path, "wb") as file:
            os.dup2(file.fileno(), descriptor)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(cwd)
    sys.argv = [name, *arguments]
    (script,) = entry_points(group="console_scripts", name=name)
    try:
        raise SystemExit(script.load()())
    finally:
        # multiprocessing leaves out what an interpreter does at its end.
        atexit._run_exitfuncs()
