"""JSON files that people write: every complaint names the file and the key."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ebarf_ns.errors import SceneError, did_you_mean
from ebarf_ns.files import is_special, whole_file

if TYPE_CHECKING:
    from collections.abc import Sequence


def write_json(path: Path, content: object) -> None:
    """Write a value, whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """The content of a JSON file; raises :class:`SceneError`."""
    if is_special(path):
        raise SceneError(f"{path}: a pipe or a device, expected a file")
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise SceneError(f"{path}: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: byte {error.start} is not UTF-8 text") from None
    except (ValueError, RecursionError) as error:
        # Among them numbers of thousands of digits, which python does not take.
        raise SceneError(f"{path}: not valid JSON ({str(error).split(';')[0]})") from None


class JsonObject:
    """A JSON object that knows where it stands, so that every complaint names file and key."""

    def __init__(self, path: Path, place: str, content: object):
        if not isinstance(content, Mapping):
            raise SceneError(f"{path}: {place or 'the file'} is {content!r:.40}, expected a JSON object")
        self.path, self.place, self.content = path, place, content

    def name(self, key: str) -> str:
        """A key with where it stands in the file."""
        return f"{self.place}.{key}" if self.place else key

    def get(self, key: str) -> Any:
        """The value of a key, None where there is none."""
        return self.content.get(key)

    def only(self, keys: Sequence[str]) -> None:
        """Refuse other keys."""
        unknown = [key for key in self.content if key not in keys]
        if unknown:
            names = ", ".join(self.name(key) for key in unknown)
            raise SceneError(f"{self.path}: unknown key {names}, expected among: {', '.join(keys)}")

    def wrong(self, key: str, expected: str) -> SceneError:
        """The complaint about a key's value."""
        found = repr(self.content[key]) if key in self.content else "missing"
        return SceneError(f"{self.path}: {self.name(key)} is {found:.80}, expected {expected}")

    def object(self, key: str) -> JsonObject:
        """The object of a key."""
        if not isinstance(self.get(key), Mapping):
            raise self.wrong(key, "a JSON object")
        return JsonObject(self.path, self.name(key), self.get(key))

    def file(self, key: str, must_exist: bool = True, absolute: bool = False) -> Path:
        """The path of a file that lies in this one's folder, or anywhere if its path is ``absolute`` and may be."""
        name = self.get(key)
        if not isinstance(name, str) or not name or not name.isprintable():
            raise self.wrong(key, "a file name")
        folder = self.path.parent
        path = folder / name
        outside = ".." in os.path.relpath(path, folder).split(os.sep)
        if outside and not (absolute and Path(name).is_absolute()):
            raise self.wrong(key, "a file in the folder of this one")
        if path.exists() and not path.is_file():
            raise SceneError(f"{self.path}: {self.name(key)} names {name!r}, which is no file")
        if must_exist and not path.is_file():
            raise SceneError(
                f"{self.path}: {self.name(key)} names {name!r}, but there is no file {path}{did_you_mean(path)}"
            )
        return path

    def optional_file(self, key: str, must_exist: bool = True) -> Path | None:
        """The same, None where the key is missing or null."""
        return self.file(key, must_exist) if self.get(key) is not None else None

    def number(self, key: str, expected: str = "a finite number", positive: bool = False) -> float:
        """The finite number of a key."""
        value = self.get(key)
        if not is_number(value) or (positive and value <= 0):
            raise self.wrong(key, f"{expected} above 0" if positive else expected)
        return float(value)

    def integer(self, key: str, positive: bool = False) -> int:
        """The integer of a key."""
        value = self.get(key)
        if not isinstance(value, int) or isinstance(value, bool) or (positive and value <= 0):
            raise self.wrong(key, "an integer above 0" if positive else "an integer")
        return value

    def choice(self, key: str, choices: tuple[str, ...]) -> Any:
        """The value of a key, one of some."""
        if self.get(key) not in choices:
            raise self.wrong(key, f"one of {', '.join(choices)}")
        return self.get(key)


def is_number(value: object) -> bool:
    """Whether it is a number that a float can hold."""
    # Comparing is safe for integers of any length, which do not fit a float.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
