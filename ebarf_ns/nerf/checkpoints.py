"""Checkpoints that are always whole and always good: verified before they are written and after they are read."""

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
# What the system says of a file that it does not give, whatever is in it.
_NOT_GIVEN = {errno.EIO, errno.EACCES, errno.EPERM, errno.ESTALE, errno.ETIMEDOUT, errno.ENOMEM}
_PLAIN = (str, int, float, bool, type(None))


class UnopenedCheckpointError(TrainingError):
    """A checkpoint that may be good, but cannot be read here: an older one is no substitute."""


def write_checkpoint(state: dict[str, Any], path: Path) -> None:
    """Write a state of tensors and plain values whole, then remove all checkpoints but it and the one before.

    Those of later steps are of a training that was not gone on with, or damaged.

    ``state["pipeline"]`` gets a checksum of its own, since nerfstudio's scripts read that part alone. Raises
    :class:`TrainingError` where the disk does not take it; what was there before stays.
    """
    state = {**state, "format": FORMAT, "pipeline": sealed(state["pipeline"])}
    state["checksum"] = checksum(state)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Beside the folder, not in it: nerfstudio takes every name in there for a checkpoint.
    beside = path.parent.parent / path.name
    write_plain(state, beside)
    beside.replace(path)
    synced(path.parent)
    there = checkpoints_in(path.parent)
    at = there.index(path)
    for other in (*there[: max(at + 1 - _KEPT, 0)], *there[at + 1 :]):
        other.unlink()


def checkpoints_in(folder: Path) -> list[Path]:
    """A run's checkpoints, by their steps; not what else a user may keep beside them."""
    return sorted(path for path in folder.glob("step-*.ckpt") if _NAME.fullmatch(path.name) and path.is_file())


def write_plain(content: dict[str, Any], path: Path) -> None:
    """Write tensors and plain values whole; raises :class:`TrainingError` where the disk does not take them."""
    try:
        with whole_file(path) as temporary:
            torch.save(content, temporary)
    except (OSError, RuntimeError) as error:
        # Torch's own error is of positions in its archive, whatever the system said.
        said = f" ({error.strerror})" if isinstance(error, OSError) and error.strerror else ""
        raise TrainingError(f"{path}: cannot be written{said}; expected room on the disk") from None


def read_plain(path: Path, what: str) -> dict[str, Any]:
    """What :func:`write_plain` wrote, on the processor, and nothing that would run code; raises :class:`TrainingError`
    that says what it should be."""
    if is_special(path):
        raise TrainingError(f"{path}: a pipe or a device, expected a run's {what}")
    try:
        content = {**torch.load(path, map_location="cpu", weights_only=True)}
    except FileNotFoundError:
        raise TrainingError(f"{path}: is no file, expected a run's {what}") from None
    except Exception as error:  # whatever damaged bytes make the unpickler raise
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
    """The name of what is no plain value, or a tensor that is larger than what is stored of it; empty if all are."""
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
    """The state in a file, as tensors and plain values; raises :class:`TrainingError` where it is not what was written.

    Checkpoints of before there were checksums are taken as they are.
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
    """The checkpoint that a trainer's configuration goes on from, if any, and what is wrong with newer ones.

    Raises :class:`TrainingError` where there is no such file.
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
    """The newest checkpoint of a folder that can be read, and what is wrong with newer ones.

    Raises :class:`TrainingError` where there is none, or where a newer one may be good, but cannot be read here.
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
    """A pipeline's state, with its checksum."""
    return {**pipeline, "checksum": torch.tensor(checksum(pipeline))}


def unsealed(pipeline: dict[str, Tensor], what: str) -> dict[str, Tensor]:
    """A pipeline's state without its checksum, verified; raises :class:`TrainingError` with ``what`` it is of."""
    state = dict(pipeline)
    stored = state.pop("checksum", None)
    if stored is not None and not (isinstance(stored, Tensor) and stored.tolist() == checksum(state)):
        raise TrainingError(f"{what}: is damaged: its checksum is not that of its content; expected a whole checkpoint")
    if name := not_finite(state):
        raise TrainingError(f"{what}: holds values that are not finite, in {name}; expected a checkpoint of before")
    return state


def checksum(state: Any) -> int:
    """CRC-32 of all names, values and tensors of a nested state, in order."""
    value = 0
    for leaf in _leaves(state):
        value = crc32(leaf, value)
    return value


def not_finite(state: Any, name: str = "") -> str:
    """The name of the first tensor of a nested state that holds NaN or inf; empty where all are finite."""
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
