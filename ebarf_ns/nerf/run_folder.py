"""The run folder: one writer at a time, and an existing run is overwritten only on request."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from filelock import FileLock, Timeout

from ebarf_ns.errors import TrainingError
from ebarf_ns.nerf.checkpoints import checkpoints_in

_LOCK = ".lock"
# Temporary files, and a checkpoint that has not yet been moved into its folder.
_LEFT_OVER = re.compile(r"\..+\.\w{8}(\.\w+)?|step-\d+\.ckpt")


def take_folder(folder: Path, goes_on: bool, overwrite: bool) -> FileLock:
    """Lock a run's folder until the lock is released, and remove partly written files of a killed process.

    A training that ``goes_on`` resumes from a checkpoint in the folder and keeps the run. A new training in the folder
    of a run requires ``overwrite``. Raises :class:`TrainingError` before anything is changed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / _LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise TrainingError(f"{folder}: another training writes there; expected another --timestamp") from None
    older = checkpoints_in(folder / "nerfstudio_models")
    if older and not goes_on and not overwrite:
        lock.release()
        raise TrainingError(
            f"{folder}: holds a run, up to {older[-1].name}; expected --load-dir {folder / 'nerfstudio_models'} to "
            "go on with it, --overwrite True to begin anew, or another --timestamp"
        )
    for place in (folder, folder / "renders", folder / "report"):
        for path in place.iterdir() if place.is_dir() else ():
            if _LEFT_OVER.fullmatch(path.name):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
    return lock


def remove_checkpoints(folder: Path) -> None:
    """Remove the checkpoints of a run that is overwritten."""
    for path in checkpoints_in(folder / "nerfstudio_models"):
        path.unlink()
