"""Recorded and predicted events in a time window."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from ebarf_ns.events.recording import RecordingFile
from ebarf_ns.files import whole_file

if TYPE_CHECKING:
    from pathlib import Path

    from jaxtyping import Float, Int64
    from torch import Tensor

    from ebarf_ns.geometry.cameras import Camera
    from ebarf_ns.nerf.pipeline import EbarfPipeline

_RAYS_PER_BATCH = 4096
_WIDEST_PX, _WINDOWS, _LONGEST_HALF_US = 240, 4, 10_000


def pixel_lattice(camera: Camera, widest_px: int) -> Int64[Tensor, "rows columns"]:
    """Return the row-major indices of evenly spaced pixels, at most ``widest_px`` per row."""
    spacing = -(-camera.width // widest_px)
    rows = torch.arange(spacing // 2, camera.height, spacing)
    return rows[:, None] * camera.width + torch.arange(spacing // 2, camera.width, spacing)


@torch.no_grad()
def brightness_at(
    pipeline: EbarfPipeline, t_us: int, pixel: Int64[Tensor, "rows columns"]
) -> Float[Tensor, "rows columns"]:
    """Return the field's log brightness at pixels of the event camera at one time."""
    parts = [
        pipeline.model(pipeline.datamanager.rays_at(part, torch.full_like(part, t_us)))["brightness"][:, 0]
        for part in pixel.flatten().split(_RAYS_PER_BATCH)
    ]
    return torch.cat(parts).view(pixel.shape)


@torch.no_grad()
def predicted_events(
    pipeline: EbarfPipeline, t_us: int, half_us: int, pixel: Int64[Tensor, "rows columns"]
) -> Float[Tensor, "rows columns"]:
    """Return the unrounded polarity sums per pixel that the field predicts within ``half_us`` of a time."""
    before, after = (brightness_at(pipeline, t_us + shift_us, pixel) for shift_us in (-half_us, half_us))
    on, off = pipeline.model.sensor()
    change = after - before
    return torch.where(change > 0, change / on, change / off)


def write_moments(pipeline: EbarfPipeline, path: Path) -> None:
    """Write the events of four evenly spaced windows of up to 20 ms for the report; nothing without a recording."""
    camera = pipeline.scene.camera
    if not pipeline.scene.events.is_file():
        return
    keyframe_t_us = pipeline.model.camera_optimizer.keyframe_t_us
    first_us, last_us = int(keyframe_t_us[0]), int(keyframe_t_us[-1])
    half_us = max(min((last_us - first_us) // (4 * _WINDOWS), _LONGEST_HALF_US), 1)
    pixel = pixel_lattice(camera, _WIDEST_PX)
    file = RecordingFile(pipeline.scene.events, camera.width, camera.height)
    centres_us = [first_us + (last_us - first_us) * (2 * k + 1) // (2 * _WINDOWS) for k in range(_WINDOWS)]
    recorded, predicted = [], []
    training = pipeline.model.training
    pipeline.model.eval()
    for t_us in centres_us:
        events = file.window(t_us - half_us, t_us + half_us)
        total = np.bincount(events.pixels(camera.width), events.polarity, camera.width * camera.height)
        recorded.append(total[pixel.numpy()])
        predicted.append(predicted_events(pipeline, t_us, half_us, pixel).cpu().numpy())
    pipeline.model.train(training)
    columns = {"recorded": recorded, "predicted": predicted}
    widths_us = np.full(_WINDOWS, 2 * half_us)
    with whole_file(path) as temporary, temporary.open("wb") as output:
        np.savez_compressed(
            output,
            t_us=np.array(centres_us),
            width_us=widths_us,
            **{name: np.stack(column).astype(np.float32) for name, column in columns.items()},
        )
