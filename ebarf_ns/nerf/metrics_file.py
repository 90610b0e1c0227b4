"""``metrics.jsonl`` of a run: a header with digests of scene and flags, then one line per evaluation."""

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from ebarf_ns.errors import TrainingError
from ebarf_ns.files import whole_file
from ebarf_ns.scene import Scene

_NAME = "metrics.jsonl"
_SAMPLES, _SAMPLE_BYTES = 1 << 13, 1 << 13
_PLACES = {
    "threads", "timestamp", "output_dir", "experiment_name", "load_dir", "load_step", "load_checkpoint", "data", "kept",
}  # fmt: skip


def begin_metrics(run: Path, header: Callable[[], dict[str, Any]], start_step: int) -> None:
    """Write the header; a run resumed in its own folder keeps its evaluations up to ``start_step``."""
    path = run / _NAME
    first, *records = (_lines(path) if start_step and path.is_file() else []) or [header()]
    # Later evaluations will be repeated.
    records = [record for record in records if record.get("step", 0) <= start_step]
    with whole_file(path) as temporary:
        temporary.write_text("".join(json.dumps(line) + "\n" for line in (first, *records)), encoding="utf-8")


def record_metrics(run: Path, record: dict[str, Any]) -> None:
    """Append a record."""
    # Rewrite the whole file atomically, so that an interrupted run leaves no incomplete line.
    path = run / _NAME
    before = path.read_text(encoding="utf-8") if path.is_file() else ""
    with whole_file(path) as temporary:
        temporary.write_text(before + json.dumps(record) + "\n", encoding="utf-8")


def read_header(run: Path) -> dict[str, Any]:
    """The header; empty if the file is missing or empty. Raises :class:`TrainingError` if it is no header."""
    path = run / _NAME
    return next(iter(_lines(path)), {}) if path.is_file() else {}


def _lines(path: Path) -> list[dict[str, Any]]:
    """All lines before the first incomplete one."""
    lines = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        try:
            lines.append({**json.loads(line)})
        except (ValueError, TypeError):
            if number == 1:
                raise TrainingError(f"{path}:1: holds {line[:40]!r}, expected the header of a run") from None
            sys.stderr.write(f"{path}:{number}: is cut off; what follows is left out\n")
            break
    return lines


def scene_digest(scene: Scene) -> dict[str, str]:
    """A digest of each part of a scene, to tell whether it has changed.

    For recordings larger than 64 MiB, the digest covers the size and 64 MiB of samples spread over the file.
    """
    size = scene.events.stat().st_size
    events = sha256(str(size).encode())
    with scene.events.open("rb") as file:
        for k in range(_SAMPLES):
            file.seek(k * max(size // _SAMPLES, _SAMPLE_BYTES))
            events.update(file.read(_SAMPLE_BYTES))
    small = {"scene.json": scene.folder / "scene.json", "trajectory": scene.trajectory}
    digests = {part: _digest(path.read_bytes()) for part, path in small.items()}
    return {**digests, "recording": events.hexdigest()[:16]}


def changed_parts(scene: Scene, header: dict[str, Any]) -> list[str]:
    """The parts of a scene that changed since the run with this header; empty if the header has no digest."""
    before = header.get("scene_digest")
    if not isinstance(before, dict):
        return []
    now = scene_digest(scene)
    return [part for part in now if part in before and before[part] != now[part]]


def flags_of(configuration: Any) -> dict[str, Any]:
    """The settings of a run by flag name, as plain values, without those for its location."""
    return {name: value for name, value in _flags(configuration) if name.split(".")[-1] not in _PLACES}


def config_digest(flags: dict[str, Any]) -> str:
    """A digest that is equal for runs with equal flags."""
    return _digest(json.dumps(flags).encode())


def _flags(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    if is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, dict) and value:
        for key, one in value.items():
            yield from _flags(one, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list | tuple):
        yield name, [dict(_flags(one)).get("", str(one)) for one in value]
    elif value is None or isinstance(value, bool | int | float | str):
        yield name, value
    else:
        # The text of classes and functions may contain a memory address.
        yield name, getattr(value, "__qualname__", None) or str(value)


def _digest(content: bytes) -> str:
    return sha256(content).hexdigest()[:16]
