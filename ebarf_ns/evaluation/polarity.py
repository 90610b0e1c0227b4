"""Agreement of event polarities with brightness changes between frames."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ebarf_ns.evaluation.frames import read_frame
from ebarf_ns.events.recording import RecordingFile
from ebarf_ns.scene import Scene

_MOST_PAIRS, _LONGEST_US, _FEWEST_PIXELS = 12, 200_000, 100
_CONTRADICTS_BELOW, _MOST_OF_PAIRS = -0.2, 0.8
_DARKEST = 0.01


def polarity_correlations(scene: Scene) -> list[float]:
    """Return correlations of frame-to-frame brightness changes with event polarity sums, over active pixels.

    Uses up to 12 pairs of consecutive frames of the event camera itself, at most 0.2 s apart. Pairs with fewer than 100
    active pixels, or without any change, are skipped.
    """
    camera = scene.camera
    frames = [
        one
        for one in scene.frames
        if one.camera == camera and np.allclose(one.event_camera_from_frame_camera, np.eye(4))
    ]
    pairs = [two for two in pairwise(frames) if 0 < two[1].t_us - two[0].t_us <= _LONGEST_US]
    pairs = pairs[:: max(len(pairs) // _MOST_PAIRS, 1)][:_MOST_PAIRS]
    recording = RecordingFile(scene.events, camera.width, camera.height)
    found = []
    for before, after in pairs:
        events = recording.window(before.t_us, after.t_us)
        pixels = events.pixels(camera.width)
        total = np.bincount(pixels, events.polarity, camera.width * camera.height)
        active = np.bincount(pixels, minlength=len(total)) > 0
        change = np.diff([_log_brightness(read_frame(one)).ravel()[active] for one in (before, after)], axis=0)[0]
        if active.sum() >= _FEWEST_PIXELS and min(total[active].std(), change.std()) > 0:
            found.append(float(np.corrcoef(total[active], change)[0, 1]))
    return found


def _log_brightness(frame: np.ndarray) -> np.ndarray:
    return np.log(frame + _DARKEST * max(float(frame.max()), 1e-9))


def polarity_contradicted(correlations: list[float]) -> str | None:
    """Return a warning if frames contradict the polarity in most of at least three pairs, None otherwise."""
    against = [one for one in correlations if one < _CONTRADICTS_BELOW]
    if len(correlations) < 3 or len(against) < _MOST_OF_PAIRS * len(correlations):
        return None
    return (
        f"frames become darker where events report brighter (correlation {np.median(correlations):.2f}, in "
        f"{len(against)} of {len(correlations)} pairs of frames): polarity may be inverted; ebarf process "
        "--flip-polarity corrects it"
    )
