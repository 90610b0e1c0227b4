"""The configuration of a run, read from its ``config.yml`` without running what the file says.

Nerfstudio dumps configurations as YAML that names classes, and its loader calls them, so an untrusted file can run
arbitrary code. Here, a file can only name classes and functions that this package's own configurations contain, and
only enumerations and paths are called. Opening the run then calls each configuration's own target.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from importlib import import_module
from pathlib import Path, PosixPath, PurePath, WindowsPath
from typing import TYPE_CHECKING, Any

import yaml

from ebarf_ns.errors import EvaluationError
from ebarf_ns.nerf.method import ebarf, ebarf_paper, enerf
from ebarf_ns.nerf.trainer_config import EbarfTrainerConfig

if TYPE_CHECKING:
    from collections.abc import Iterator

# Packages that may be imported to look up a name.
_PACKAGES = ("ebarf_ns.", "nerfstudio.", "torch.optim.", "pathlib.")
_TAG = "tag:yaml.org,2002:python/"


def read_run_config(path: Path) -> EbarfTrainerConfig:
    """Read the configuration of an ebarf run; raises :class:`EvaluationError`."""
    try:
        # A restricted subclass of SafeLoader, despite the Python tags.
        config = yaml.load(path.read_text(encoding="utf-8"), Loader=_Loader)
    except OSError as error:
        raise EvaluationError(f"{path}: {error.strerror or error}; expected the folder of a training run") from None
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        said = " ".join(str(error).split())
        raise EvaluationError(f"{path}: cannot be read ({said}); expected the config.yml of a training run") from None
    if not isinstance(config, EbarfTrainerConfig):
        raise EvaluationError(f"{path}: holds a {type(config).__name__}, expected the configuration of an ebarf run")
    return config


class _Loader(yaml.SafeLoader):
    """Loads plain values, tuples, paths, and what :func:`_known` lists."""


def _object(loader: _Loader, name: str, node: yaml.Node) -> Iterator[Any]:
    kind = _looked_up(name, node)
    if kind not in _configurations() or not isinstance(node, yaml.MappingNode):
        raise _refused(f"{name} is no configuration", node)
    made = object.__new__(kind)
    yield made
    values = loader.construct_mapping(node, deep=True)
    # Nerfstudio calls the target of a configuration.
    if values.get("_target") not in _configurations()[kind]:
        raise _refused(f"{name} has a target of another configuration", node)
    vars(made).update(values)


def _applied(loader: _Loader, name: str, node: yaml.Node) -> Any:
    made = _looked_up(name, node)
    if isinstance(node, yaml.SequenceNode):
        values = loader.construct_sequence(node)
        if issubclass(made, PurePath) and all(isinstance(value, str) for value in values):
            return Path(*values)
        if issubclass(made, Enum) and len(values) == 1 and values[0] in [one.value for one in made]:
            return made(values[0])
    raise _refused(f"no value of {name}", node)


def _looked_up(name: str, node: yaml.Node) -> Any:
    try:
        if not name.startswith(_PACKAGES):
            raise ImportError
        module, _, attribute = name.rpartition(".")
        found = getattr(import_module(module), attribute)
        if not any(found is one for one in _known()):
            raise ImportError
    except (ImportError, AttributeError):
        raise _refused(f"it names {name}, which no configuration of this package holds", node) from None
    return found


def _refused(why: str, node: yaml.Node) -> yaml.constructor.ConstructorError:
    return yaml.constructor.ConstructorError(None, None, why, node.start_mark)


@cache
def _known() -> tuple[Any, ...]:
    """The classes and functions in this package's configurations, and path classes."""
    named = [PosixPath, WindowsPath]
    for value in _values([method.config for method in (ebarf, ebarf_paper, enerf)]):
        named.append(value if callable(value) else type(value))
    return tuple(dict.fromkeys(named))


@cache
def _configurations() -> dict[type, list[Any]]:
    """The classes of this package's configurations, each with the targets that occur with it."""
    targets: dict[type, list[Any]] = {}
    for value in _values([method.config for method in (ebarf, ebarf_paper, enerf)]):
        if is_dataclass(value) and not isinstance(value, type):
            targets.setdefault(type(value), []).append(getattr(value, "_target", None))
    return targets


def _values(value: object) -> Iterator[Any]:
    """All values in a nested configuration that are stored under the name of a class or a function."""
    if isinstance(value, type | Enum) or callable(value):
        yield value
    elif is_dataclass(value):
        yield value
        yield from _values([getattr(value, field.name) for field in fields(value)])
    elif isinstance(value, dict):
        yield from _values(list(value.values()))
    elif isinstance(value, list | tuple):
        for one in value:
            yield from _values(one)


def _tuple(loader: _Loader, node: yaml.SequenceNode) -> tuple[Any, ...]:
    return tuple(loader.construct_sequence(node, deep=True))


_Loader.add_constructor(f"{_TAG}tuple", _tuple)
_Loader.add_multi_constructor(f"{_TAG}object:", _object)
_Loader.add_multi_constructor(f"{_TAG}object/apply:", _applied)
_Loader.add_multi_constructor(f"{_TAG}name:", lambda loader, name, node: _looked_up(name, node))
