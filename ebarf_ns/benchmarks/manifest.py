"""Definition of a comparison: methods x scenes x trajectories x seeds x seconds, read from a YAML file."""

import math
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from ebarf_ns.errors import BenchmarkError
from ebarf_ns.simulation.sensor import SensorModel
from ebarf_ns.simulation.simulate import Simulation
from ebarf_ns.simulation.trajectory_errors import NO_ERRORS, TrajectoryErrors

Role = Literal["method", "floor", "ceiling"]
T = TypeVar("T")
TRUE = "true"
"""The trajectory used for floors."""


@dataclass(frozen=True)
class Method:
    """A method to train."""

    command: str
    """Arguments of ns-train: a method and its flags."""
    role: Role = "method"
    """floor: trained with the true poses, whatever the trajectory; ceiling: keeps the given poses fixed."""

    @property
    def words(self) -> list[str]:
        """The command, split as by a shell."""
        return shlex.split(self.command)


@dataclass(frozen=True)
class Stated:
    """A scene folder with sensor properties that override its scene.json."""

    folder: Path
    threshold_on: float | None = None
    threshold_off: float | None = None
    refractory_us: int | None = None
    time_constant_us: float | None = None


@dataclass(frozen=True)
class Other:
    """Result of another program on a scene, given by its output files."""

    method: str
    scene: str
    trajectory: str
    seed: int
    seconds: float
    refined: Path
    """Refined trajectory, a TUM file, up to a similarity transform."""
    renders: Path | None = None
    """Folder with renders of the scene's frames, under the same file names."""


@dataclass(frozen=True)
class Manifest:
    """A comparison."""

    methods: dict[str, Method]
    scenes: dict[str, Simulation | Stated]
    """A simulation, repeated for each seed, or a scene folder; without a reference trajectory, it has no floor."""
    trajectories: dict[str, TrajectoryErrors | None]
    """Errors of the initial trajectory; None: the scene folder's own trajectory."""
    seeds: tuple[int, ...] = (0, 1, 2)
    seconds: tuple[float, ...] = (60.0,)
    """Training times."""
    evaluations: int = 6
    """Number of evaluations per training."""
    others: tuple[Other, ...] = ()
    name: str = ""


def read_manifest(path: Path) -> Manifest:
    """Read a YAML file; raises :class:`BenchmarkError` naming file, place and expectation."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BenchmarkError(f"{path}: {error.strerror or error}; expected engine or a manifest") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise BenchmarkError(f"{path}: not valid YAML ({' '.join(str(error).split())})") from None
    reader = _Reader(path)
    whole = reader.mapping(content, "the file")
    manifest = Manifest(
        methods={key: reader.method(value, f"methods.{key}") for key, value in reader.named(whole, "methods")},
        scenes={key: reader.scene(value, f"scenes.{key}") for key, value in reader.named(whole, "scenes")},
        trajectories={
            key: reader.errors(value, f"trajectories.{key}") for key, value in reader.named(whole, "trajectories")
        },
        seeds=tuple(map(int, reader.numbers(whole, "seeds", [0, 1, 2]))),
        seconds=tuple(reader.numbers(whole, "seconds", [60.0])),
        evaluations=int(reader.numbers({"evaluations": [whole.pop("evaluations", 6)]}, "evaluations", [])[0]),
        others=reader.others(whole.pop("others", None) or []),
        name=reader.nothing_left(whole, path.stem),
    )
    for other in manifest.others:
        if other.scene not in manifest.scenes or other.trajectory not in manifest.trajectories:
            raise BenchmarkError(
                f"{path}: {other.method} is of scene {other.scene!r} and trajectory {other.trajectory!r}, "
                "expected some of this manifest"
            )
        for file in (other.refined, other.renders):
            if file and not file.exists():
                raise BenchmarkError(f"{path}: {other.method} names {file}, but there is no such file")
    return manifest


class _Reader:
    def __init__(self, path: Path):
        self.path = path

    def wrong(self, place: str, found: object, expected: str) -> BenchmarkError:
        return BenchmarkError(f"{self.path}: {place} is {found!r:.80}, expected {expected}")

    def mapping(self, content: object, place: str) -> dict[str, Any]:
        if not isinstance(content, Mapping):
            raise self.wrong(place, content, "names with values")
        return {str(key): value for key, value in content.items()}

    def named(self, whole: dict[str, Any], key: str) -> list[tuple[str, Any]]:
        found = self.mapping(whole.pop(key, None), key)
        if not found:
            raise self.wrong(key, found, "one entry or more")
        for name in found:
            # Names become file names.
            if not re.fullmatch(r"[\w .,+-]+", name) or name.startswith(".") or name == TRUE:
                raise self.wrong(f"a name in {key}", name, f"letters, digits, spaces and . , + - _, and not {TRUE!r}")
        return list(found.items())

    def numbers(self, whole: dict[str, Any], key: str, default: list[float]) -> list[float]:
        found = whole.pop(key, default)
        if not isinstance(found, list) or not found or not all(_fits(one, float) and one >= 0 for one in found):
            raise self.wrong(key, found, "one number or more, none below 0")
        return [float(one) for one in found]

    def nothing_left(self, whole: dict[str, Any], name: str) -> str:
        if whole:
            known = ", ".join(one.name for one in fields(Manifest) if one.name != "name")
            raise BenchmarkError(f"{self.path}: unknown key {', '.join(whole)}, expected among: {known}")
        return name

    def make(self, kind: type[T], content: object, place: str) -> T:
        values = self.mapping(content, place)
        known = [one.name for one in fields(kind)]  # pyright: ignore[reportArgumentType]
        for key in values:
            if key not in known:
                raise BenchmarkError(f"{self.path}: unknown key {place}.{key}, expected among: {', '.join(known)}")
        hints = get_type_hints(kind)
        for key, value in values.items():
            if not _fits(value, hints[key]):
                choices = get_args(hints[key]) if get_origin(hints[key]) is Literal else ()
                expected = f"one of {', '.join(map(str, choices))}" if choices else getattr(hints[key], "__name__", "")
                raise self.wrong(f"{place}.{key}", value, expected or str(hints[key]))
        converted = {key: _converted(value, hints[key]) for key, value in values.items()}
        try:
            return kind(**converted)
        except TypeError as error:
            raise BenchmarkError(f"{self.path}: {place}: {error}") from None

    def method(self, content: object, place: str) -> Method:
        method = Method(content) if isinstance(content, str) else self.make(Method, content, place)
        try:
            whole = bool(method.words)
        except ValueError:
            whole = False
        if not whole:
            raise self.wrong(f"{place}.command", method.command, "what follows ns-train, as a shell would read it")
        return method

    def scene(self, content: object, place: str) -> Simulation | Stated:
        if isinstance(content, str):
            return Stated(Path(content))
        values = self.mapping(content, place)
        if "folder" in values:
            stated = self.make(Stated, values, place)
            if (stated.threshold_on is None) != (stated.threshold_off is None):
                raise self.wrong(place, values, "both threshold_on and threshold_off, or neither")
            return stated
        if "errors" in values:
            raise BenchmarkError(f"{self.path}: {place}.errors: expected under trajectories")
        sensor = self.make(SensorModel, values.pop("sensor", {}), f"{place}.sensor")
        return replace(self.make(Simulation, values, place), sensor=sensor, errors=NO_ERRORS)

    def errors(self, content: object, place: str) -> TrajectoryErrors | None:
        if content == "as given":
            return None
        values = {**vars(NO_ERRORS), **self.mapping(content, place)}
        return self.make(TrajectoryErrors, values, place)

    def others(self, content: object) -> tuple[Other, ...]:
        if not isinstance(content, list):
            raise self.wrong("others", content, "a list")
        return tuple(self.make(Other, one, f"others[{k}]") for k, one in enumerate(content))


def _fits(value: object, kind: Any) -> bool:
    """Whether a YAML value matches an annotated type."""
    if get_origin(kind) in (Union, UnionType):
        return any(_fits(value, one) for one in get_args(kind))
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    if get_origin(kind) is tuple:
        return isinstance(value, list) and all(_fits(one, get_args(kind)[0]) for one in value)
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, str if kind is Path else kind)


def _converted(value: Any, kind: Any) -> Any:
    paths = kind is Path or Path in get_args(kind)
    return Path(value) if paths and isinstance(value, str) else tuple(value) if isinstance(value, list) else value
