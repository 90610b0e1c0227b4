"""JSON files that people write: every complaint names the file and the key."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ebarf_ns.errors import SceneError, did_you_mean
from ebarf_ns.files import whole_file

if TYPE_CHECKING:
    from collections.abc import Sequence


def write_json(path: Path, content: object) -> None:
    """Write a value, whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """What a file holds; raises :class:`SceneError`."""
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise SceneError(f"{path}: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: byte {error.start} is not UTF-8 text") from None
    except (json.JSONDecodeError, RecursionError) as error:
        raise SceneError(f"{path}: not valid JSON ({error})") from None


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

    def file(self, key: str, must_exist: bool = True) -> Path:
        """The file that a key names, relative to the file that it stands in."""
        name = self.get(key)
        if not isinstance(name, str) or not name:
            raise self.wrong(key, "a file name")
        path = self.path.parent / name
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
