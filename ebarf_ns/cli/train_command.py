"""``ebarf train SCENE``: short for ``ns-train ebarf --data SCENE``."""

import os
import shlex
import signal
import sys
import warnings
from importlib.metadata import entry_points
from pathlib import Path

from ebarf_ns.errors import EbarfError, SceneError, one_line_errors

_HELP = """\
usage: ebarf train SCENE [FLAGS]

Train on a scene folder, as ebarf process or ebarf simulate makes it. It runs

  ns-train ebarf --data SCENE FLAGS

and takes all flags of that command ("ns-train ebarf --help" lists them). Those that are wanted most:

  --max-train-seconds S        end after S seconds of training
  --output-dir FOLDER          where runs are kept, outputs/ where not given
  --vis tensorboard            no viewer: the command ends with the training
  --load-dir RUN/nerfstudio_models
                               resume from a run's newest checkpoint
"""


def train(words: list[str]) -> None:
    """Check the scene before the slow nerfstudio imports, then run ns-train in this process."""
    if words[:1] in (["-h"], ["--help"]):
        print(_HELP, end="")
        return
    # Set before torch is loaded, so that waiting threads leave their cores to other programs.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    with one_line_errors():
        if not words or words[0].startswith("-"):
            raise SceneError("no scene named, expected: ebarf train SCENE, and flags of ns-train ebarf after it")
        command = ["ns-train", "ebarf", "--data", *words]
        print(shlex.join(command), file=sys.stderr, flush=True)
        _check(Path(words[0]))
        found = next(iter(entry_points(group="console_scripts", name="ns-train")), None)
        if found is None:
            raise EbarfError(
                "no ns-train in this environment, expected nerfstudio 1.1.5: pip install nerfstudio==1.1.5"
            )
    # Warnings of torch and nerfstudio about their own code.
    warnings.filterwarnings("ignore", category=FutureWarning)
    sys.argv = command
    try:
        raise SystemExit(found.load()())
    except KeyboardInterrupt:
        # Before the first step, and during imports, there is nothing to save.
        raise SystemExit(128 + signal.SIGINT) from None


def _check(folder: Path) -> None:
    from ebarf_ns.events.recording import RecordingFile
    from ebarf_ns.geometry.trajectory_file import read_tum
    from ebarf_ns.scene import check_bounds, check_clocks, read_scene

    if folder.is_file():
        raise SceneError(
            f"{folder}: a file, expected a scene folder; ebarf process auto {folder} --output SCENE makes one"
        )
    scene = read_scene(folder, trajectory_to_come=True)
    if not scene.trajectory.is_file():
        # Training estimates one, and says so.
        return
    trajectory = read_tum(scene.trajectory)
    check_bounds(scene, trajectory)
    _, start_us, end_us = RecordingFile(scene.events, scene.camera.width, scene.camera.height).span()
    check_clocks(scene, (start_us, end_us), trajectory)
