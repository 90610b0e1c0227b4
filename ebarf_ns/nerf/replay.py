"""Replay of the step that ended a training, with every number checked.

A replay file holds only tensors and plain values, all that the step depends on: the model's state, the batch, and what
the model knows about its scene.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox
from torch import Tensor, nn

from ebarf_ns.errors import TrainingError
from ebarf_ns.geometry.cameras import Camera
from ebarf_ns.geometry.trajectory import Poses, Trajectory
from ebarf_ns.nerf.checkpoints import read_plain, write_plain
from ebarf_ns.nerf.model import EbarfModel, EbarfModelConfig
from ebarf_ns.nerf.trajectory_optimizer import TrajectoryOptimizerConfig
from ebarf_ns.scene import ContrastThreshold, Scene

if TYPE_CHECKING:
    from ebarf_ns.nerf.pipeline import EbarfPipeline

FORMAT = 1
_OUR_LINE = re.compile(r'File ".*?(ebarf_ns/\S+\.py)", line (\d+), in (\w+)')


@dataclass
class Replayed:
    """Findings; names are those of parameters, modules and losses, in the order in which they are computed."""

    step: int
    rays: int
    losses: dict[str, float]
    parameters_not_finite: list[str]
    outputs_not_finite: list[str]
    """Modules whose output is not finite."""
    gradients_not_finite: list[str] = field(default_factory=list)
    gradients_beyond_usual: dict[str, float] = field(default_factory=dict)
    """Ratio of each gradient's norm to its usual norm, if it exceeds 10."""
    anomaly: str = ""
    """The message of torch's anomaly detection, and the source line of the operation."""

    def lines(self) -> list[str]:
        """The findings as human-readable lines."""
        losses = ", ".join(f"{name} {value:.6g}" for name, value in self.losses.items())
        beyond = [f"{name} ({ratio:.3g} times)" for name, ratio in self.gradients_beyond_usual.items()]
        found = {
            "parameters not finite": self.parameters_not_finite,
            "first outputs not finite": self.outputs_not_finite[:3],
            "anomaly": [self.anomaly] if self.anomaly else [],
            "gradients not finite": self.gradients_not_finite,
            "gradients beyond their usual norm": beyond,
        }
        said = [f"{what}: {', '.join(names)}" for what, names in found.items() if names]
        return [f"step {self.step}, {self.rays} rays: {losses}", *(said or ["all numbers of this step are finite"])]


def write_replay(path: Path, pipeline: EbarfPipeline, usual_gradients: Tensor | None, step: int) -> None:
    """Write all that a training step depends on; raises :class:`TrainingError` if writing fails."""
    model = pipeline.model
    rays, batch = pipeline.datamanager.next_train(step)
    scene, keyframes = (model.kwargs["metadata"][name] for name in ("scene", "keyframes"))
    content = {
        "format": FORMAT,
        "step": step,
        "seed": pipeline.seed,
        "model": _plain(model.config),
        "state": {name: value.detach().clone() for name, value in model.state_dict().items()},
        "camera": vars(scene.camera),
        "contrast_threshold": scene.contrast_threshold and vars(scene.contrast_threshold),
        "keyframes": [keyframes.t_us, *keyframes.poses],
        "box": model.scene_box.aabb,
        "rays": {name: getattr(rays, name) for name in ("origins", "directions", "pixel_area", "camera_indices")},
        "rays_metadata": dict(rays.metadata),
        "batch": batch,
        "usual_gradients": None if usual_gradients is None else usual_gradients[0],
        "gradients": [_name(model, one) for group in pipeline.get_param_groups().values() for one in group],
    }
    write_plain(content, path)


def replay(path: Path) -> Replayed:
    """Repeat the step of a replay file under anomaly detection, on the CPU; raises :class:`TrainingError`.

    The only difference is the remembered density, which is updated once more.
    """
    content = read_plain(path, "replay-*.pt")
    if content.get("format", 0) > FORMAT:
        raise TrainingError(f"{path}: is of format {content['format']}, expected at most {FORMAT}")
    try:
        model = _model(content)
        rays = RayBundle(**content["rays"], metadata=content["rays_metadata"])
        return _do_again(model, rays, content)
    except (LookupError, TypeError, AttributeError, ValueError) as error:
        said = str(error).splitlines()[0]
        raise TrainingError(f"{path}: {type(error).__name__} {said}, expected a file of this ebarf_ns") from None


def _do_again(model: EbarfModel, rays: RayBundle, content: dict[str, Any]) -> Replayed:
    not_finite: list[str] = []
    names = {module: name or "the model" for name, module in model.named_modules()}

    def look(module: nn.Module, _: Any, output: Any) -> None:
        if not all(bool(tensor.isfinite().all()) for tensor in _tensors(output)):
            not_finite.append(names[module])

    for module in names:
        module.register_forward_hook(look)
    model.train()
    model.begin_step(content["step"], content["seed"])
    bad = [name for name, one in model.named_parameters() if not bool(one.isfinite().all())]
    anomaly = ""
    with warnings.catch_warnings(record=True) as said, torch.autograd.set_detect_anomaly(True):
        warnings.simplefilter("always")
        outputs = model(rays)
        losses = model.get_loss_dict(outputs, content["batch"])
        try:
            torch.stack(list(losses.values())).sum().backward()
        except RuntimeError as error:
            places = [_OUR_LINE.findall(str(warning.message)) for warning in said]
            where = next((place[-1] for place in reversed(places) if place), None)
            told = f" (of {where[0]}, line {where[1]}, in {where[2]})" if where else ""
            anomaly = f"{str(error).splitlines()[0]}{told}"
    if anomaly:
        # Anomaly detection stops at the first finding, so a second pass computes the gradients.
        model.zero_grad()
        outputs = model(RayBundle(**content["rays"], metadata=dict(content["rays_metadata"])))
        torch.stack(list(model.get_loss_dict(outputs, content["batch"]).values())).sum().backward()
    gradients = {name: one.grad for name, one in model.named_parameters() if one.grad is not None}
    usual = content["usual_gradients"]
    usual_norms = {} if usual is None else dict(zip(content["gradients"], usual.tolist(), strict=True))
    ratios = {name: float(one.norm()) / (usual_norms.get(name) or torch.inf) for name, one in gradients.items()}
    return Replayed(
        step=content["step"],
        rays=len(rays),
        losses={name: float(value.detach()) for name, value in losses.items()},
        parameters_not_finite=bad,
        outputs_not_finite=list(dict.fromkeys(not_finite)),
        gradients_not_finite=[name for name, one in gradients.items() if not bool(one.isfinite().all())],
        gradients_beyond_usual={name: ratio for name, ratio in ratios.items() if ratio > 10},
        anomaly=anomaly,
    )


def _model(content: dict[str, Any]) -> EbarfModel:
    settings = dict(content["model"])
    config = EbarfModelConfig(
        **{**settings, "camera_optimizer": TrajectoryOptimizerConfig(**settings["camera_optimizer"])}
    )
    threshold, (t_us, position, quat_wxyz) = content["contrast_threshold"], content["keyframes"]
    nowhere = Path()
    scene = Scene(
        nowhere,
        nowhere,
        nowhere,
        Camera(**content["camera"]),
        contrast_threshold=threshold and ContrastThreshold(**threshold),
    )
    keyframes = Trajectory(t_us, Poses(position, quat_wxyz))
    metadata = {"scene": scene, "keyframes": keyframes}
    model: EbarfModel = config.setup(scene_box=SceneBox(content["box"]), num_train_data=len(t_us), metadata=metadata)
    try:
        model.load_state_dict(content["state"])
    except RuntimeError as error:
        raise ValueError(str(error).splitlines()[-1].strip()) from None
    return model


def _plain(config: Any) -> dict[str, Any]:
    values = {one.name: getattr(config, one.name) for one in fields(config) if one.name != "_target"}
    return {name: _plain(value) if is_dataclass(value) else value for name, value in values.items()}


def _name(model: EbarfModel, parameter: Tensor) -> str:
    return next(name for name, one in model.named_parameters() if one is parameter)


def _tensors(value: Any) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, dict):
        for one in value.values():
            yield from _tensors(one)
    elif isinstance(value, list | tuple):
        for one in value:
            yield from _tensors(one)
    elif is_dataclass(value):
        yield from _tensors(vars(value))
