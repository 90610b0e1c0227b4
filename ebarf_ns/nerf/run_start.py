"""The start of a run: its scene, plan and configuration, and the header of its metrics."""

from __future__ import annotations

import platform
import shlex
import sys
from copy import deepcopy
from dataclasses import asdict, replace
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import yaml

from ebarf_ns.errors import TrainingError
from ebarf_ns.events.recording import RecordingFile
from ebarf_ns.events.sensor_facts import identify_recording
from ebarf_ns.files import whole_file
from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.machine import free_threads
from ebarf_ns.nerf.dataparser import keep_scene, moved
from ebarf_ns.nerf.metrics_file import changed_parts, config_digest, flags_of, scene_digest
from ebarf_ns.nerf.terminal import say
from ebarf_ns.odometry.output import complete_scene
from ebarf_ns.plan import Line, apply_plan, plan_for
from ebarf_ns.radiance.hash_grid import fastest_backend
from ebarf_ns.scene import Scene, check_bounds, read_scene

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

    from ebarf_ns.nerf.alignment import Alignment
    from ebarf_ns.nerf.pipeline import EbarfPipeline


def read_scene_of(config: TrainerConfig) -> Scene:
    """The scene that a configuration names; estimates a missing trajectory if enabled. Raises the package's errors."""
    datamanager: Any = config.pipeline.datamanager
    folder = Path(datamanager.data or datamanager.dataparser.data)
    if datamanager.dataparser.kept and not folder.is_dir():
        raise TrainingError(moved(replace(datamanager.dataparser, data=folder)))
    if getattr(config, "estimate_trajectory", False):
        complete_scene(folder, lambda sentence: say(sentence))
    return read_scene(folder)


def check_scene_is_the_same(scene: Scene, header: dict[str, Any], checkpoint: Path) -> None:
    """Raise :class:`TrainingError` if the scene has changed since the run with this header was trained."""
    if changed := changed_parts(scene, header):
        raise TrainingError(
            f"{scene.folder}: {', '.join(changed)} changed since {checkpoint} was made; expected the scene that it was "
            "trained on, or --allow-changed-scene True"
        )


def plan_run(config: TrainerConfig, scene: Scene, device: str, header: dict[str, Any]) -> list[Line]:
    """Fill in the settings that a configuration leaves to the plan.

    ``header`` is that of the resumed run, if any; its plan is kept, even if this machine would plan differently.
    """
    datamanager: Any = config.pipeline.datamanager
    model: Any = config.pipeline.model
    trajectory = read_tum(scene.trajectory)
    check_bounds(scene, trajectory)
    file = RecordingFile(scene.events, scene.camera.width, scene.camera.height)
    events, _, _ = file.span()
    refractory_us = scene.refractory_us if datamanager.refractory_us is None else datamanager.refractory_us
    facts = identify_recording(file, (int(trajectory.t_us[0]), int(trajectory.t_us[-1])), refractory_us)
    if model.camera_optimizer.mode == "off" and model.camera_optimizer.longest_gap_us is None:
        # A fixed trajectory needs no inserted keyframes.
        model.camera_optimizer.longest_gap_us = 0
    start = model.camera_optimizer.start(trajectory)
    normalized = model.loss == "normalized"
    kind = "cuda" if device.startswith("cuda") else "cpu"
    lines = plan_for(scene, start, events, kind, model.grid_coarsest, model.grid_finest, normalized, facts)
    lines.append(free_threads())
    resumed = {
        field: Line(field, made["value"], "as in the run resumed") for field, made in header.get("plan", {}).items()
    }
    return apply_plan([resumed.get(line.field, line) for line in lines], config)


def opening_config(config: TrainerConfig, folder: Path) -> str:
    """The content of ``config.yml`` for scripts that open the run; building the pipeline changes the configuration."""
    # Scripts open the newest checkpoint, not the one that the run started from.
    opened: Any = deepcopy(replace(config, load_dir=None, load_step=None, load_checkpoint=None))
    opened.pipeline.datamanager.dataparser.kept = folder / "scene"
    return yaml.dump(opened)


def keep_run(opening: str, config: TrainerConfig, scene: Scene, folder: Path) -> None:
    """Write the files needed to open the run again: its configuration and its copy of the scene."""
    kept = folder / "scene"
    keep_scene(scene, kept)
    datamanager: Any = config.pipeline.datamanager
    datamanager.dataparser.kept = kept
    with whole_file(folder / "config.yml") as temporary:
        temporary.write_text(opening, encoding="utf-8")


def run_header(
    config: TrainerConfig, pipeline: EbarfPipeline, device: str, plan: list[Line], alignment: Alignment | None
) -> dict[str, Any]:
    """The header of ``metrics.jsonl``."""
    flags = flags_of(config)
    return {
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "date": date.today().isoformat(),
        "versions": {name: version(name) for name in ("ebarf_ns", "nerfstudio", "torch", "numpy")},
        "method": config.method_name,
        "device": torch.cuda.get_device_name() if device.startswith("cuda") else platform.processor() or "cpu",
        "threads": torch.get_num_threads(),
        "seed": config.machine.seed,
        "scene": str(pipeline.scene.folder.resolve()),
        "scene_digest": scene_digest(pipeline.scene),
        "config_digest": config_digest(flags),
        "hash_grid": fastest_backend(torch.zeros(0, 3, device=device)),
        "blind_us": pipeline.datamanager.refractory_us,
        "hot_pixels_left_out": pipeline.datamanager.hot_pixels_left_out,
        "alignment": asdict(alignment) if alignment else None,
        "plan": {line.field: {"value": line.value, "reason": line.reason} for line in plan},
        "flags": flags,
    }
