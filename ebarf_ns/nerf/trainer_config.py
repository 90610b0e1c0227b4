"""The flags of a training run."""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from nerfstudio.engine.trainer import TrainerConfig

from ebarf_ns.errors import one_line_errors
from ebarf_ns.nerf.checkpoints import checkpoints_in, newest_whole
from ebarf_ns.nerf.settings_check import check_machine, check_settings
from ebarf_ns.nerf.terminal import say

_HOST_FLAG, _EVERYWHERE = "--viewer.websocket-host", "0.0.0.0"


@dataclass
class EbarfTrainerConfig(TrainerConfig):
    """A nerfstudio training run with a budget."""

    max_train_seconds: float | None = None
    """End after this many seconds of training, without evaluation and loading, or after --max-num-iterations steps,
    whichever comes first; all schedules follow."""
    evaluations: int = 8
    """Number of evaluations, evenly spaced over the budget and written to metrics.jsonl."""
    overwrite: bool = False
    """Start a new run in a folder that holds one."""
    allow_changed_scene: bool = False
    """Resume from a checkpoint even if its scene's events, trajectory or scene.json have changed."""
    estimate_trajectory: bool = True
    """If the scene has no trajectory yet, first estimate it from the events and store it in the scene."""
    learn_intrinsics: bool = False
    """Also learn focal length, principal point and the camera's distortion coefficients; the result is written to
    camera_refined.json, in the format of scene.json."""
    averaged_steps: int = 100
    """Parameters of about this many last steps are averaged for evaluations and checkpoints; 1: no averaging."""

    threads: int | None = None
    """Threads of torch and numba; None: one per core that is free of other work, or as set by OMP_NUM_THREADS."""

    def save_config(self) -> None:
        """Check the settings instead of saving them: ns-train calls this first.

        The trainer writes config.yml once it has locked the folder and made a plan.
        """
        with one_line_errors():
            check_settings(self)
            check_machine(self.machine)

    def __setattr__(self, name: str, value: Any) -> None:
        """Make the viewer listen on loopback, unless a flag says otherwise: anyone who can reach it can control it.

        ns-viewer sets its own viewer settings here, which listen on all addresses by default.
        """
        said = any(word.replace("_", "-").startswith(_HOST_FLAG) for word in sys.argv)
        if name == "viewer" and value.websocket_host == _EVERYWHERE and not said:
            value = replace(value, websocket_host="127.0.0.1")
        super().__setattr__(name, value)

    def print_to_terminal(self) -> None:
        """Print nothing: config.yml has all settings, and the plan line shows the important ones."""

    def get_checkpoint_dir(self) -> Path:
        """The folder of the checkpoints; for scripts that open a run, also selects the newest valid checkpoint."""
        folder = super().get_checkpoint_dir()
        opened = self.pipeline.datamanager.dataparser.kept is not None  # pyright: ignore[reportAttributeAccessIssue]
        if opened and self.load_dir is None and self.load_step is None and checkpoints_in(folder):
            with one_line_errors():
                path, damaged = newest_whole(folder)
            for error in damaged:
                say(f"{error}; {path.name} is used instead")
            self.load_step = int(path.stem.removeprefix("step-"))
        return folder
