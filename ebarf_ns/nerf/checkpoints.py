"""Checkpoints: written atomically, and verified by checksum when they are read."""

from __future__ import annotations

import errno
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from zlib import crc32

import torch
from torch import Tensor

from ebarf_ns.errors import TrainingError
from ebarf_ns.files import is_special, synced, whole_file

FORMAT = 1
_KEPT = 2
_NAME = re.compile(r"step-\d+\.ckpt")
# Errors that say nothing about the file's content.
_NOT_GIVEN = {errno.EIO, errno.EACCES, errno.EPERM, errno.ESTALE, errno.ETIMEDOUT, errno.ENOMEM}
_PLAIN = (str, int, float, bool, type(None))


class UnopenedCheckpointError(TrainingError):
    """A checkpoint that may be good but cannot be read here; an older one must not replace it."""


def write_checkpoint(state: dict[str, Any], path: Path) -> None:
    """Write a state of tensors and plain values atomically, and keep only this checkpoint and the previous one.

    Checkpoints of later steps are removed too: they are damaged, or belong to a training that was not continued.

    ``state["pipeline"]`` gets its own checksum, since nerfstudio's scripts read only that part. Raises
    :class:`TrainingError` if writing fails; existing checkpoints are then kept.
    """
    state = {**state, "format": FORMAT, "pipeline": sealed(state["pipeline"])}
    state["checksum"] = checksum(state)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Beside the folder, not in it: nerfstudio takes every file in it for a checkpoint.
    beside = path.parent.parent / path.name
    write_plain(state, beside)
    beside.replace(path)
    synced(path.parent)
    there = checkpoints_in(path.parent)
    at = there.index(path)
    for other in (*there[: max(at + 1 - _KEPT, 0)], *there[at + 1 :]):
        other.unlink()


def checkpoints_in(folder: Path) -> list[Path]:
    """A run's checkpoints, sorted by step; other files in the folder are ignored."""
    return sorted(path for path in folder.glob("step-*.ckpt") if _NAME.fullmatch(path.name) and path.is_file())


def write_plain(content: dict[str, Any], path: Path) -> None:
    """Write tensors and plain values atomically; raises :class:`TrainingError` if writing fails."""
    try:
        with whole_file(path) as temporary:
            torch.save(content, temporary)
    except (OSError, RuntimeError) as error:
        # Torch's own error reports positions in its archive, not the system's error.
        said = f" ({error.strerror})" if isinstance(error, OSError) and error.strerror else ""
        raise TrainingError(f"{path}: cannot be written{said}; expected room on the disk") from None


def read_plain(path: Path, what: str) -> dict[str, Any]:
    """Read a file written by :func:`write_plain` to the CPU, without running code from it.

    Raises :class:`TrainingError`, with ``what`` the file should be.
    """
    if is_special(path):
        raise TrainingError(f"{path}: a pipe or a device, expected a run's {what}")
    try:
        content = {**torch.load(path, map_location="cpu", weights_only=True)}
    except FileNotFoundError:
        raise TrainingError(f"{path}: is no file, expected a run's {what}") from None
    except Exception as error:  # the unpickler may raise anything for damaged data
        if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno in _NOT_GIVEN):
            said = getattr(error, "strerror", None) or "not enough memory"
            raise UnopenedCheckpointError(f"{path}: cannot be read ({said}), expected a run's {what}") from None
        raise TrainingError(f"{path}: is damaged, or no {what} ({type(error).__name__})") from None
    if name := _not_plain(content):
        raise TrainingError(f"{path}: holds more than tensors and plain values, in {name}; expected a run's {what}")
    if not isinstance(made := content.get("format", 0), int):
        raise TrainingError(f"{path}: is of format {made!r:.40}, expected a number")
    return content


def _not_plain(state: Any, name: str = "") -> str:
    """The name of the first value that is not plain, or tensor that is larger than its storage; empty if none."""
    if isinstance(state, Tensor):
        dense = state.layout == torch.strided and state.device.type == "cpu"
        stored = dense and state.numel() * state.element_size() <= state.untyped_storage().nbytes()
        return "" if stored else name or "it"
    if isinstance(state, _PLAIN):
        return ""
    items = state.items() if isinstance(state, dict) else enumerate(state) if isinstance(state, list | tuple) else None
    if items is None:
        return name or "it"
    return next((found for key, one in items if (found := _not_plain(one, f"{name}.{key}".lstrip(".")))), "")


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The state in a file, as tensors and plain values; raises :class:`TrainingError` if it is damaged.

    Checkpoints from versions without checksums are accepted unverified.
    """
    state = read_plain(path, "checkpoint")
    if not isinstance(pipeline := state.get("pipeline"), dict) or not isinstance(state.get("step"), int):
        raise TrainingError(f"{path}: lacks step or pipeline, expected a run's checkpoint")
    if (made := state.get("format", 0)) > FORMAT:
        raise UnopenedCheckpointError(
            f"{path}: is of format {made}, expected at most {FORMAT}: a newer ebarf_ns made it"
        )
    stored = state.pop("checksum", None)
    if stored is not None and stored != checksum(state):
        raise TrainingError(f"{path}: is damaged: its checksum is not that of its content")
    if name := not_finite(pipeline):
        raise TrainingError(f"{path}: holds values that are not finite, in {name}")
    return state


def chosen_checkpoint(config: Any) -> tuple[Path | None, list[TrainingError]]:
    """The checkpoint that a trainer's configuration resumes from, if any, and the errors of damaged newer ones.

    Raises :class:`TrainingError` if the file does not exist.
    """
    damaged: list[TrainingError] = []
    if config.load_dir is None:
        path = config.load_checkpoint
    elif config.load_step is not None:
        path = config.load_dir / f"step-{config.load_step:09d}.ckpt"
    else:
        path, damaged = newest_whole(config.load_dir)
    if path is not None and not path.is_file():
        raise TrainingError(f"{path}: is no file, expected a run's checkpoint")
    return path, damaged


def newest_whole(folder: Path) -> tuple[Path, list[TrainingError]]:
    """The newest valid checkpoint of a folder, and the errors of damaged newer ones.

    Raises :class:`TrainingError` if there is none, or if a newer one may be good but cannot be read here.
    """
    wrong: list[TrainingError] = []
    for path in reversed(checkpoints_in(folder)):
        try:
            read_checkpoint(path)
        except UnopenedCheckpointError:
            raise
        except TrainingError as error:
            wrong.append(error)
        else:
            return path, wrong
    raise wrong[0] if wrong else TrainingError(f"{folder}: holds no step-*.ckpt, expected a run's checkpoints")


def sealed(pipeline: dict[str, Tensor]) -> dict[str, Tensor]:
    """A pipeline's state with its checksum added."""
    return {**pipeline, "checksum": torch.tensor(checksum(pipeline))}


def unsealed(pipeline: dict[str, Tensor], what: str) -> dict[str, Tensor]:
    """A pipeline's state, verified and without its checksum; raises :class:`TrainingError`, which names ``what``."""
    state = dict(pipeline)
    stored = state.pop("checksum", None)
    if stored is not None and not (isinstance(stored, Tensor) and stored.tolist() == checksum(state)):
        raise TrainingError(f"{what}: is damaged: its checksum is not that of its content; expected a whole checkpoint")
    if name := not_finite(state):
        raise TrainingError(f"{what}: holds values that are not finite, in {name}; expected an earlier checkpoint")
    return state


def checksum(state: Any) -> int:
    """CRC-32 of all keys, values and tensors of a nested state, in order."""
    value = 0
    for leaf in _leaves(state):
        value = crc32(leaf, value)
    return value


def not_finite(state: Any, name: str = "") -> str:
    """The name of the first tensor of a nested state that holds NaN or inf; empty if all are finite."""
    if isinstance(state, Tensor):
        return "" if not state.is_floating_point() or bool(state.isfinite().all()) else name
    items = state.items() if isinstance(state, dict) else enumerate(state) if isinstance(state, list | tuple) else ()
    return next((found for key, one in items if (found := not_finite(one, f"{name}.{key}".lstrip(".")))), "")


def _leaves(state: Any) -> Iterator[bytes]:
    if isinstance(state, Tensor):
        yield f"{state.dtype}{tuple(state.shape)}".encode()
        yield state.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()
    elif isinstance(state, dict):
        for key, one in state.items():
            yield repr(key).encode()
            yield from _leaves(one)
    elif isinstance(state, list | tuple):
        for one in state:
            yield from _leaves(one)
    else:
        yield repr(state).encode()
