"""A bad scene ends ns-train and ebarf inspect in one line that names file, place, value and expectation."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from tests.conftest import run_command


def edit_json(**changes: object) -> Callable[[Path], None]:
    def edit(scene: Path) -> None:
        content = json.loads((scene / "scene.json").read_text())
        (scene / "scene.json").write_text(json.dumps({**content, **changes}))

    return edit


def edit_column(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def edit(scene: Path) -> None:
        with h5py.File(scene / "events.h5", "r+") as file:
            column = change(np.asarray(file[f"events/{name}"]))
            del file[f"events/{name}"]
            file[f"events/{name}"] = column

    return edit


def edit_trajectory(change: Callable[[list[str]], list[str]]) -> Callable[[Path], None]:
    def edit(scene: Path) -> None:
        lines = [line for line in (scene / "trajectory.txt").read_text().splitlines() if not line.startswith("#")]
        (scene / "trajectory.txt").write_text("\n".join(change(lines)) + "\n")

    return edit


def at(row: int, value: int) -> Callable[[np.ndarray], np.ndarray]:
    def change(column: np.ndarray) -> np.ndarray:
        column[row] = value
        return column

    return change


def scaled_times(factor: float) -> Callable[[list[str]], list[str]]:
    def change(lines: list[str]) -> list[str]:
        return [f"{float(line.split()[0]) * factor:.6f} {line.split(maxsplit=1)[1]}" for line in lines]

    return change


CASES = {
    "no events file": (lambda scene: (scene / "events.h5").unlink(), "no such file, expected the recording"),
    "wrong key": (edit_json(evnets=1), "unknown key evnets"),
    "unsorted": (edit_column("t", lambda t: t[::-1]), "expected a time not before those of the events above it"),
    "ragged": (edit_column("x", lambda x: x[:-1]), "differ in length"),
    "outside the sensor": (edit_column("x", at(7, 48)), "/events/x row 7 is 48, expected 0 to 47"),
    "polarity": (edit_column("p", at(3, 2)), "/events/p row 3 is 2, expected 0 (darker) or 1 (brighter)"),
    "not HDF5": (lambda scene: (scene / "events.h5").write_text("x y t p"), "not a readable HDF5 file"),
    "one keyframe": (edit_trajectory(lambda lines: lines[:1]), "at least 2 keyframes, got 1"),
    "duplicate keyframe": (edit_trajectory(lambda lines: [*lines[:3], *lines[2:]]), "trajectory.txt:4: timestamp"),
    "decreasing keyframes": (edit_trajectory(lambda lines: lines[::-1]), "keyframe times must increase"),
    "zero quaternion": (edit_trajectory(lambda lines: ["0 0 0 0 0 0 0 0", *lines[1:]]), "has length 0, expected 1"),
    "not a number": (edit_trajectory(lambda lines: ["0 nan 0 0 0 0 0 1", *lines[1:]]), "tx is nan, expected a finite"),
    "bounds elsewhere": (edit_json(bounds=[[90, 90, 90], [91, 91, 91]]), "hold none of the 11 keyframes"),
    "frame of another size": (
        lambda scene: cv2.imwrite(str(scene / "frames" / "0001.png"), np.zeros((9, 7), np.uint8)),
        "0001.png: 7x9 pixels, expected the camera's 48x36",
    ),
    "spoilt ground truth": (lambda scene: (scene / "groundtruth.txt").write_text("0 1 2"), "groundtruth.txt:1: 3 col"),
    "another clock": (edit_trajectory(lambda lines: [f"7{line}" for line in lines]), "would let both begin together"),
    "milliseconds": (edit_trajectory(scaled_times(1e3)), "expected trajectory.txt to be in seconds on the clock"),
    "no such frame": (lambda scene: (scene / "frames" / "0001.png").unlink(), "0001.png: no such file, expected a val"),
    "no frames": (lambda scene: shutil.rmtree(scene / "frames"), "and 2 more that are named in"),
}
TRAINING = ["unsorted", "bounds elsewhere", "frame of another size", "another clock", "milliseconds"]


@pytest.fixture
def scene(tiny_scene: Path, tmp_path: Path) -> Path:
    return shutil.copytree(tiny_scene, tmp_path / "scene")


@pytest.mark.parametrize("case", CASES)
def test_inspect_says_what_is_wrong(scene: Path, case: str):
    spoil, words = CASES[case]
    spoil(scene)
    finished = run_command("ebarf", "inspect", scene)
    assert finished.code == 2 and finished.output == "" and words in finished.errors
    assert finished.errors.startswith("error: ") and finished.errors.count("\n") == 1


@pytest.mark.parametrize("case", TRAINING)
def test_train_says_what_is_wrong_and_leaves_no_half_run(scene: Path, tmp_path: Path, case: str):
    spoil, words = CASES[case]
    spoil(scene)
    finished = run_command(
        "ns-train", "ebarf", "--data", scene, "--output-dir", tmp_path / "out", "--vis=tensorboard", "--timestamp=run"
    )
    assert finished.code == 2 and words in finished.errors and "Traceback" not in finished.errors + finished.output
    left = [path.name for path in (tmp_path / "out").rglob("*") if path.is_file()]
    assert "metrics.jsonl" not in left and not any(name.endswith(".ckpt") for name in left)
