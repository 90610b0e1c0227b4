"""Training within a budget of steps or seconds, with every evaluation on record and nothing half written."""

import math
import platform
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from importlib.metadata import version
from pathlib import Path
from time import monotonic
from typing import Any

import torch
import yaml
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import writer
from nerfstudio.utils.decorators import check_main_thread
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn

from ebarf_ns.errors import TrainingError, one_line_errors
from ebarf_ns.evaluation.report import write_report
from ebarf_ns.events.recording import RecordingFile
from ebarf_ns.events.sensor_facts import identify_recording
from ebarf_ns.files import whole_file
from ebarf_ns.geometry.trajectory_file import read_tum, write_tum
from ebarf_ns.memory import peak_memory_mib
from ebarf_ns.nerf.alignment import Alignment, align
from ebarf_ns.nerf.checkpoints import newest_whole, not_finite, read_checkpoint, write_checkpoint
from ebarf_ns.nerf.dataparser import keep_scene, moved
from ebarf_ns.nerf.metrics_file import begin_metrics, config_digest, read_header, record_metrics, scene_digest
from ebarf_ns.nerf.optimizers import BudgetDecay, GuardedOptimizers
from ebarf_ns.nerf.pipeline import EbarfPipeline
from ebarf_ns.nerf.run_folder import take_folder
from ebarf_ns.nerf.settings_check import check_machine, check_settings
from ebarf_ns.nerf.support import Support, support
from ebarf_ns.nerf.warm_up import compile_kernels
from ebarf_ns.odometry.output import complete_scene
from ebarf_ns.plan import Line, apply_plan, plan_for
from ebarf_ns.radiance.hash_grid import fastest_carrier
from ebarf_ns.scene import Scene, check_bounds, read_scene, write_camera

_ALIGNMENT_SHARE, _ALIGNMENT_SECONDS = 0.35, 30.0


@dataclass
class EbarfTrainerConfig(TrainerConfig):
    """A nerfstudio training run with a budget."""

    _target: type = field(default_factory=lambda: EbarfTrainer)
    max_train_seconds: float | None = None
    """End after this many seconds of training, evaluation and loading excluded, if not after --max-num-iterations
    steps before; all schedules follow."""
    evaluations: int = 8
    """How often a run is evaluated into metrics.jsonl, evenly over its budget."""
    overwrite: bool = False
    """Begin anew in a folder that holds a run."""
    allow_changed_scene: bool = False
    """Go on from a checkpoint although its scene's events, trajectory or scene.json are others now."""
    estimate_trajectory: bool = True
    """Where the scene's trajectory is still to come, estimate it from the events first."""
    learn_intrinsics: bool = False
    """Learn focal length, principal point and the camera's distortion coefficients too; the result is written to
    camera_refined.json, as scene.json has it."""
    averaged_steps: int = 100
    """About as many last steps' parameters are averaged for evaluations and checkpoints; 1: the last step's alone."""

    def save_config(self) -> None:
        """Write config.yml, which is what ns-train begins with, unless this machine lacks what is asked of it."""
        with one_line_errors():
            check_machine(self.machine)
        super().save_config()


class EbarfTrainer(Trainer):
    """Follows the budget, evaluates along the way, and leaves trajectories and metrics in the run's folder."""

    config: EbarfTrainerConfig
    pipeline: EbarfPipeline
    optimizers: GuardedOptimizers

    def setup(self, test_mode: Any = "val") -> None:
        """Build pipeline and optimizers; what a user can cause ends in one line."""
        self.train_seconds = 0.0
        self.event_pairs = 0
        self.steps_done = 0
        self.evaluated_step = self.saved_step = 0
        self.last_loss = math.nan
        self.signal = 0
        self.alignment: Alignment | None = None
        self.mean: list[Tensor] | None = None
        self.config.pipeline.datamanager.seed = self.config.machine.seed  # pyright: ignore[reportAttributeAccessIssue]
        self.config.pipeline.model.learn_intrinsics = self.config.learn_intrinsics  # pyright: ignore[reportAttributeAccessIssue]
        with one_line_errors():
            check_settings(self.config)
            self._take_folder()
            try:
                self._plan()
                super().setup(test_mode)
                self.compile_seconds = compile_kernels(self.pipeline)
                self._align()
                if self.progress() >= 1:
                    raise TrainingError(
                        f"the loaded run has used its budget ({self.steps_done} steps, {self.train_seconds:.0f} s); "
                        "expected a larger --max-num-iterations or --max-train-seconds to go on"
                    )
            except BaseException:
                self._release_folder()
                raise

    @check_main_thread
    def _release_folder(self) -> None:
        self.lock.release()

    @check_main_thread
    def _take_folder(self) -> None:
        loaded = self._loaded_path
        goes_on = loaded is not None and loaded.parent.resolve() == (self.base_dir / "nerfstudio_models").resolve()
        self.lock = take_folder(self.base_dir, goes_on, self.config.overwrite)

    def _plan(self) -> None:
        """Fill in what the configuration leaves to the plan, and keep it with the run."""
        datamanager = self.config.pipeline.datamanager
        folder = datamanager.data or datamanager.dataparser.data  # pyright: ignore[reportAttributeAccessIssue]
        if datamanager.dataparser.kept and not Path(folder).is_dir():  # pyright: ignore[reportAttributeAccessIssue]
            raise TrainingError(moved(replace(datamanager.dataparser, data=Path(folder))))  # pyright: ignore[reportAttributeAccessIssue]
        if self.config.estimate_trajectory:
            complete_scene(Path(folder), partial(CONSOLE.print, soft_wrap=True))
        scene = read_scene(Path(folder))
        trajectory = read_tum(scene.trajectory)
        check_bounds(scene, trajectory)
        self._check_scene_is_that_of_resumed_run(scene)
        file = RecordingFile(scene.events, scene.camera.width, scene.camera.height)
        events, _, _ = file.span()
        refractory_us = scene.refractory_us if datamanager.refractory_us is None else datamanager.refractory_us  # pyright: ignore[reportAttributeAccessIssue]
        facts = identify_recording(file, (int(trajectory.t_us[0]), int(trajectory.t_us[-1])), refractory_us)
        device = "cuda" if self.device.startswith("cuda") else "cpu"
        model: Any = self.config.pipeline.model
        if model.camera_optimizer.mode == "off" and model.camera_optimizer.longest_gap_us is None:
            # A trajectory that stays as it came needs no keyframes to be learned.
            model.camera_optimizer.longest_gap_us = 0
        start = model.camera_optimizer.start(trajectory)
        normalized = model.loss == "normalized"
        lines = plan_for(scene, start, events, device, model.grid_coarsest, model.grid_finest, normalized, facts)
        self.plan = apply_plan(self._lines_of_resumed_run(lines), self.config)
        self._keep_plan(scene)

    def _align(self) -> None:
        """Look for large errors of the trajectory, where a run begins and its budget allows for it."""
        if self._loaded_path or not self._has_budget_for_coarse_fields():
            return
        model, seconds = self.pipeline.model, self.config.max_train_seconds
        most_seconds = seconds and _ALIGNMENT_SHARE * seconds
        steps = model.config.camera_optimizer.align_steps
        started = monotonic()
        self.alignment = align(model, self.pipeline.datamanager, steps, self.config.machine.seed, most_seconds)
        if self.world_size > 1:
            for found in (*model.camera_optimizer.buffers(), *(one.data for one in model.pose_parameters())):
                torch.distributed.broadcast(found, 0)
            self.pipeline.datamanager.shift_clock(int(model.camera_optimizer.clock_offset_us))
        self.train_seconds = self._agreed(monotonic() - started)
        CONSOLE.print(str(self.alignment or "no large error of the trajectory was looked for in this budget"))

    def _has_budget_for_coarse_fields(self) -> bool:
        """Too few steps find nothing, and say so of any trajectory."""
        settings, seconds = self.pipeline.model.config.camera_optimizer, self.config.max_train_seconds
        enough = 0 < settings.align_steps <= _ALIGNMENT_SHARE * self.config.max_num_iterations
        return enough and settings.mode == "refine" and not (seconds and seconds < _ALIGNMENT_SECONDS)

    def _lines_of_resumed_run(self, lines: list[Line]) -> list[Line]:
        """The plan that a loaded checkpoint was made by, whatever would be planned on this machine today."""
        before = self._header_of_resumed_run().get("plan", {})
        resumed = {field: Line(field, made["value"], "as in the run resumed") for field, made in before.items()}
        return [resumed.get(line.field, line) for line in lines]

    def _header_of_resumed_run(self) -> dict[str, Any]:
        return read_header(self._loaded_path.parent.parent) if self._loaded_path else {}

    def _check_scene_is_that_of_resumed_run(self, scene: Scene) -> None:
        before, now = self._header_of_resumed_run().get("scene_digest"), scene_digest(scene)
        changed = [part for part in now if before[part] != now[part]] if isinstance(before, dict) else []
        if changed and not self.config.allow_changed_scene:
            raise TrainingError(
                f"{scene.folder}: {', '.join(changed)} changed since {self._loaded_path} was made; expected the scene "
                "that it was trained on, or --allow-changed-scene True"
            )

    @check_main_thread
    def _keep_plan(self, scene: Scene) -> None:
        kept = self.base_dir / "scene"
        keep_scene(scene, kept)
        self.config.pipeline.datamanager.dataparser.kept = kept  # pyright: ignore[reportAttributeAccessIssue]
        with whole_file(self.base_dir / "config.yml") as temporary:
            temporary.write_text(yaml.dump(self.config), encoding="utf-8")

    def setup_optimizers(self) -> GuardedOptimizers:
        """One optimizer for each parameter group."""
        return GuardedOptimizers(self.config.optimizers.copy(), self.pipeline.get_param_groups())

    def progress(self) -> float:
        """Used fraction of the budget, by steps or seconds, whichever is further."""
        by_steps = self.steps_done / self.config.max_num_iterations
        seconds = self.config.max_train_seconds
        return max(by_steps, self.train_seconds / seconds if seconds else 0.0)

    def train(self) -> None:
        """Train to the end of the budget, or to a signal: 130 or 143 is then the exit code, and nothing is lost."""
        try:
            with one_line_errors(), self._signals():
                self._begin_metrics()
                super().train()
        finally:
            self._release_folder()
        if self.signal:
            raise SystemExit(128 + self.signal)

    @contextmanager
    def _signals(self) -> Iterator[None]:
        """The first Ctrl-C or SIGTERM ends training after the step that is under way, a second one the process."""

        def stop(number: int, _: Any) -> None:
            CONSOLE.print(f"{signal.Signals(number).name}: ends after this step; once more, and it ends at once")
            self.signal, self.stop_training = number, True
            for one in before:
                signal.signal(one, signal.SIG_DFL)

        before: dict[int, Any] = {}
        if threading.current_thread() is threading.main_thread():
            before = {one: signal.signal(one, stop) for one in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for one, handler in before.items():
                signal.signal(one, handler)

    def _after_train(self) -> None:
        if self.signal:
            if self.steps_done and self.evaluated_step != self.steps_done:
                self._evaluate(self.steps_done - 1, self.last_loss)
            self.save_checkpoint(self.step)
            self._write_report()
            return
        self._write_report()
        super()._after_train()

    @check_main_thread
    def _write_report(self) -> None:
        write_report(self.base_dir, self.pipeline.scene.groundtruth)

    @check_main_thread
    def _train_complete_viewer(self) -> None:
        with self._averaged():
            super()._train_complete_viewer()

    def train_iteration(self, step: int) -> Any:
        """One step, its share of the budget, and the evaluation that may be due after it."""
        started = monotonic()
        before = self.progress()
        for scheduler in self.optimizers.schedulers.values():
            if isinstance(scheduler, BudgetDecay):
                scheduler.progress = before
        try:
            result = super().train_iteration(step)
        except TrainingError as error:
            # A batch follows from its step and the seed: with the state before it, the step can be looked into.
            self.save_checkpoint(step)
            saved = sorted(self.checkpoint_dir.glob("step-*.ckpt"))
            again = f"; --load-checkpoint {saved[-1]} does what came after it again" if saved else ""
            raise TrainingError(f"{error}{again}") from None
        self.steps_done = step + 1
        self._average()
        self.train_seconds = self._agreed(self.train_seconds + monotonic() - started)
        self.event_pairs += self.pipeline.datamanager.get_train_rays_per_batch() // 2 * self.world_size
        self.pipeline.record_cost(self.train_seconds, self.event_pairs)
        after = self.progress()
        self.last_loss = float(result[0].detach())
        if after >= 1:
            # Evaluation may fail, or take long: what was learned is safe before.
            self.save_checkpoint(step)
        if int(after * self.config.evaluations) > int(before * self.config.evaluations) or after >= 1:
            self._evaluate(step, self.last_loss)
        if after >= 1:
            self.stop_training = True
        return result

    def _average(self) -> None:
        """Let the mean of the parameters follow: over the last tenth of the steps, over ``averaged_steps`` at most."""
        if self.config.averaged_steps == 1:
            self.mean = None
            return
        share = max(10 / (self.steps_done + 9), 1 / self.config.averaged_steps)
        live = [parameter.detach() for parameter in self._parameters()]
        if self.mean is None:
            self.mean = [parameter.clone() for parameter in live]
        for mean, parameter in zip(self.mean, live, strict=True):
            mean.lerp_(parameter, share)

    def _parameters(self) -> list[nn.Parameter]:
        return [parameter for group in self.pipeline.get_param_groups().values() for parameter in group]

    @contextmanager
    def _averaged(self) -> Iterator[None]:
        """The model with its mean parameters, which chance moves less than the last (Polyak and Juditsky, 1992)."""
        live = [parameter.detach().clone() for parameter in self._parameters()]
        try:
            self._put(self.mean or live)
            yield
        finally:
            self._put(live)

    @torch.no_grad()
    def _put(self, values: list[Tensor]) -> None:
        for parameter, value in zip(self._parameters(), values, strict=True):
            parameter.copy_(value)

    def _agreed(self, seconds: float) -> float:
        """The first process's clock: all processes must take schedules and end at the same step."""
        if self.world_size == 1:
            return seconds
        clock = torch.tensor([seconds], dtype=torch.float64, device=self.device)
        torch.distributed.broadcast(clock, 0)
        return float(clock)

    @check_main_thread
    def _evaluate(self, step: int, loss: float) -> None:
        final = self.progress() >= 1
        self.evaluated_step = self.steps_done
        with self._averaged():
            results = self.pipeline.evaluate(self.base_dir / "renders" if final else None)
            self._write_refined(results)
            support_found = self._support() if final else None
        record = {
            "step": self.steps_done,
            "train_seconds": round(self.train_seconds, 3),
            "event_pairs": self.event_pairs,
            "loss": loss if loss == loss else None,
            **results,
            "skipped_steps": self.optimizers.skipped,
            "peak_memory_mib": round(peak_memory_mib(self.device), 1),
        }
        if support_found:
            record["support"] = {"verdict": support_found.verdict, "says": str(support_found), **asdict(support_found)}
        record_metrics(self.base_dir, record)
        numbers = {name: value for name, value in results.items() if isinstance(value, float)}
        writer.put_dict(name="Evaluation", scalar_dict=numbers, step=step)
        shown = "  ".join(f"{name} {value:.4g}" for name, value in numbers.items())
        CONSOLE.print(f"step {self.steps_done}, {self.train_seconds:.1f} s, {self.event_pairs:,} pairs:  {shown}")
        if support_found:
            CONSOLE.print(str(support_found))

    def _write_refined(self, results: dict[str, Any]) -> None:
        comments = []
        if results["keyframes_inserted"]:
            comments.append(f"inserted keyframes: {results['keyframes_inserted']}")
        given, refined = self.pipeline.trajectory(refined=False), self.pipeline.trajectory()
        if added_us := int(refined.t_us[0] - given.t_us[0]):
            comments.append(f"clock of the events: {added_us:+} us were added to the times given")
        write_tum(self.base_dir / "trajectory_refined.txt", refined, comments)
        if self.pipeline.model.intrinsics:
            write_camera(self.base_dir / "camera_refined.json", self.pipeline.model.intrinsics.refined())

    def _support(self) -> Support | None:
        """What held-out events say of the refined trajectory, where there is the budget to ask them."""
        if not self._has_budget_for_coarse_fields():
            return None
        model = self.pipeline.model
        steps = model.config.camera_optimizer.align_steps // 2
        return support(model, self.pipeline.datamanager, steps, self.config.machine.seed)

    @check_main_thread
    def _begin_metrics(self) -> None:
        write_tum(self.base_dir / "trajectory_initial.txt", self.pipeline.trajectory(refined=False))
        begin_metrics(self.base_dir, self._header, self._start_step)

    def _header(self) -> dict[str, Any]:
        device = torch.cuda.get_device_name() if self.device.startswith("cuda") else platform.processor() or "cpu"
        scene = self.pipeline.scene
        # What says where a run lies, not what it does.
        places = {"timestamp", "output_dir", "experiment_name", "load_dir", "load_step", "load_checkpoint", "data"}
        configuration = {key: value for key, value in asdict(self.config).items() if key not in places}
        datamanager = configuration["pipeline"]["datamanager"]
        datamanager["data"] = datamanager["dataparser"]["data"] = None
        del datamanager["dataparser"]["kept"]
        return {
            "versions": {name: version(name) for name in ("ebarf_ns", "nerfstudio", "torch", "numpy")},
            "method": self.config.method_name,
            "device": device,
            "threads": torch.get_num_threads(),
            "compile_seconds": round(self.compile_seconds, 1),
            "seed": self.config.machine.seed,
            "scene": str(scene.folder.resolve()),
            "scene_digest": scene_digest(scene),
            "config_digest": config_digest(configuration),
            "hash_grid": fastest_carrier(torch.zeros(0, 3, device=self.device)),
            "blind_us": self.pipeline.datamanager.refractory_us,
            "hot_pixels_left_out": self.pipeline.datamanager.hot_pixels_left_out,
            "alignment": asdict(self.alignment) if self.alignment else None,
            "plan": {line.field: {"value": line.value, "reason": line.reason} for line in self.plan},
        }

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Write the checkpoint whole, then remove all older ones but one; the step is the last one done."""
        path = self._checkpoint_path()
        if self.saved_step == self.steps_done and path.is_file():
            return
        with self._averaged():
            pipeline = {name: value.clone() for name, value in self.pipeline.state_dict().items()}
        state = {
            "step": self._last_step(),
            "pipeline": pipeline,
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.optimizers.optimizers.items()},
            "schedulers": {name: scheduler.state_dict() for name, scheduler in self.optimizers.schedulers.items()},
            "scalers": self.grad_scaler.state_dict(),
            "ebarf": {
                "train_seconds": self.train_seconds,
                "event_pairs": self.event_pairs,
                "skipped_steps": self.optimizers.skipped,
                "usual_gradients": self.optimizers.usual,
                # Those of the pipeline are the mean: what everybody but a resumed training is after.
                "trained": [parameter.detach().clone() for parameter in self._parameters()],
            },
        }
        if name := not_finite(state):
            CONSOLE.print(f"no checkpoint of step {self.steps_done}, which is not finite in {name}: older ones stay")
            return
        write_checkpoint(state, path)
        self.saved_step = self.steps_done

    def _last_step(self) -> int:
        return max(self.steps_done - 1, 0)

    def _checkpoint_path(self) -> Path:
        return self.checkpoint_dir / f"step-{self._last_step():09d}.ckpt"

    def _load_checkpoint(self) -> None:
        path = self._loaded_path
        if path is None:
            return
        state = read_checkpoint(path)
        ours = state.get("ebarf", {})
        try:
            self.pipeline.load_pipeline(state["pipeline"], state["step"])
            self.mean = [parameter.detach().clone() for parameter in self._parameters()]
            self._put(ours.get("trained", self.mean))
            self.optimizers.load_optimizers(state["optimizers"])
            if self.config.load_scheduler:
                self.optimizers.load_schedulers(state["schedulers"])
            self.grad_scaler.load_state_dict(state["scalers"])
        except (RuntimeError, LookupError, TypeError, ValueError) as error:
            said = str(error).splitlines()[-1].strip() if str(error) else type(error).__name__
            expected = "expected a run's checkpoint, with the flags it was made by"
            raise TrainingError(f"{path}: cannot go on from it ({said}), {expected}") from None
        self._start_step = self.steps_done = state["step"] + 1
        self.train_seconds = ours.get("train_seconds", 0.0)
        self.event_pairs = ours.get("event_pairs", 0)
        self.optimizers.skipped = ours.get("skipped_steps", 0)
        self.optimizers.usual = ours.get("usual_gradients")
        CONSOLE.print(f"goes on from {path}")

    @cached_property
    def _loaded_path(self) -> Path | None:
        if self.config.load_dir is None:
            path = self.config.load_checkpoint
        elif self.config.load_step is not None:
            path = self.config.load_dir / f"step-{self.config.load_step:09d}.ckpt"
        else:
            path, damaged = newest_whole(self.config.load_dir)
            for error in damaged:
                CONSOLE.print(f"{error}; goes on from {path.name}")
        if path is not None and not path.is_file():
            raise TrainingError(f"{path}: is no file, expected a run's checkpoint")
        return path
