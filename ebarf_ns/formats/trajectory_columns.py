"""Columns of a trajectory by their names, and conventions that comments above it state."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from ebarf_ns.errors import TrajectoryError
from ebarf_ns.formats.raw_poses import Quaternion, TimeUnit, Transform

_TIME = re.compile(r"(?:^|_)(?:t|ts|time|times|timestamps?|stamp)(?:_(?:n|u|m|nano|micro|milli)?s(?:ecs?|econds?)?)?$")
_SECONDS = re.compile(r"(?:^|_)(?:time|timestamp|stamp)_s(?:ecs?|econds)?$")
_NANOSECONDS = re.compile(r"(?:^|_)(?:time|timestamp|stamp)_n(?:ano)?s(?:ecs?|econds?|ec)?$")
_TURN = r"(?:^|_)(?:q|quat|quaternion|orient|orientation|ori|rot|rotation|attitude)"
_PLACE = r"(?:^|_)(?:p|pos|position|t|trans|translation|location)"
# The first pattern that matches every axis is used.
_POSITIONS = (
    re.compile(rf"{_PLACE}(?:_\w+)*?_?([xyz])(?:_m)?$|^([xyz])$"),
    re.compile(r"^([xyz])_(?:c?m|mm|pos|position|world|map|meters?|metres?)$"),
    re.compile(rf"{_PLACE}_?([012])$"),
)
_ROTATIONS = (
    re.compile(rf"{_TURN}(?:_\w+)*?_?([wxyz])$"),
    re.compile(rf"{_TURN}(?:_\w+)*?_?(real|scalar|re|s|w|i|j|k)$"),
    re.compile(r"^r_?([wxyz])$"),
    re.compile(r"^([wijk])$"),
)
_MEANING = {"real": "w", "scalar": "w", "re": "w", "s": "w", "i": "x", "j": "y", "k": "z", "0": "x", "1": "y", "2": "z"}
_NUMBERED = re.compile(rf"{_TURN}_?(\d)$")
_ANGLES = re.compile(r"roll|pitch|yaw|euler")
_BRACKETS = r"[\[(]([^\])]*)[\])]"
_UNITS: dict[TimeUnit, str] = {
    "ns": "ns|nsecs?|nanos?|nanosec|nanoseconds?",
    "us": "us|µs|usecs?|micros?|microseconds?",
    "ms": "ms|msecs?|millis?|milliseconds?",
    "s": "s|secs?|seconds?",
}
_GIVEN = "t, x, y, z, qx, qy, qz, qw"
_OF_A_POSE = 8

# "w first", "w, x, y, z" and the like; in "x y z w x y z", the first three are the position.
_W_FIRST = re.compile(r"\b(?:scalar|real|w)(?: part)?[\s-]first\b|\bw[\s,]*x[\s,]*y[\s,]*z\b")
_W_LAST = re.compile(r"\b(?:scalar|real|w)(?: part)?[\s-]last\b|\bx[\s,]*y[\s,]*z[\s,]*w\b(?![\s,]*x\b)")
_TO = r"[\s_-]*(?:to|2|->)[\s_-]*"
_TO_CAMERA = re.compile(rf"\bworld{_TO}cam|\bcam\w*[\s_-]from[\s_-]world|\bt_?cw\b|\bw2c\b")
_TO_WORLD = re.compile(rf"\bcam(?:era)?{_TO}world|\bworld[\s_-]from[\s_-]cam|\bt_?wc\b|\bc2w\b")


@dataclass(frozen=True)
class Header:
    """The lines above the first pose."""

    comments: list[str]
    """Without their marks."""
    names: str | None = None
    """A line of words that is no comment."""

    @property
    def text(self) -> str:
        """All of it in lower case."""
        return "\n".join([*self.comments, self.names or ""]).lower()


@dataclass(frozen=True)
class Columns:
    """Column indices of a pose."""

    time: int
    nanoseconds: int | None
    """For times in two columns."""
    position: list[int]
    rotation: list[int]
    order: Quaternion | None
    unit: TimeUnit | None
    others: list[str]
    """Names of unused columns."""
    unclear: str = ""
    """What is unclear about the order of the quaternion."""
    left: str = ""
    """Name of the column of times, if only the others' names tell that it is."""


def named_columns(path: Path, header: Header, count: int) -> Columns | None:
    """Columns from the last line that names them; None without one.

    Raises :class:`TrajectoryError` if a line names columns of which some are not understood.
    """
    lines = [(line, False) for line in header.comments] + ([(header.names, True)] if header.names else [])
    for line, bare in reversed(lines):
        fields = list(_named_fields(line))
        if len(fields) >= count and (columns := _columns(path, fields[-count:], bare)):
            return columns
    return None


def _named_fields(line: str) -> list[tuple[str, str]]:
    """Names, each with what stands in brackets behind it."""
    line = re.sub(r"\[(\d)\]", r"_\1", line)
    bare = re.sub(_BRACKETS, lambda match: " " * len(match.group()), line)
    separator = next((one for one in (";", ",") if one in bare), None)
    starts = [match.start() for match in re.finditer(rf"(?:^|(?<={separator}))" if separator else r"(?<!\S)\S", bare)]
    fields = []
    for start, end in zip(starts, [*starts[1:], len(line)], strict=True):
        bracket = re.search(_BRACKETS, line[start:end])
        name = bare[start:end].strip().removesuffix(separator or "\n").strip().strip("\"'")
        fields.append((name, bracket.group(1) if bracket else ""))
    # Ignore a trailing separator.
    return fields[:-1] if separator and not fields[-1][0] else fields


def _columns(path: Path, fields: list[tuple[str, str]], bare: bool) -> Columns | None:
    """Columns of time, position and quaternion; None if the names do not identify them."""
    names = [name for name, _ in fields]
    clean = [re.sub(r"[^a-zµ0-9]+", "_", name.lower()).strip("_") for name in names]
    position, rotation = _matching(clean, _POSITIONS, "xyz"), _matching(clean, _ROTATIONS, "wxyz")
    nanoseconds = [k for k, name in enumerate(clean) if _NANOSECONDS.search(name)]
    seconds = [k for k, name in enumerate(clean) if _SECONDS.search(name)]
    paired = len(nanoseconds) == 1 and len(seconds) == 1
    times = seconds if paired else [k for k, name in enumerate(clean) if _TIME.search(name)]
    # Prefer a message's own stamp to its recording time.
    times = [k for k in times if "stamp" in clean[k] and len(times) > 1] or times
    found = [times, *position.values(), *rotation.values()]
    order: Quaternion | None = None
    unclear = ""
    unnamed = [k for k in range(len(names)) if [k] not in found]
    only = bool(position and rotation and not times and len(unnamed) == 1 and len(names) == _OF_A_POSE)
    if only:
        found[0] = times = unnamed
    if times and position and rotation:
        for columns in found:
            if len(columns) > 1:
                several = " and ".join(names[k] for k in columns)
                raise TrajectoryError(f"{path}: columns {several} mean the same, expected one pose per line")
        in_file = "".join(sorted(rotation, key=lambda axis: rotation[axis][0]))
        told: Quaternion = next((one for one in get_args(Quaternion) if one == in_file), "xyzw")
        order = told
        turned = [rotation[axis][0] for axis in order]
    else:
        guessed = _partly_named(path, names, clean, found, bare)
        if guessed is None:
            return None
        times, position, turned = guessed
        unclear = f"columns {', '.join(names[k] for k in turned)} do not tell the order of the quaternion"
    placed = [position[axis][0] for axis in "xyz"]
    used = [times[0], *placed, *turned] + (nanoseconds if paired else [])
    unit = "s" if paired else unit_named(fields[times[0]][1]) or unit_named(clean[times[0]].rsplit("_", 1)[-1])
    others = [name or "one without a name" for k, name in enumerate(names) if k not in used]
    left = names[times[0]] if only else ""
    return Columns(times[0], nanoseconds[0] if paired else None, placed, turned, order, unit, others, unclear, left)


def _matching(names: list[str], patterns: tuple[re.Pattern[str], ...], axes: str) -> dict[str, list[int]]:
    """Columns of every axis by the first pattern that has all of them; empty without one."""
    for pattern in patterns:
        found: dict[str, list[int]] = {axis: [] for axis in axes}
        for k, name in enumerate(names):
            match = pattern.search(name)
            said = next((group for group in match.groups() if group), "") if match else ""
            axis = said if said in axes else _MEANING.get(said, "")
            if axis in found:
                found[axis].append(k)
        if all(found.values()):
            return found
    return {}


def _partly_named(
    path: Path, names: list[str], clean: list[str], found: list[list[int]], bare: bool
) -> tuple[list[int], dict[str, list[int]], list[int]] | None:
    """Time, position, and the columns of a quaternion in an unknown order, where names do not identify them all.

    None if the line is not one of names, as a comment may not be.
    """
    times, known = found[0], [columns[0] for columns in found if len(columns) == 1]
    left = [k for k in range(len(names)) if k not in known]
    unknown = f"{path}: columns {', '.join(names[k] for k in left)} are not understood, expected names such as {_GIVEN}"
    placed, turned = len(found) in (4, 8), len(found) in (5, 8)
    unique = len(known) == len(found)
    if not turned and (bare or (times and placed)) and any(_ANGLES.search(clean[k]) for k in left):
        raise TrajectoryError(f"{unknown}: angles are not read")
    if times and placed and not turned and unique:
        numbered = [k for k in left if _NUMBERED.search(clean[k])]
        four = numbered if len(numbered) == 4 else left
        position = dict(zip("xyz", found[1:4], strict=True))
        return (times, position, four) if len(four) == 4 else None
    if len(names) != _OF_A_POSE or not (bare or (times and turned and unique)):
        return None
    if turned:
        raise TrajectoryError(unknown)
    return [0], {"x": [1], "y": [2], "z": [3]}, [4, 5, 6, 7]


def unit_named(text: str) -> TimeUnit | None:
    """The unit that a word means."""
    return next((unit for unit, names in _UNITS.items() if re.fullmatch(names, text.strip().lower())), None)


def unit_above(header: Header) -> TimeUnit | None:
    """Unit from a header such as "[ns]"."""
    return next((unit for unit, names in _UNITS.items() if re.search(rf"\[(?:{names})\]", header.text)), None)


def order_above(header: Header) -> tuple[Quaternion | None, str]:
    """Order of the quaternion from a header without names of columns, or what is unclear about it."""
    # "qx qy qz qw", or EuRoC's "q_RS_w [], q_RS_x [], ...", anywhere.
    named = "".join(re.findall(r"\bq\w*?([wxyz])\b", header.text))
    if order := next((one for one in get_args(Quaternion) if one == named), None):
        return order, ""
    first, last = _W_FIRST.search(header.text), _W_LAST.search(header.text)
    if first and last:
        return None, f"the lines above the poses say both {first.group()!r} and {last.group()!r}"
    return ("wxyz" if first else "xyzw" if last else None), ""


def transform_above(path: Path, header: Header) -> Transform | None:
    """Direction of the poses from the comments; raises :class:`TrajectoryError` if they say both."""
    text = "\n".join(header.comments).lower()
    camera, world = _TO_CAMERA.search(text), _TO_WORLD.search(text)
    if camera and world:
        both = f"{camera.group()!r} and {world.group()!r}"
        raise TrajectoryError(f"{path}: the comments above the poses say both {both}, expected --transform")
    return "world-to-camera" if camera else "camera-to-world" if world else None
