"""A finished run, opened from its folder: its field and its trajectory in the input's world frame."""

from __future__ import annotations

import sys
from math import exp, pi
from typing import TYPE_CHECKING

import numpy as np
import torch

from ebarf_ns.errors import EvaluationError
from ebarf_ns.evaluation.report import read_metrics
from ebarf_ns.export.subject import Seen
from ebarf_ns.geometry.trajectory import Poses, Trajectory
from ebarf_ns.nerf.checkpoints import newest_whole, read_checkpoint
from ebarf_ns.nerf.run_config import read_run_config
from ebarf_ns.photometry.brightness import log_brightness
from ebarf_ns.radiance.ray_sampling import Rays
from ebarf_ns.simulation.sensor import SensorModel

if TYPE_CHECKING:
    from pathlib import Path

    from jaxtyping import Float, Int64
    from torch import Tensor

    from ebarf_ns.nerf.pipeline import EbarfPipeline

_RAYS_AT_ONCE = 8192
# Residual density lies in front of surfaces, not behind them, so the median depth is too small. On simulated scenes,
# this quantile has the smallest bias.
_SURFACE_QUANTILE, _SPREAD_QUANTILES = 2 / 3, (1 / 3, 5 / 6)


class FinishedRun:
    """A finished run, as :mod:`ebarf_ns.export` uses it."""

    def __init__(self, pipeline: EbarfPipeline, sensor: SensorModel):
        self._model, self.sensor = pipeline.model, sensor
        self._normalization = self._model.kwargs["metadata"]["normalization"]
        self.scene = pipeline.scene
        intrinsics = self._model.intrinsics
        self.camera = intrinsics.refined() if intrinsics else self.scene.camera
        self.trajectory = pipeline.trajectory()

    @torch.no_grad()
    def poses_at(self, t_us: Int64[Tensor, "times"]) -> Poses:
        """Refined poses, float64; times outside the trajectory's span are clamped to it."""
        keyframes = self._model.camera_optimizer
        poses = keyframes.poses_at(t_us.to(keyframes.keyframe_t_us))
        return self._normalization.invert(Trajectory(t_us, poses)).poses

    @torch.no_grad()
    def see(self, origin: Float[np.ndarray, "rays 3"], direction: Float[np.ndarray, "rays 3"]) -> Seen:
        """Cast rays with unit directions."""
        centre, scale = self._normalization.centre.numpy(), self._normalization.scale
        device = self._model.device
        start = torch.from_numpy(((origin - centre) * scale).astype(np.float32)).to(device).split(_RAYS_AT_ONCE)
        ahead = torch.from_numpy(direction.astype(np.float32)).to(device).split(_RAYS_AT_ONCE)
        parts = [self._see(Rays(*some)) for some in zip(start, ahead, strict=True)]
        brightness, distance, spread, accumulation = (
            torch.cat(column).cpu().numpy() for column in zip(*parts, strict=True)
        )
        return Seen(brightness, distance / scale, spread / scale, accumulation)

    def _see(self, rays: Rays) -> tuple[Tensor, ...]:
        rendered = self._model.renderer(rays)
        before, after = map(rendered.depth_quantile, _SPREAD_QUANTILES)
        brightness = log_brightness(rendered.intensity, self._model.config.brightness)
        return brightness, rendered.depth_quantile(_SURFACE_QUANTILE), after - before, rendered.accumulation


def open_run(folder: Path) -> FinishedRun:
    """Open the newest valid checkpoint of a run, whose folder may have been moved.

    No code in the folder is run. Raises :class:`EvaluationError` and the errors of its scene and checkpoints.
    """
    config = read_run_config(folder / "config.yml")
    checkpoint, damaged = newest_whole(folder / "nerfstudio_models")
    for error in damaged:
        sys.stderr.write(f"{error}; {checkpoint.name} is used instead\n")
    state = read_checkpoint(checkpoint)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        if (folder / "scene" / "scene.json").is_file():
            config.pipeline.datamanager.dataparser.kept = folder / "scene"  # pyright: ignore[reportAttributeAccessIssue]
        pipeline: EbarfPipeline = config.pipeline.setup(device=device, test_mode="inference").eval()
        pipeline.load_pipeline(state["pipeline"], state["step"])
    except (AttributeError, TypeError, ValueError, LookupError, RuntimeError, MemoryError) as error:
        # The two files may contain anything.
        said = str(error).splitlines()[-1].strip() if str(error) else type(error).__name__
        raise EvaluationError(
            f"{folder}: cannot be opened ({said}), expected config.yml and {checkpoint.name} to be of one ebarf run"
        ) from None
    # After training, a time constant of zero means no delay.
    pipeline.requires_grad_(False)
    return FinishedRun(pipeline, _sensor(pipeline, folder))


def _sensor(pipeline: EbarfPipeline, folder: Path) -> SensorModel:
    """The given and learned sensor parameters; with Eq. 6, thresholds are those implied by held-out events."""
    model, response = pipeline.model, pipeline.model.sensor
    if model.normalized:
        last = read_metrics(folder)[1][-1]
        on, off = last.get("implied_threshold_on") or 1.0, last.get("implied_threshold_off") or 1.0
    else:
        on, off = map(float, response())
    stated = pipeline.scene.refractory_us
    blind_us = stated if stated is not None else pipeline.datamanager.refractory_us
    if not response.delays:
        return SensorModel(on, off, refractory_us=blind_us)
    total, weight = response.seen_brightness.tolist()
    cutoff_hz = 1e6 / (2 * pi * float(response.time_constant_us))
    return SensorModel(on, off, refractory_us=blind_us, cutoff_hz=cutoff_hz, cutoff_reference=exp(total / weight))
