"""Predicted events: the sensor simulated in the trained scene, along the refined trajectory."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from ebarf_ns.errors import ExportError
from ebarf_ns.events.recording import Recording, RecordingFile, write_recording
from ebarf_ns.export.pictures import span_us
from ebarf_ns.simulation.record import record
from ebarf_ns.simulation.view import View

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from jaxtyping import Float

    from ebarf_ns.export.settings import Span
    from ebarf_ns.export.subject import Subject

_SEED = 0
_NEAREST_PERCENT = 5


@dataclass(frozen=True)
class _TrainedScene:
    """The trained scene as surroundings for the simulator."""

    subject: Subject

    def cast(
        self, origin: Float[np.ndarray, "rays 3"], direction: Float[np.ndarray, "rays 3"]
    ) -> tuple[Float[np.ndarray, "rays"], Float[np.ndarray, "rays"]]:
        """Return radiance, and distances that determine the rendering rate, in the trajectory's unit."""
        seen = self.subject.see(origin, direction)
        # A few rays that end in residual density near the camera would require a render every microsecond.
        distance = (
            np.maximum(seen.distance, np.percentile(seen.distance, _NEAREST_PERCENT)) if len(origin) else seen.distance
        )
        return np.exp(seen.brightness.astype(np.float64)), distance.astype(np.float64)


@dataclass(frozen=True)
class _RefinedMotion:
    """The refined trajectory as a motion that starts at time 0."""

    subject: Subject
    start_us: int

    def position(self, t_us: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times 3"]:
        """Return camera centres, in the trajectory's unit."""
        return self._matrices(t_us)[:, :, 3]

    def rotation(self, t_us: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times 3 3"]:
        """Return camera-to-world rotations, OpenCV axes."""
        return self._matrices(t_us)[:, :, :3]

    def _matrices(self, t_us: np.ndarray) -> np.ndarray:
        whole_us = torch.from_numpy(np.rint(t_us).astype(np.int64) + self.start_us)
        return self.subject.poses_at(whole_us).matrix().double().numpy()


def write_events(
    subject: Subject, span: Span, path: Path, progress: Callable[[float], None] = lambda fraction: None
) -> Recording:
    """Simulate the events of a time span, write them in the layout of events.h5, and return them.

    Raises :class:`ExportError` for invalid spans.
    """
    start_us, end_us = span_us(subject, span)
    if start_us == end_us:
        raise ExportError(f"the requested span is {start_us} to {end_us} us, expected a longer one")
    view = View(_TrainedScene(subject), _RefinedMotion(subject, start_us), subject.camera, rays_per_pixel=1)
    events = record(view, subject.sensor, end_us - start_us, _SEED, progress)
    events = replace(events, t_us=events.t_us + start_us)
    write_recording(path, [events], source=path)
    return events


def recorded(subject: Subject, span: Span) -> Recording:
    """Return the recorded events of a time span; raises :class:`RecordingError` if they cannot be read."""
    camera = subject.scene.camera
    return RecordingFile(subject.scene.events, camera.width, camera.height).window(*span_us(subject, span))


def agreement(predicted: Recording, real: Recording, width: int, height: int) -> dict[str, float]:
    """Return the numbers of events, and the correlations of their counts per pixel, for each polarity."""
    numbers: dict[str, float] = {"predicted": len(predicted), "recorded": len(real)}
    for name, polarity in (("brighter", 1), ("darker", -1)):
        counts = [
            np.bincount(one.select(one.polarity == polarity).pixels(width), minlength=width * height)
            for one in (predicted, real)
        ]
        varied = all(count.std() > 0 for count in counts)
        numbers[f"{name}_correlation"] = float(np.corrcoef(counts)[0, 1]) if varied else 0.0
    return numbers
