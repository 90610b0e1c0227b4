"""Names and values in JSON, YAML and XML files, with their location for error messages."""

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
    """Read a text file; raises :class:`SceneError`."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: byte {error.start} is not UTF-8 text, expected {KNOWN_LAYOUTS}") from None
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror}), expected a calibration file") from None


class _AnyTag(yaml.SafeLoader):
    """Loads plain values and ignores tags such as OpenCV's."""


def _untagged(loader: yaml.SafeLoader, _: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return node.value


_AnyTag.add_multi_constructor("", _untagged)


def parsed(path: Path, text: str) -> Any:
    """Parse JSON, XML or the first document of YAML."""
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
        raise SceneError(f"{path}: not valid YAML (character {error.position} is not a text character)") from None
    except (RecursionError, ValueError, TypeError, LookupError, AttributeError):
        # YAML may misread a value as a date or a key.
        raise SceneError(f"{path}: cannot be read as names and values, expected {KNOWN_LAYOUTS}") from None


def _of_element(element: ElementTree.Element) -> Any:
    """Convert an element of OpenCV's XML: text, a mapping of named children, or a list of unnamed ones."""
    parts = list(element)
    if not parts:
        return (element.text or "").strip().strip('"')
    if all(part.tag == "_" for part in parts):
        return [_of_element(part) for part in parts]
    return {part.tag: _of_element(part) for part in parts}


def shown(value: object) -> str:
    """Shortened repr for messages."""
    shortened = Repr()
    shortened.maxlevel = 2
    return shortened.repr(value)


def plain(name: object) -> str:
    """A name in lower case without underscores and dashes."""
    return re.sub(r"[^a-z0-9]", "", str(name).lower())


class Entry:
    """A mapping with its location, so that errors name file and key; keys may have several spellings."""

    def __init__(self, path: Path, place: str, content: object):
        if not isinstance(content, Mapping):
            held = "nothing" if content is None else shown(content)
            expected = "names with values" if place else KNOWN_LAYOUTS
            raise SceneError(f"{path}: {f'{place} is' if place else 'holds'} {held}, expected {expected}")
        self.path, self.place, self.content = path, place, content
        self.keys = {plain(key): key for key in content}

    def name(self, key: object) -> str:
        """Dotted path of a key."""
        return f"{self.place}.{key}" if self.place else str(key)

    def key(self, spellings: Sequence[str]) -> Any:
        """The key as spelled in this file; None if it has no value."""
        found = (self.keys[plain(one)] for one in spellings if plain(one) in self.keys)
        return next((key for key in found if self.content[key] is not None), None)

    def inner(self, key: Any) -> Entry:
        """The mapping under a key."""
        return Entry(self.path, self.name(key), self.content.get(key))

    def wrong(self, key: Any, expected: str) -> SceneError:
        """The error for a wrong value of a key."""
        found = f"is {shown(self.content[key])}" if key in self.content else "is missing"
        return SceneError(f"{self.path}: {self.name(key)} {found}, expected {expected}")

    def numbers(self, key: Any, expected: str) -> list[float]:
        """Finite numbers from a list, a list of lists, or an OpenCV matrix."""
        found = numbers_of(self.content.get(key))
        if found is None or not np.isfinite(found).all():
            raise self.wrong(key, expected)
        return found

    def number(self, spellings: Sequence[str], expected: str = "a number") -> float:
        """One finite number."""
        key = self.key(spellings)
        values = self.numbers(spellings[0] if key is None else key, expected)
        if len(values) != 1:
            raise self.wrong(key, expected)
        return values[0]


def numbers_of(value: Any, depth: int = 0) -> list[float] | None:
    """Numbers from a list, a list of lists, an OpenCV matrix or text; None if anything is not a number."""
    if isinstance(value, Mapping):
        value = value.get("data")
    if isinstance(value, str) and depth < 2:
        # XML text, and numbers that YAML reads as text, such as 1e-05.
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
