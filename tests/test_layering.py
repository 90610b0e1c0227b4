"""The rooms stay apart: who may import whom."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "ebarf_ns"
CORE = {"events", "geometry", "radiance", "photometry"}


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
    forbidden = {f"ebarf_ns.{other}" for other in (CORE - {room}) | {"nerf", "cli", "evaluation", "simulation"}}
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


def test_data_parser_module_is_light():
    """Nerfstudio imports it while half loaded: its data managers, models and engine must not be needed."""
    heavy = ("nerfstudio.data.datamanagers", "nerfstudio.models", "nerfstudio.engine", "nerfstudio.pipelines")
    assert not any(name.startswith(heavy) for name in imported(PACKAGE / "nerf" / "dataparser.py"))
