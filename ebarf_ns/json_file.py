"""Hand-written JSON files: every error names the file and the key."""

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
    """Write a value to a JSON file atomically."""
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """Return the content of a JSON file; raises :class:`SceneError` if it cannot be read."""
    if is_special(path):
        raise SceneError(f"{path}: a pipe or a device, expected a file")
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"), object_pairs_hook=_unique)
    except OSError as error:
        raise SceneError(f"{path}: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: byte {error.start} is not UTF-8 text") from None
    except (ValueError, RecursionError) as error:
        # Python also refuses integers with thousands of digits.
        raise SceneError(f"{path}: not valid JSON ({str(error).split(';')[0]})") from None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"key {next(key for key in keys if keys.count(key) > 1)} appears twice")
    return content


class JsonObject:
    """A JSON object with its file and its place in it, so that every error names the file and the key."""

    def __init__(self, path: Path, place: str, content: object):
        if not isinstance(content, Mapping):
            raise SceneError(f"{path}: {place or 'the file'} is {content!r:.40}, expected a JSON object")
        self.path, self.place, self.content = path, place, content

    def name(self, key: str) -> str:
        """Return the full name of a key within the file."""
        return f"{self.place}.{key}" if self.place else key

    def get(self, key: str) -> Any:
        """Return the value of a key, None if the key is missing."""
        return self.content.get(key)

    def only(self, keys: Sequence[str]) -> None:
        """Raise :class:`SceneError` if the object has any other key."""
        unknown = [key for key in self.content if key not in keys]
        if unknown:
            names = ", ".join(self.name(key) for key in unknown)
            raise SceneError(f"{self.path}: unknown key {names}, expected one of: {', '.join(keys)}")

    def wrong(self, key: str, expected: str) -> SceneError:
        """Return the error for a key with an invalid value."""
        found = repr(self.content[key]) if key in self.content else "missing"
        return SceneError(f"{self.path}: {self.name(key)} is {found:.80}, expected {expected}")

    def object(self, key: str) -> JsonObject:
        """Return the JSON object under a key."""
        if not isinstance(self.get(key), Mapping):
            raise self.wrong(key, "a JSON object")
        return JsonObject(self.path, self.name(key), self.get(key))

    def file(self, key: str, must_exist: bool = True, absolute: bool = False) -> Path:
        """Return the path of a file in the same folder, or anywhere if ``absolute`` is set and the path is absolute."""
        name = self.get(key)
        if not isinstance(name, str) or not name or not name.isprintable():
            raise self.wrong(key, "a file name")
        folder = self.path.parent
        path = folder / name
        outside = ".." in os.path.relpath(path, folder).split(os.sep)
        if outside and not (absolute and Path(name).is_absolute()):
            raise self.wrong(key, "a file in the same folder")
        if path.exists() and not path.is_file():
            raise SceneError(f"{self.path}: {self.name(key)} names {name!r}, which is not a file")
        if must_exist and not path.is_file():
            raise SceneError(
                f"{self.path}: {self.name(key)} names {name!r}, but there is no file {path}{did_you_mean(path)}"
            )
        return path

    def optional_file(self, key: str, must_exist: bool = True) -> Path | None:
        """Return the path of a file as :meth:`file` does, or None if the key is missing or null."""
        return self.file(key, must_exist) if self.get(key) is not None else None

    def number(self, key: str, expected: str = "a finite number", positive: bool = False) -> float:
        """Return the finite number under a key."""
        value = self.get(key)
        if not is_number(value) or (positive and value <= 0):
            raise self.wrong(key, f"{expected} above 0" if positive else expected)
        return float(value)

    def integer(self, key: str, positive: bool = False) -> int:
        """Return the integer under a key."""
        value = self.get(key)
        if not isinstance(value, int) or isinstance(value, bool) or (positive and value <= 0):
            raise self.wrong(key, "an integer above 0" if positive else "an integer")
        return value

    def choice(self, key: str, choices: tuple[str, ...]) -> Any:
        """Return the value of a key that must be one of the choices."""
        if self.get(key) not in choices:
            raise self.wrong(key, f"one of {', '.join(choices)}")
        return self.get(key)


def is_number(value: object) -> bool:
    """Whether the value is a finite number within the range of a float."""
    # Integers too large for a float can still be compared with one.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
