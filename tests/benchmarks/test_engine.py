"""The engine benchmark runs; speed is not tested here."""

import json
import math
import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest

from ebarf_ns.benchmarks.figures import Figure, table
from ebarf_ns.benchmarks.settings import PARTS
from tests.conftest import run_command

BARE = """
import importlib.util, sys
for name in "nerfstudio jaxtyping scipy tyro rich hdf5plugin evo matplotlib torchmetrics viser cv2 yaml".split():
    sys.modules[name] = None
found = importlib.util.find_spec
importlib.util.find_spec = lambda name, *rest: None if name == "nerfstudio" else found(name, *rest)
from ebarf_ns.benchmarks import engine
engine.main(sys.argv[1:])
"""


TRAININGS = ("nerfacto", "training")
"""The parts that train, which takes most of the time."""


def measured(path: Path, parts: Iterable[str]) -> dict:
    finished = run_command("ebarf", "bench", "engine", "--quick", "--parts", *parts, "--json", "--output", path)
    assert finished.code == 0, finished.errors[-3000:]
    assert json.loads(finished.output) == json.loads(path.read_text())
    result = json.loads(finished.output)
    assert result["quick"] and result["machine"] and result["backend"] == "numba"
    assert all(math.isfinite(figure["value"]) for figure in result["figures"])
    return result


def assert_named(result: dict, *words: str) -> None:
    names = " ".join(figure["what"] for figure in result["figures"])
    assert all(one in names for one in words), names


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> dict:
    parts = [part for part in PARTS if part not in TRAININGS]
    return measured(tmp_path_factory.mktemp("bench") / "engine.json", parts)


def test_every_part_yields_finite_figures(result: dict):
    assert_named(
        result, "hash grid against", "limit: matrix product in float32", "field: measured over its limit",
        "pairs per second", "sampler's speed", "growth with keyframes", "frame", "in a file",
    )  # fmt: skip


@pytest.mark.slow
def test_trainings_yield_finite_figures(tmp_path: Path):
    result = measured(tmp_path / "engine.json", TRAININGS)
    assert_named(result, "against nerfacto", "within 1 dB", "peak memory of training")


def test_the_table_shows_targets_and_verdicts(result: dict):
    text = table(result)
    assert "| hash grid against nerfstudio's |" in text and "| >= 12 |" in text
    assert text.count("reached") + text.count("missed") >= 8


def test_verdicts():
    assert Figure("x", 13, "times", at_least=12).verdict == "reached"
    assert Figure("x", 11, "times", at_least=12).verdict == "missed"
    assert Figure("x", 61, "s", at_most=60).verdict == "missed"
    assert Figure("x", None, "s", at_most=60).verdict == "not measured" and Figure("x", 1, "s").verdict == ""


def test_our_code_is_measured_with_only_torch_numpy_numba_and_h5py(tmp_path: Path):
    parts = [part for part in PARTS if part not in ("index", "scaling")]
    finished = subprocess.run(
        [sys.executable, "-c", BARE, "--quick", *parts],
        capture_output=True, text=True, timeout=300, check=False, cwd=tmp_path, env={**os.environ},
    )  # fmt: skip
    assert finished.returncode == 0, finished.stderr[-3000:]
    figures = {figure["what"]: figure["value"] for figure in json.loads(finished.stdout)["figures"]}
    assert figures["step of 512 pairs"] > 0 and figures["training rays per second against nerfacto"] is None
