"""Evaluation of another program's result on a scene, from its files."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ebarf_ns.errors import EvaluationError
from ebarf_ns.evaluation.frames import image_errors, read_frame, read_pixels
from ebarf_ns.evaluation.trajectory_error import trajectory_results
from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.scene import Scene

_DARKEST = 1e-4


def evaluate_files(scene: Scene, refined: Path, renders: Path | None) -> dict[str, Any]:
    """Errors of a trajectory and, if given, of renders named like the scene's frames, computed as for our own runs.

    Renders are linear in intensity; those of frames outside the trajectory's span count like the others. Raises
    :class:`EvaluationError`.
    """
    results: dict[str, Any] = {}
    if scene.groundtruth:
        results |= trajectory_results(read_tum(refined), read_tum(scene.groundtruth))
    if renders:
        rendered = [_log_brightness(_find(renders, frame.path.stem)) for frame in scene.frames]
        references = [read_frame(frame) for frame in scene.frames]
        for picture, reference, frame in zip(rendered, references, scene.frames, strict=True):
            if picture.shape != reference.shape:
                raise EvaluationError(
                    f"{renders}: the picture of {frame.path.stem} has shape {picture.shape}, expected {reference.shape}"
                )
        results |= image_errors(rendered, references)
    return results


def _find(folder: Path, stem: str) -> Path:
    found = sorted(folder.glob(f"{stem}.*"))
    if not found:
        raise EvaluationError(f"{folder}: holds no {stem}.*, expected a picture for every frame of the scene")
    return found[0]


def _log_brightness(path: Path) -> Float[np.ndarray, "height width"]:
    return np.log(np.maximum(read_pixels(path), _DARKEST))
