"""Errors that users can cause: one class per package, one line per message, exit code 2."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path


class EbarfError(Exception):
    """Base of all errors that a user can cause and fix; the message names file, place, value and expectation."""

    def __str__(self) -> str:
        # Messages may quote multi-line library errors.
        return " ".join(super().__str__().splitlines())


class SceneError(EbarfError):
    """The scene folder or its scene.json does not follow the format."""


class RecordingError(EbarfError):
    """The event recording cannot be read or does not fit the sensor or the trajectory."""


class TrajectoryError(EbarfError):
    """The keyframe poses cannot be read, interpolated or aligned."""


class OdometryError(EbarfError):
    """No reliable trajectory can be estimated from events alone."""


class TrainingError(EbarfError):
    """The training cannot start or continue."""


class EvaluationError(EbarfError):
    """A run cannot be evaluated."""


class SimulationError(EbarfError):
    """The simulation cannot produce what was requested."""


class ExportError(EbarfError):
    """A run cannot be exported as requested."""


class NoSurfaceError(ExportError):
    """No surface is seen sharply enough."""


class BenchmarkError(EbarfError):
    """A benchmark cannot measure what was requested."""


@contextmanager
def one_line_errors() -> Iterator[None]:
    """Turn an :class:`EbarfError` or a system error into one line on standard error and exit code 2."""
    try:
        yield
    except (EbarfError, OSError) as error:
        print(f"error: {error if isinstance(error, EbarfError) else _what_the_system_says(error)}", file=sys.stderr)
        raise SystemExit(2) from error


def did_you_mean(path: Path) -> str:
    """The end of a message about a path that leads nowhere: what is there under a name much like it, if anything is."""
    missing = [one for one in (path, *path.parents) if not one.exists()]
    if not missing or not missing[-1].parent.is_dir():
        return ""
    first = missing[-1]
    near = get_close_matches(first.name, [one.name for one in first.parent.iterdir()], n=1)
    if not near:
        return ""
    found = first.parent / near[0]
    whole = found / path.relative_to(first)
    return f"; did you mean {whole if whole.exists() else found}?"


def _what_the_system_says(error: OSError) -> str:
    said = error.strerror or " ".join(str(error).split())
    if not error.filename:
        return said
    near = did_you_mean(Path(error.filename)) if isinstance(error, FileNotFoundError) else ""
    return f"{error.filename}: {said}{near}"
