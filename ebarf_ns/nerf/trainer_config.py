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
    """End after this many seconds of training, evaluation and loading excluded, if not after --max-num-iterations
    steps before; all schedules follow."""
    evaluations: int = 8
    """How often a run is evaluated into metrics.jsonl, evenly over its budget."""
    overwrite: bool = False
    """Begin anew in a folder that holds a run."""
    allow_changed_scene: bool = False
    """Go on from a checkpoint although its scene's events, trajectory or scene.json are others now."""
    estimate_trajectory: bool = True
    """Where the scene's trajectory is still to come, estimate it from the events first, and keep it with the scene."""
    learn_intrinsics: bool = False
    """Learn focal length, principal point and the camera's distortion coefficients too; the result is written to
    camera_refined.json, as scene.json has it."""
    averaged_steps: int = 100
    """About as many last steps' parameters are averaged for evaluations and checkpoints; 1: the last step's alone."""

    threads: int | None = None
    """Of torch and numba; None: one for each core that nothing else keeps busy, or as OMP_NUM_THREADS says."""

    def save_config(self) -> None:
        """Look whether this machine has what is asked of it, which ns-train begins with.

        The trainer writes config.yml, when it has the folder for itself and a plan.
        """
        with one_line_errors():
            check_settings(self)
            check_machine(self.machine)

    def __setattr__(self, name: str, value: Any) -> None:
        """Whoever reaches a viewer can drive it: it listens on loopback, unless a flag says otherwise.

        ns-viewer puts its own settings here, which by default listen on all addresses.
        """
        said = any(word.replace("_", "-").startswith(_HOST_FLAG) for word in sys.argv)
        if name == "viewer" and value.websocket_host == _EVERYWHERE and not said:
            value = replace(value, websocket_host="127.0.0.1")
        super().__setattr__(name, value)

    def print_to_terminal(self) -> None:
        """Config.yml has all of it; what matters is said as the plan."""

    def get_checkpoint_dir(self) -> Path:
        """Where checkpoints lie; scripts that open a run are led to the newest whole one."""
        folder = super().get_checkpoint_dir()
        opened = self.pipeline.datamanager.dataparser.kept is not None  # pyright: ignore[reportAttributeAccessIssue]
        if opened and self.load_dir is None and self.load_step is None and checkpoints_in(folder):
            with one_line_errors():
                path, damaged = newest_whole(folder)
            for error in damaged:
                say(f"{error}; {path.name} is taken")
            self.load_step = int(path.stem.removeprefix("step-"))
        return folder
