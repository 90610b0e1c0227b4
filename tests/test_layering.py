"""The rooms stay apart: who may import whom."""

import ast
import re
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "ebarf_ns"
CORE = {"events", "geometry", "radiance", "photometry"}
MOST_LINES = 350


def imported(file: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
        elif isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
    return names


def files(room: str) -> list[Path]:
    return sorted((PACKAGE / room).rglob("*.py"))


@pytest.mark.parametrize("room", sorted(CORE))
def test_core_rooms_know_neither_each_other_nor_nerfstudio(room: str):
    forbidden = {
        f"ebarf_ns.{other}" for other in (CORE - {room}) | {"nerf", "cli", "evaluation", "simulation", "formats"}
    }
    for file in files(room):
        for name in imported(file):
            assert not name.startswith("nerfstudio"), f"{file} imports {name}"
            assert not any(name == f or name.startswith(f + ".") for f in forbidden), f"{file} imports {name}"


def test_only_the_nerf_room_imports_nerfstudio():
    for file in PACKAGE.rglob("*.py"):
        if "nerf" not in file.relative_to(PACKAGE).parts:
            assert not any(name.split(".")[0] == "nerfstudio" for name in imported(file)), file


def test_evaluation_never_sees_a_live_model():
    for file in files("evaluation"):
        assert not any(name.startswith(("ebarf_ns.nerf", "ebarf_ns.radiance")) for name in imported(file)), file


def test_the_map_for_contributors_has_every_room():
    listed = set(re.findall(r"^\| `(\w+)` \|", (PACKAGE.parent / "CONTRIBUTING.md").read_text(encoding="utf-8"), re.M))
    assert {path.parent.name for path in PACKAGE.glob("*/__init__.py")} <= listed


def test_data_parser_module_is_light():
    """Nerfstudio imports it while half loaded: its data managers, models and engine must not be needed."""
    heavy = ("nerfstudio.data.datamanagers", "nerfstudio.models", "nerfstudio.engine", "nerfstudio.pipelines")
    assert not any(name.startswith(heavy) for name in imported(PACKAGE / "nerf" / "dataparser.py"))


def test_files_are_short():
    for file in PACKAGE.rglob("*.py"):
        lines = len(file.read_text(encoding="utf-8").splitlines())
        assert lines <= MOST_LINES, f"{file} has {lines} lines, expected at most {MOST_LINES}"


def test_the_top_level_shows_the_method_and_not_its_doormat():
    """Foreign files are read in the room of formats alone, and the package's own files do without it."""
    for file in PACKAGE.glob("*.py"):
        assert not any(name.startswith("ebarf_ns.formats") for name in imported(file)), file


def test_no_two_files_import_each_other():
    """Nor do more of them in a circle, imports within functions and for annotations included."""
    names = {
        str(file.relative_to(PACKAGE.parent).with_suffix("")).replace("/", "."): file for file in PACKAGE.rglob("*.py")
    }
    needed = {name: imported(file) & names.keys() for name, file in names.items()}
    while free := [name for name, others in needed.items() if not others & needed.keys()]:
        for name in free:
            del needed[name]
    assert not needed, f"among {', '.join(sorted(needed))}"
