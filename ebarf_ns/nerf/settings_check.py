"""Checks of a run's settings, with one-line errors, before anything is done."""

from __future__ import annotations

import re
import sys
from functools import reduce
from typing import TYPE_CHECKING, Any

import torch
from rich.errors import MarkupError
from rich.text import Text

from ebarf_ns.errors import TrainingError
from ebarf_ns.nerf.old_flags import warn_of_old_flags

if TYPE_CHECKING:
    from nerfstudio.configs.base_config import MachineConfig
    from nerfstudio.engine.trainer import TrainerConfig

_ABOVE_0 = ("max_num_iterations", "max_train_seconds")
_LEAST = {
    "machine.seed": 0,
    "pipeline.datamanager.train_num_rays_per_batch": 2,
    "pipeline.datamanager.eval_num_rays_per_batch": 2,
    "pipeline.datamanager.longest_pair": 1,
    "pipeline.datamanager.silent_share": 0,
    "pipeline.datamanager.refractory_us": 0,
    "pipeline.datamanager.blank_share": 0,
    "pipeline.datamanager.doubles_us": 0,
    "pipeline.model.threshold_ratio": 1e-3,
    "pipeline.model.threshold_deviation": 0,
    "pipeline.model.threshold_prior": 0,
    "pipeline.model.time_constant_us": 0,
    "pipeline.model.time_constant_prior": 0,
    "pipeline.datamanager.heldout_share": 0,
    "pipeline.datamanager.index_memory_gib": 1e-6,
    "pipeline.model.grid_levels": 1,
    "pipeline.model.grid_features": 1,
    "pipeline.model.grid_coarsest": 2,
    "pipeline.model.grid_finest": 2,
    "pipeline.model.grid_table_size_log2": 1,
    "pipeline.model.broad_cells": 0,
    "pipeline.model.density_cells": 3,
    "pipeline.model.coarse_samples": 1,
    "pipeline.model.uniform_share": 0,
    "pipeline.model.most_hidden": 1e-6,
    "pipeline.model.huber_delta": 1e-3,
    "pipeline.model.render_variance": 0,
    "pipeline.model.near": 1e-6,
    "pipeline.model.samples": 1,
    "pipeline.model.camera_optimizer.longest_gap_us": 0,
    "pipeline.model.camera_optimizer.keyframe_stride": 1,
    "pipeline.model.camera_optimizer.prior": 0,
    "pipeline.model.camera_optimizer.every": 1,
    "pipeline.model.camera_optimizer.align_steps": 0,
    "averaged_steps": 1,
    "threads": 1,
}
_FREE = re.compile(
    r"(max_|steps_per_|evaluations|overwrite|allow_|vis|viewer|logging|load_|project_name|start_paused|save_only|"
    r"log_gradients|machine\.(num|machine|dist)|pipeline\.datamanager\.(index_memory|eval_))"
)


def check_settings(config: TrainerConfig) -> None:
    """Raise :class:`TrainingError` for an invalid setting; it names the flag, its value and what was expected."""
    warn_of_old_flags(sys.argv)
    _check_scene_is_named(config)
    for flag in _ABOVE_0:
        value = getattr(config, flag)
        if value is not None and not value > 0:
            raise TrainingError(f"--{flag.replace('_', '-')} is {value}, expected more than 0")
    for flag, least in _LEAST.items():
        value = reduce(getattr, flag.split("."), config)
        if value is not None and not value >= least:
            raise TrainingError(f"--{flag.replace('_', '-')} is {value}, expected at least {least}")
    try:
        # Nerfstudio prints the run's folder as rich markup.
        Text.from_markup(str(config.get_base_dir()))
    except MarkupError:
        raise TrainingError(
            f"{config.get_base_dir()}: cannot be printed by nerfstudio, expected a folder without '[/'"
        ) from None
    pipeline: Any = config.pipeline
    silent = pipeline.datamanager.silent_share
    if silent and pipeline.model.loss == "normalized":
        raise TrainingError(
            f"--pipeline.datamanager.silent-share is {silent}, expected 0 with --pipeline.model.loss normalized: "
            "Eq. 6 has no unit for what silence allows"
        )


def _check_scene_is_named(config: TrainerConfig) -> None:
    datamanager: Any = config.pipeline.datamanager
    if datamanager.data is None and datamanager.dataparser.data == type(datamanager.dataparser).data:
        raise TrainingError("no --data given, expected ns-train ebarf --data SCENE")


def check_machine(machine: MachineConfig) -> None:
    """Raise :class:`TrainingError` for devices that this machine lacks."""
    found = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available(), "cpu": True}
    here = [device for device, there in found.items() if there]
    if machine.device_type not in here:
        raise TrainingError(
            f"--machine.device-type is {machine.device_type}, expected one that is here: {', '.join(here)}"
        )
    most = torch.cuda.device_count() if machine.device_type == "cuda" else 1
    if not 1 <= machine.num_devices <= most:
        raise TrainingError(
            f"--machine.num-devices is {machine.num_devices}, expected 1 to {most}, as many as are here"
        )


def changed_flags(before: dict[str, Any], now: dict[str, Any]) -> str:
    """The flags that changed since a run, with their old and new values; empty if none did, or none were recorded.

    Flags for the budget, the output and the display may change in a resumed run and are left out.
    """
    changed = [name for name in now if name in before and before[name] != now[name] and not _FREE.match(name)]
    return ", ".join(f"--{name.replace('_', '-')} {before[name]} (now {now[name]})" for name in changed)
