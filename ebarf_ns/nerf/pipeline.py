"""Training steps and evaluation of a model on its scene."""

import sys
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from torch import Tensor

from ebarf_ns.errors import EvaluationError, one_line_errors
from ebarf_ns.evaluation.frames import depth_error, fit_brightness, image_errors, read_depth, read_frame
from ebarf_ns.evaluation.heldout import prediction
from ebarf_ns.evaluation.trajectory_error import reference_in_estimates_world, trajectory_results
from ebarf_ns.files import whole_file, write_picture
from ebarf_ns.geometry.so3 import turn_between
from ebarf_ns.geometry.trajectory import Poses, Trajectory
from ebarf_ns.geometry.trajectory_file import read_tum, write_tum
from ebarf_ns.nerf.checkpoints import unsealed
from ebarf_ns.nerf.datamanager import EventDataManager
from ebarf_ns.nerf.dataparser import Normalization, frame_cameras, replace_intrinsics
from ebarf_ns.nerf.metrics_file import changed_parts, read_header
from ebarf_ns.nerf.model import EbarfModel
from ebarf_ns.nerf.terminal import say
from ebarf_ns.nerf.upgrades import completed
from ebarf_ns.scene import Frame, Scene

# nerfstudio's own warnings, repeated for every step or camera; users can do nothing about them.
warnings.filterwarnings("ignore", message=".*GradScaler.*is deprecated", category=FutureWarning)
warnings.filterwarnings("ignore", message="Using a non-tuple sequence for multidimensional indexing")
warnings.filterwarnings("ignore", message="Converting a tensor with requires_grad=True to a scalar")

_DISPLAY_RAYS = 8192


@dataclass
class EbarfPipelineConfig(VanillaPipelineConfig):
    """Trains an event-loss model on event pairs."""

    _target: type = field(default_factory=lambda: EbarfPipeline)


class EbarfPipeline(VanillaPipeline):
    """Seeds every step by its number; evaluates frames at the refined pose of their time."""

    datamanager: EventDataManager  # pyright: ignore[reportIncompatibleVariableOverride]
    model: EbarfModel  # pyright: ignore[reportIncompatibleMethodOverride]

    def __init__(self, *args: Any, **kwargs: Any):
        with one_line_errors():
            super().__init__(*args, **kwargs)
            if self.test_mode == "val":
                self._check_references()
            else:
                self._say_what_changed()
        self.upgraded: list[str] = []
        """Names that the loaded checkpoint lacked because it is from an earlier version."""
        self.last_loss: Tensor | None = None
        """Event loss of the last training step."""
        self.register_buffer("cost", torch.zeros(2, dtype=torch.float64))
        self.cost: Tensor

    def record_cost(self, train_seconds: float, event_pairs: int) -> None:
        """Record the training cost so far; it is stored in checkpoints, so that ns-eval can report it."""
        self.cost.copy_(torch.tensor([train_seconds, event_pairs], dtype=self.cost.dtype))

    def _check_references(self) -> None:
        """Read all references for evaluation, so that a bad file does not end a run halfway."""
        for frame in self.scene.frames:
            read_frame(frame)
            read_depth(frame)
        if self.scene.groundtruth:
            read_tum(self.scene.groundtruth)

    def _say_what_changed(self) -> None:
        """Warn if the scene is not the one that the run was trained on, which may be intended or a mistake."""
        kept = self.datamanager.config.dataparser.kept  # pyright: ignore[reportAttributeAccessIssue]
        if kept and self.scene.events.is_file() and self.scene.folder != kept:
            for part in changed_parts(self.scene, read_header(kept.parent)):
                sys.stderr.write(f"{self.scene.folder}: {part} changed since {kept.parent} was trained\n")

    @property
    def scene(self) -> Scene:
        """The scene folder."""
        return self.datamanager.train_dataset.scene

    @property
    def _normalization(self) -> Normalization:
        return self.datamanager.train_dataset.metadata["normalization"]

    @property
    def _mount_scale(self) -> float:
        return self.datamanager.train_dataset.metadata["mount_scale"]

    @property
    def seed(self) -> int:
        """The random seed of this process; in distributed training, each has its own."""
        return self.datamanager.config.seed * self.world_size + self.datamanager.rank

    def get_train_loss_dict(self, step: int) -> tuple[Any, dict[str, Tensor], dict[str, Tensor]]:
        """Outputs, losses and metrics of one training step."""
        self.model.begin_step(step, self.seed)
        outputs, losses, metrics = super().get_train_loss_dict(step)
        self.last_loss = losses["event_loss"].detach()
        return outputs, losses, metrics

    def trajectory(self, refined: bool = True) -> Trajectory:
        """The keyframes, refined or as given, in the input's world frame and scale."""
        optimizer = self.model.camera_optimizer
        keyframes = optimizer.trajectory() if refined else optimizer.given_trajectory()
        world = self._normalization.invert(keyframes)
        return Trajectory(world.t_us.cpu(), world.poses)

    def write_refined(self, path: Path) -> None:
        """Write the refined trajectory in TUM format; comments report inserted keyframes and a clock offset."""
        comments, given, refined = [], self.trajectory(refined=False), self.trajectory()
        if inserted := len(refined.t_us) - len(given.t_us):
            comments.append(f"inserted keyframes: {inserted}")
        if added_us := int(refined.t_us[0] - given.t_us[0]):
            comments.append(f"clock of the events: {added_us:+} us were added to the times given")
        write_tum(path, refined, comments)

    @torch.no_grad()
    def numbers(self) -> dict[str, Any]:
        """Results available at any time in training: held-out events, corrections, and errors against a reference."""
        training = self.model.training
        self.model.eval()
        results = {**self._heldout(), **self._corrections(), **self._trajectory_errors()[0]}
        self.model.train(training)
        return results

    @torch.no_grad()
    def _corrections(self) -> dict[str, float]:
        """RMS distance and rotation by which training has moved the keyframes; distance in the input's unit."""
        optimizer = self.model.camera_optimizer
        given, refined = optimizer.initial(), optimizer.keyframes()
        moved = (refined.position - given.position).square().sum(dim=-1).mean().sqrt() / self._normalization.scale
        turned_rad = turn_between(given.quat_wxyz, refined.quat_wxyz).square().sum(dim=-1).mean().sqrt()
        return {"corrected_position": float(moved), "corrected_rotation_deg": float(turned_rad.rad2deg())}

    @torch.no_grad()
    def evaluate(self, renders: Path | None = None) -> dict[str, Any]:
        """Held-out event loss and, if the scene has references, image, depth and trajectory errors.

        With ``renders``, each rendered frame is written there beside its reference as a PNG.
        """
        self.eval()
        self.fit_display_range()
        trajectory_errors, scale = self._trajectory_errors()
        results = {**self._heldout(), **self._image_errors(renders, scale), **trajectory_errors}
        results |= {**self._corrections(), **self._keyframes()}
        self.train()
        # JSON has no NaN.
        return {name: None if value != value else value for name, value in results.items()}

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Load the parameters of a checkpoint after verifying it; nerfstudio's scripts load through this method too."""
        with one_line_errors():
            what = f"step-{step:09d}.ckpt"
            state, self.upgraded = completed(unsealed(loaded_state, what), self.state_dict(), what)
            if self.upgraded:
                say(f"{what} is of an earlier version: {', '.join(self.upgraded)} start as in a new training")
            super().load_pipeline(state, step)
            self.datamanager.shift_clock(int(self.model.camera_optimizer.clock_offset_us))
        if self.test_mode != "val":
            self.datamanager.show_from(self._refined)
            self.model.show_normals()
            self.fit_display_range()

    def _refined(self, cameras: Cameras) -> Cameras:
        """Cameras at their refined poses, without times, so that they are not moved again."""
        refined = cameras[...]
        refined.camera_to_worlds = self.model.camera_optimizer.apply_to_camera(cameras).detach()
        refined.metadata = {}
        if self.model.intrinsics:
            replace_intrinsics(refined, self.scene.camera, self.model.intrinsics.refined())
        return refined

    @torch.no_grad()
    def fit_display_range(self) -> None:
        """Set the display range from random rays of whole views."""
        training = self.model.training
        self.model.eval()
        self.model.fit_display_range(self.model(self.datamanager.view_rays(_DISPLAY_RAYS, 0))["brightness"][:, 0])
        self.model.train(training)

    def _heldout(self) -> dict[str, float | None]:
        """How well held-out events are predicted, and the contrast thresholds that fit them best."""
        if not self.scene.events.is_file() or not len(self.datamanager.heldout_pairs):
            return {"heldout_event_loss": None}
        rays, batch = self.datamanager.next_eval(0)
        before, after = self.model(rays)["brightness"][:, 0].double().cpu().chunk(2)
        names = ("polarity_sum", "event_count", "variance")
        total, count, variance = (batch[name].double().cpu().numpy() for name in names)
        predicted = prediction((after - before).numpy(), total, count, variance, self._threshold_ratio())
        return {
            "heldout_event_loss": predicted.unexplained,
            "implied_threshold_on": predicted.threshold_on,
            "implied_threshold_off": predicted.threshold_off,
            "time_constant_us": max(float(self.model.sensor.time_constant_us), 0.0),
        }

    def _keyframes(self) -> dict[str, float]:
        """The number of inserted keyframes and, if learned, the clock offset."""
        optimizer = self.model.camera_optimizer
        inserted = len(optimizer.keyframe_t_us) - len(optimizer.given)
        if not optimizer.learns_clock:
            return {"keyframes_inserted": inserted}
        rest = optimizer.remaining_clock_offset()
        return {
            "keyframes_inserted": inserted,
            "clock_offset_ms": (int(optimizer.clock_offset_us) + rest.offset_us) * 1e-3,
            "clock_deviation_ms": rest.deviation_us * 1e-3,
        }

    def _threshold_ratio(self) -> float:
        """C_on / C_off as stated, else as estimated from the recording; the same for every method and setting."""
        stated = self.scene.contrast_threshold
        return stated.on / stated.off if stated else self.datamanager.facts.threshold_ratio.value

    def _image_errors(self, renders: Path | None, scale_to_reference: float | None) -> dict[str, float | None]:
        """Errors of frames at their refined poses, and separately of frames outside the trajectory's span."""
        optimizer = self.model.camera_optimizer
        keyframe_t_us = optimizer.keyframe_t_us.cpu()
        within, outside = [], []
        for frame in map(self._as_learned, self.scene.frames):
            inside = keyframe_t_us[0] <= frame.t_us <= keyframe_t_us[-1]
            (within if inside else outside).append(frame)
        results: dict[str, float | None] = {}
        if within:
            t_us = torch.tensor([frame.t_us for frame in within])
            # Placed along the initial trajectory; the model then moves them to their refined poses.
            poses = Poses(*(column.cpu() for column in optimizer.initial_at(t_us.to(optimizer.keyframe_t_us))))
            cameras = frame_cameras(within, Trajectory(t_us, poses), self._mount_scale)
            results |= self._compare(within, cameras, scale_to_reference, renders)
        if outside:
            results |= {"frames_outside_span": float(len(outside))}
            if placed := self._placed_by_reference(outside):
                errors = self._compare(*placed, scale_to_reference)
                results |= {f"{name}_outside_span": value for name, value in errors.items()}
        return results

    def _as_learned(self, frame: Frame) -> Frame:
        """The frame with the learned intrinsics if the event camera itself took it."""
        intrinsics = self.model.intrinsics
        return (
            replace(frame, camera=intrinsics.refined()) if intrinsics and frame.camera == self.scene.camera else frame
        )

    def _placed_by_reference(self, frames: list[Frame]) -> tuple[list[Frame], Cameras] | None:
        """The frames within the reference's span, and their cameras placed by the reference."""
        if self.scene.groundtruth is None:
            return None
        reference = read_tum(self.scene.groundtruth)
        frames = [frame for frame in frames if reference.t_us[0] <= frame.t_us <= reference.t_us[-1]]
        if not frames:
            return None
        t_us = torch.tensor([frame.t_us for frame in frames])
        try:
            poses = reference_in_estimates_world(self.trajectory(), reference, t_us)
        except EvaluationError:
            return None
        placed = self._normalization.apply(Trajectory(t_us, poses))
        cameras = frame_cameras(frames, placed, self._mount_scale)
        # Without times, cameras are not moved with the refined trajectory.
        cameras.metadata = {}
        return frames, cameras

    def _compare(
        self, frames: list[Frame], cameras: Cameras, scale_to_reference: float | None, renders: Path | None = None
    ) -> dict[str, float | None]:
        outputs = [self.model.get_outputs_for_camera(cameras[k : k + 1].to(self.device)) for k in range(len(frames))]
        rendered = [output["brightness"][..., 0].double().cpu().numpy() for output in outputs]
        references = [read_frame(frame) for frame in frames]
        if renders:
            white = max(float(image.max()) for image in references)
            fitted_renders, _ = fit_brightness(rendered, references)
            pairs = zip(fitted_renders, references, strict=True)
            for k, (fitted, reference) in enumerate(pairs):
                beside = np.clip(np.concatenate([fitted, reference], axis=1) / white, 0, 1) ** (1 / 2.2)
                with whole_file(renders / f"{k:04d}.png") as temporary:
                    write_picture(temporary, (beside * 255).round().astype(np.uint8))
        depths = []
        unit = (scale_to_reference or 1.0) / self._normalization.scale
        for frame, output in zip(frames, outputs, strict=True):
            reference = read_depth(frame)
            if reference is not None:
                depths.append(depth_error(unit * output["depth"][..., 0].double().cpu().numpy(), reference))
        known = [error for error in depths if error is not None]
        return {
            "lpips": None,
            **image_errors(rendered, references),
            "frames": float(len(frames)),
            "depth_abs_rel": float(np.mean(known)) if known else None,
        }

    def _trajectory_errors(self) -> tuple[dict[str, Any], float | None]:
        """Errors under each alignment, and the scale from the trajectory's unit to the reference's."""
        if self.scene.groundtruth is None:
            return {}, None
        results = trajectory_results(self.trajectory(), read_tum(self.scene.groundtruth))
        return results, results["scale"] or results["scale_orientation"]

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """The results that ns-eval writes under "results"; during training, only numbers, for the logs."""
        with one_line_errors():
            results = self.evaluate(output_path)
        if step is not None:
            return {name: value for name, value in results.items() if isinstance(value, float)}
        train_seconds, event_pairs = self.cost.tolist()
        return {**results, "train_seconds": train_seconds, "event_pairs": int(event_pairs)}
