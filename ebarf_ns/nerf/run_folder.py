"""A run's folder has one writer at a time, and a run in it is not begun anew unless told to."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from filelock import FileLock, Timeout

from ebarf_ns.errors import TrainingError
from ebarf_ns.nerf.checkpoints import checkpoints_in

_LOCK = ".lock"
# Temporary names, and that of a checkpoint on its way into its folder.
_LEFT_OVER = re.compile(r"\..+\.\w{8}(\.\w+)?|step-\d+\.ckpt")


def take_folder(folder: Path, goes_on: bool, overwrite: bool) -> FileLock:
    """Lock a run's folder for as long as the lock is held, and remove what a killed writer left half written.

    A training that ``goes_on`` from a checkpoint in the folder keeps it; one that begins there anew must be told to
    ``overwrite`` it. Raises :class:`TrainingError`, before anything is changed.
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
    """Remove the checkpoints of a run that is begun anew."""
    for path in checkpoints_in(folder / "nerfstudio_models"):
        path.unlink()
