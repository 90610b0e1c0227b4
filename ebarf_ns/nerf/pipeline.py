"""Training steps and evaluation of a model on its scene."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from torch import Tensor

from ebarf_ns.errors import EvaluationError, one_line_errors
from ebarf_ns.evaluation.frames import fit_brightness, image_errors, read_frame
from ebarf_ns.evaluation.heldout import unexplained_share
from ebarf_ns.evaluation.trajectory_error import Alignment, trajectory_error
from ebarf_ns.files import whole_file
from ebarf_ns.geometry.trajectory import Trajectory
from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.nerf.datamanager import EventDataManager
from ebarf_ns.nerf.dataparser import Normalization
from ebarf_ns.nerf.model import EbarfModel
from ebarf_ns.photometry.event_loss import reported_change
from ebarf_ns.scene import Frame, Scene

_ALIGNMENTS: dict[Alignment, str] = {"sim3": "", "se3": "_se3", "orientation": "_orientation"}
"""How refined and reference trajectory are aligned, and the suffix that says so in the results."""


@dataclass
class EbarfPipelineConfig(VanillaPipelineConfig):
    """Event pairs into an event-loss model."""

    _target: type = field(default_factory=lambda: EbarfPipeline)


class EbarfPipeline(VanillaPipeline):
    """Seeds every step by its number, and evaluates by the rules: frames at the refined pose of their time."""

    datamanager: EventDataManager  # pyright: ignore[reportIncompatibleVariableOverride]
    model: EbarfModel  # pyright: ignore[reportIncompatibleMethodOverride]

    def __init__(self, *args: Any, **kwargs: Any):
        with one_line_errors():
            super().__init__(*args, **kwargs)

    @property
    def scene(self) -> Scene:
        """The scene folder."""
        return self.datamanager.train_dataset.scene

    def get_train_loss_dict(self, step: int) -> tuple[Any, dict[str, Tensor], dict[str, Tensor]]:
        """One training step's outputs, losses and metrics."""
        self.model.begin_step(step, self.datamanager.config.seed)
        return super().get_train_loss_dict(step)

    def trajectory(self, refined: bool = True) -> Trajectory:
        """The keyframes, refined or as they came, in the input's world frame and scale."""
        optimizer = self.model.camera_optimizer
        keyframes = optimizer.trajectory() if refined else Trajectory(optimizer.keyframe_t_us, optimizer.initial())
        normalization: Normalization = self.datamanager.train_dataset.metadata["normalization"]
        world = normalization.invert(keyframes)
        return Trajectory(world.t_us.cpu(), world.poses)

    @torch.no_grad()
    def evaluate(self, renders: Path | None = None) -> dict[str, float | None]:
        """Held-out event loss and, where the scene has references, image and trajectory errors.

        With ``renders``, each frame is written there beside its reference as a PNG.
        """
        self.eval()
        results: dict[str, float | None] = {"heldout_event_loss": self._heldout_event_loss()}
        results |= self._image_errors(renders)
        results |= self._trajectory_errors()
        self.train()
        return results

    def _heldout_event_loss(self) -> float | None:
        if not self.scene.events.is_file() or not self.datamanager.pairs[1].max_steps:
            return None
        rays, batch = self.datamanager.next_eval(0)
        before, after = self.model(rays)["brightness"][:, 0].double().cpu().chunk(2)
        polarity_sum, event_count = batch["polarity_sum"].cpu(), batch["event_count"].cpu()
        threshold = self.scene.contrast_threshold
        on, off = (threshold.on, threshold.off) if threshold else (1.0, 1.0)
        reported = reported_change(polarity_sum, event_count, on, off).double()
        return unexplained_share((after - before).numpy(), reported.numpy(), event_count.double().numpy())

    def _image_errors(self, renders: Path | None) -> dict[str, float]:
        dataset = self.datamanager.eval_dataset
        frames: dict[Path, Frame] = {frame.path: frame for frame in self.scene.frames}
        rendered, references, names = [], [], []
        for index, path in enumerate(dataset.image_filenames):
            if path in frames:
                outputs = self.model.get_outputs_for_camera(dataset.cameras[index : index + 1].to(self.device))
                rendered.append(outputs["brightness"][..., 0].double().cpu().numpy())
                references.append(read_frame(frames[path]))
                names.append(path.stem)
        outside = {"frames_outside_span": float(len(frames) - len(rendered))} if frames else {}
        if not rendered:
            return outside
        if renders:
            white = max(float(image.max()) for image in references)
            for name, fitted, reference in zip(names, fit_brightness(rendered, references), references, strict=True):
                beside = np.clip(np.concatenate([fitted, reference], axis=1) / white, 0, 1) ** (1 / 2.2)
                with whole_file(renders / f"{name}.png") as temporary:
                    cv2.imwrite(str(temporary), (beside * 255).round().astype(np.uint8))
        return {**image_errors(rendered, references), "frames": float(len(rendered)), **outside}

    def _trajectory_errors(self) -> dict[str, float | None]:
        if self.scene.groundtruth is None:
            return {}
        reference, estimate = read_tum(self.scene.groundtruth), self.trajectory()
        results: dict[str, float | None] = {}
        for alignment, suffix in _ALIGNMENTS.items():
            try:
                error = trajectory_error(estimate, reference, alignment)
            except EvaluationError:
                # Where no alignment is defined there is no number.
                results |= {f"ate_m{suffix}": None}
                continue
            results |= {f"ate_m{suffix}": error.ate_m, "rotation_deg": error.rotation_deg}
            if alignment == "sim3":
                results |= {"scale": error.scale}
            if alignment == "se3":
                results |= {"ape_full": error.ape_full}
        return results

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, float | None]:
        """What ns-eval writes under "results"."""
        with one_line_errors():
            return self.evaluate(output_path)
