"""Events against frames: agreeing, inverted, and telling nothing."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from ebarf_ns.evaluation.polarity import polarity_contradicted, polarity_correlations
from ebarf_ns.events.recording import Recording, write_recording
from ebarf_ns.geometry.cameras import Camera
from ebarf_ns.scene import Frame, Scene, read_scene
from tests.conftest import DATA

SIZE = (48, 36)
IDENTITY = tuple(map(tuple, np.eye(4).tolist()))


def scene(folder: Path, sign: int, seed: int = 0) -> Scene:
    """A blurred pattern that slides by two columns between frames; events are the changes between them, in order."""
    random = np.random.default_rng(seed)
    width, height = SIZE
    camera = Camera("pinhole", width, height, 50.0, 50.0, 24.0, 18.0)
    pattern = cv2.GaussianBlur(random.uniform(0, 1, (height, 4 * width)).astype(np.float32), (0, 0), 2)
    pattern = (pattern - pattern.min()) / np.ptp(pattern)
    frames, pictures, columns = [], [], []
    for k in range(6):
        pictures.append(np.rint(255 * pattern[:, 2 * k : 2 * k + width]))
        path = folder / f"{k}.png"
        cv2.imwrite(str(path), pictures[-1].astype(np.uint8))
        frames.append(Frame(path, 50_000 * k, camera, IDENTITY, "linear"))
    for k in range(5):
        change = (pictures[k + 1] - pictures[k]).ravel()
        pixel = np.flatnonzero(np.abs(change) > 5)
        polarity = sign * np.sign(change[pixel]) if sign else random.choice([-1, 1], len(pixel))
        t_us = np.sort(random.integers(50_000 * k + 1, 50_000 * (k + 1), len(pixel)))
        columns.append((pixel % width, pixel // width, t_us, polarity))
    x, y, t_us, polarity = (np.concatenate(one) for one in zip(*columns, strict=True))
    events = Recording(x.astype(np.uint16), y.astype(np.uint16), t_us, polarity.astype(np.int8))
    write_recording(folder / "events.h5", [events], folder)
    return Scene(folder, folder / "events.h5", folder / "trajectory.txt", camera, frames=tuple(frames))


@pytest.mark.parametrize("seed", range(3))
def test_polarity_that_agrees_with_frames_is_not_suspected(tmp_path: Path, seed: int):
    correlations = polarity_correlations(scene(tmp_path, 1, seed))
    assert len(correlations) == 5 and min(correlations) > 0.3
    assert polarity_contradicted(correlations) is None


def test_inverted_polarity_is_suspected(tmp_path: Path):
    sentence = polarity_contradicted(polarity_correlations(scene(tmp_path, -1)))
    assert sentence and "--flip-polarity" in sentence and "5 of 5" in sentence


def test_polarity_without_any_meaning_is_not_called_inverted(tmp_path: Path):
    correlations = polarity_correlations(scene(tmp_path, 0))
    assert max(np.abs(correlations)) < 0.2 and polarity_contradicted(correlations) is None


def test_too_few_frames_tell_nothing():
    assert polarity_contradicted([-0.9, -0.9]) is None and polarity_contradicted([]) is None


@pytest.mark.parametrize("name", ["office_pan_tilt", "shapes_rotation", "photos_davis", "photos_dim", "photos_clean"])
def test_recordings_from_elsewhere_agree_with_their_frames(name: str):
    if not (DATA / name / "scene.json").is_file():
        pytest.skip(f"{DATA / name} is not here")
    correlations = polarity_correlations(read_scene(DATA / name))
    assert len(correlations) >= 3 and min(correlations) > 0.2
