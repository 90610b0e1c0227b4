"""Names and values of JSON, YAML and XML files, with the place of each for messages."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from reprlib import Repr
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from ebarf_ns.errors import SceneError

KNOWN_LAYOUTS = (
    "a camera as kalibr, DSEC, EuRoC, ROS, OpenCV (yaml, xml), VINS, ORB-SLAM, DV, basalt (TUM-VIE) or a scene.json "
    "write it"
)


def text_of(path: Path) -> str:
    """The text of a file; raises :class:`SceneError`."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: byte {error.start} is not UTF-8 text, expected {KNOWN_LAYOUTS}") from None
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror}), expected a calibration file") from None


class _AnyTag(yaml.SafeLoader):
    """Plain values whatever their tags, such as OpenCV's, say."""


def _untagged(loader: yaml.SafeLoader, _: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return node.value


_AnyTag.add_multi_constructor("", _untagged)


def parsed(path: Path, text: str) -> Any:
    """The content of JSON, XML or YAML, of which the first document."""
    try:
        if path.suffix.lower() == ".json":
            return json.loads(text)
        if text.lstrip().startswith("<"):
            return _of_element(ElementTree.fromstring(text.lstrip().encode()))
        loader = _AnyTag(re.sub(r"^%YAML.*$", "", text, flags=re.MULTILINE))
        return loader.get_data() if loader.check_data() else None
    except json.JSONDecodeError as error:
        raise SceneError(f"{path}:{error.lineno}: not valid JSON ({error.msg})") from None
    except ElementTree.ParseError as error:
        raise SceneError(f"{path}:{error.position[0]}: not valid XML") from None
    except yaml.MarkedYAMLError as error:
        line = f":{error.problem_mark.line + 1}" if error.problem_mark else ""
        raise SceneError(f"{path}{line}: not valid YAML ({error.problem or error.context})") from None
    except yaml.reader.ReaderError as error:
        raise SceneError(f"{path}: not valid YAML (character {error.position} is none that text has)") from None
    except (RecursionError, ValueError, TypeError, LookupError, AttributeError):
        # What YAML takes for a date, or a key, may be none.
        raise SceneError(f"{path}: cannot be read as names and values, expected {KNOWN_LAYOUTS}") from None


def _of_element(element: ElementTree.Element) -> Any:
    """What OpenCV's XML says: text, or what is named in it; a list's parts have no name."""
    parts = list(element)
    if not parts:
        return (element.text or "").strip().strip('"')
    if all(part.tag == "_" for part in parts):
        return [_of_element(part) for part in parts]
    return {part.tag: _of_element(part) for part in parts}


def shown(value: object) -> str:
    """For messages: a beginning, whatever is in a file."""
    beginning = Repr()
    beginning.maxlevel = 2
    return beginning.repr(value)


def plain(name: object) -> str:
    """A name without case, underscores and dashes."""
    return re.sub(r"[^a-z0-9]", "", str(name).lower())


class Entry:
    """A mapping that knows where it stands, so that every complaint names file and key; keys have many spellings."""

    def __init__(self, path: Path, place: str, content: object):
        if not isinstance(content, Mapping):
            held = "nothing" if content is None else shown(content)
            expected = "names with values" if place else KNOWN_LAYOUTS
            raise SceneError(f"{path}: {f'{place} is' if place else 'holds'} {held}, expected {expected}")
        self.path, self.place, self.content = path, place, content
        self.keys = {plain(key): key for key in content}

    def name(self, key: object) -> str:
        """Where a key stands."""
        return f"{self.place}.{key}" if self.place else str(key)

    def key(self, spellings: Sequence[str]) -> Any:
        """The key as it is spelled here; None where it has no value."""
        found = (self.keys[plain(one)] for one in spellings if plain(one) in self.keys)
        return next((key for key in found if self.content[key] is not None), None)

    def inner(self, key: Any) -> Entry:
        """What a key holds."""
        return Entry(self.path, self.name(key), self.content.get(key))

    def wrong(self, key: Any, expected: str) -> SceneError:
        """The complaint about a key's value."""
        found = f"is {shown(self.content[key])}" if key in self.content else "is missing"
        return SceneError(f"{self.path}: {self.name(key)} {found}, expected {expected}")

    def numbers(self, key: Any, expected: str) -> list[float]:
        """Finite ones, of a list, of a list of lists, or of an OpenCV matrix."""
        found = numbers_of(self.content.get(key))
        if found is None or not np.isfinite(found).all():
            raise self.wrong(key, expected)
        return found

    def number(self, spellings: Sequence[str], expected: str = "a number") -> float:
        """A finite one."""
        key = self.key(spellings)
        values = self.numbers(spellings[0] if key is None else key, expected)
        if len(values) != 1:
            raise self.wrong(key, expected)
        return values[0]


def numbers_of(value: Any, depth: int = 0) -> list[float] | None:
    """The numbers of a list, a list of lists, an OpenCV matrix or text; None where there are others than numbers."""
    if isinstance(value, Mapping):
        value = value.get("data")
    if isinstance(value, str) and depth < 2:
        # XML's, and those that YAML takes for text, such as 1e-05.
        try:
            return [float(word) for word in value.split()] or None
        except ValueError:
            return None
    if isinstance(value, list | tuple) and depth < 2 and len(value) <= 64:
        parts = [numbers_of(one, depth + 1) for one in value]
        return None if any(part is None for part in parts) else [one for part in parts for one in part or ()]
    if isinstance(value, int | float) and not isinstance(value, bool):
        return [float(value)] if abs(value) < 1e300 else [np.inf]
    return None
