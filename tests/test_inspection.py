"""What looks wrong in a scene is said."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import pytest

from ebarf_ns.inspection import inspect_scene


def edited(**changes: object) -> Callable[[Path], None]:
    def edit(scene: Path) -> None:
        content = json.loads((scene / "scene.json").read_text())
        camera = {**content["camera"], **changes.pop("camera", {})}  # pyright: ignore
        changed = {**content, **changes, "camera": camera, "frames": None}
        (scene / "scene.json").write_text(json.dumps(changed))

    return edit


def one_pixel(scene: Path) -> None:
    with h5py.File(scene / "events.h5", "r+") as file:
        for name in "xy":
            file[f"events/{name}"][:] = 7  # pyright: ignore


def long_gap(scene: Path) -> None:
    lines = [line for line in (scene / "trajectory.txt").read_text().splitlines() if not line.startswith("#")]
    near = [f"{0.001 * k:.6f} {line.split(maxsplit=1)[1]}" for k, line in enumerate(lines[:-1])]
    far = f"{0.001 * (len(near) - 1 + 201):.6f} {lines[-1].split(maxsplit=1)[1]}"
    (scene / "trajectory.txt").write_text("\n".join([*near, far]) + "\n")


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (one_pixel, "all events are at 1 of 1,728 pixels"),
        (edited(camera={"fx": 0.01, "fy": 0.01}), "the camera sees 180 by 180 degrees"),
        (edited(camera={"fx": 4100, "fy": 4100}), "the camera sees 0.671 by 0.503 degrees"),
        (edited(bounds=[[-3, -3, -3], [-0.88, 3, 3]]), "64% of the keyframes lie outside the bounds"),
        (edited(bounds=[[-40, -40, -3], [40, 40, 3]]), "times as far away in some directions as in others"),
        (long_gap, "the longest gap between keyframes is 201 ms, 201 times the median"),
    ],
)
def test_what_looks_wrong_is_said(tiny_scene: Path, tmp_path: Path, edit: Callable[[Path], None], words: str):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    assert not any(words in sentence for sentence in inspect_scene(scene).suspicions)
    edit(scene)
    suspicions = inspect_scene(scene).suspicions
    assert any(words in sentence for sentence in suspicions), suspicions
