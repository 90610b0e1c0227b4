"""A room that is known, in place of a trained one."""

from pathlib import Path

import pytest

from ebarf_ns.scene import Scene
from tests.export.subjects import PINHOLE, KnownRoom


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path, tmp_path / "events.h5", tmp_path / "trajectory.txt", PINHOLE)


@pytest.fixture
def known(scene: Scene) -> KnownRoom:
    return KnownRoom(scene)
