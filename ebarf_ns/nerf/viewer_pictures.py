"""Images in the viewer's panel: four images of one time, and training curves."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch

from ebarf_ns.errors import EbarfError
from ebarf_ns.evaluation.frames import read_frame
from ebarf_ns.events.recording import RecordingFile, accumulate
from ebarf_ns.nerf.moments import brightness_at, pixel_lattice, predicted_events
from ebarf_ns.nerf.views import for_people

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jaxtyping import UInt8
    from torch import Tensor

    from ebarf_ns.nerf.pipeline import EbarfPipeline

_WIDEST_PX = 128
_LONGEST_HALF_US = 10_000
_DARK, _LIGHT = (36,), (230,)
_CURVES = (
    ("loss", "loss", "log"),
    ("heldout_event_loss", "unexplained events", "linear"),
    ("corrected_position", "position", "linear"),
    ("corrected_rotation_deg", "rotation [deg]", "linear"),
)
_ERRORS = {"corrected_position": "ate_m", "corrected_rotation_deg": "rotation_deg"}


@dataclass(frozen=True)
class Moment:
    """Titled 8-bit grey images of one time, and the label of that time."""

    pictures: dict[str, UInt8[np.ndarray, "height width"]]
    says: str


def half_window_us(t_us: Tensor) -> int:
    """Return half the window of event images at these keyframe times [us]."""
    between = int(t_us.diff().median()) if len(t_us) > 1 else 2 * _LONGEST_HALF_US
    return max(min(between // 2, _LONGEST_HALF_US), 1)


def event_picture(pipeline: EbarfPipeline, t_us: int, half_us: int) -> UInt8[np.ndarray, "height width"]:
    """Return an image of the events around a time; uniform grey if the recording is missing."""
    scene = pipeline.scene
    width, height = scene.camera.width, scene.camera.height
    try:
        file = RecordingFile(scene.events, width, height)
        return accumulate(file.window(t_us - half_us, t_us + half_us), width, height)
    except EbarfError:
        return np.full((height, width), 128, np.uint8)


def recorded(pipeline: EbarfPipeline, t_us: int, half_us: int) -> Moment:
    """Return the recorded events around a time, and the frame nearest to it."""
    pictures = {f"events, {2e-3 * half_us:.3g} ms": event_picture(pipeline, t_us, half_us)}
    frame = min(pipeline.scene.frames, key=lambda frame: abs(frame.t_us - t_us), default=None)
    if frame and frame.path.is_file():
        try:
            pictures[f"frame at {1e-6 * frame.t_us:.3f} s"] = for_people(read_frame(frame))
        except EbarfError:
            pass
    return Moment(pictures, f"{1e-6 * t_us:.3f} s")


@torch.no_grad()
def rendered(pipeline: EbarfPipeline, t_us: int, half_us: int) -> dict[str, UInt8[np.ndarray, "height width"]]:
    """Return the field's log brightness and its predicted events around a time, at reduced resolution."""
    pixel = pixel_lattice(pipeline.scene.camera, _WIDEST_PX)
    events = predicted_events(pipeline, t_us, half_us, pixel)
    grey = pipeline.model.grey(brightness_at(pipeline, t_us, pixel))
    return {
        "events predicted": (128 + (32 * events).clamp(-128, 127)).to(torch.uint8).cpu().numpy(),
        "log brightness": (255 * grey).to(torch.uint8).cpu().numpy(),
    }


def side_by_side(pictures: dict[str, UInt8[np.ndarray, "height width"]], width: int = 2 * 300) -> bytes:
    """Return images in two columns, each below its title, as a PNG."""
    half, bar = width // 2 - 4, 34
    tiles = []
    for name, grey in pictures.items():
        size = (half, max(round(half * grey.shape[0] / grey.shape[1]), 1))
        shrinks = size[0] < grey.shape[1]
        large = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST)
        tile = cv2.copyMakeBorder(large, bar, 4, 2, 2, cv2.BORDER_CONSTANT, value=_DARK)
        cv2.putText(tile, name, (4, bar - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.8, _LIGHT, 1, cv2.LINE_AA)
        tiles.append(tile)
    if len(tiles) % 2:
        tiles.append(np.full_like(tiles[-1], _DARK[0]))
    tall = max(len(tile) for tile in tiles)
    tiles = [cv2.copyMakeBorder(tile, 0, tall - len(tile), 0, 0, cv2.BORDER_CONSTANT, value=_DARK) for tile in tiles]
    rows = [np.concatenate(tiles[k : k + 2], axis=1) for k in range(0, len(tiles), 2)]
    _, png = cv2.imencode(".png", np.concatenate(rows))
    return png.tobytes()


def curves(records: Sequence[dict[str, Any]], width: int = 2 * 300) -> bytes:
    """Return curves of loss, unexplained events and pose corrections over the steps, as a PNG; pose errors are dotted.

    viser's own plots are wider than its panel and load 3 MB of scripts.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width / 100, 1.5 * width / 100), dpi=100, layout="constrained", facecolor="#242424")
    rows = figure.subplots(len(_CURVES), sharex=True)
    for axes, (name, title, scale) in zip(rows, _CURVES, strict=True):
        drawn = {
            name: ("#ff7f0e", "-", "moved by training"),
            _ERRORS.get(name): ("#2ca02c", ":", "error vs. reference"),
        }
        for key, (color, dashes, legend) in drawn.items():
            known = [(one["step"], one[key]) for one in records if one.get(key) is not None]
            if known:
                steps, values = zip(*sorted(known), strict=True)
                marker = "o" if len(known) < 20 else ""
                axes.plot(steps, values, color=color, linestyle=dashes, marker=marker, markersize=4, label=legend)
        axes.set_title(title, color="#dddddd", fontsize=16, loc="left")
        axes.set_facecolor("#1a1a1a")
        axes.tick_params(which="both", colors="#bbbbbb", labelsize=13)
        axes.grid(color="#3a3a3a")
        heights = [height for line in axes.lines for height in line.get_ydata()]
        if scale == "log" and heights and 0 < 10 * min(heights) < max(heights):
            axes.set_yscale("log")
        else:
            axes.set_ylim(bottom=0)
    if rows[-1].lines:
        rows[-1].legend(fontsize=13, labelcolor="#dddddd", facecolor="#242424", edgecolor="#3a3a3a")
    rows[-1].set_xlabel("step", color="#bbbbbb", fontsize=13)
    png = io.BytesIO()
    figure.savefig(png, format="png", facecolor=figure.get_facecolor())
    return png.getvalue()
