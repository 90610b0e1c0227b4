"""Training within a budget of steps or seconds; evaluations are recorded, and files written atomically."""

import math
from functools import cached_property
from pathlib import Path
from time import monotonic
from typing import Any

import torch
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import writer
from nerfstudio.utils.decorators import check_main_thread

from ebarf_ns.errors import EbarfError, TrainingError, one_line_errors
from ebarf_ns.evaluation.report import write_report
from ebarf_ns.evaluation.trajectory_error import trajectory_results
from ebarf_ns.geometry.trajectory_file import read_tum, write_tum
from ebarf_ns.machine import use_threads
from ebarf_ns.memory import peak_memory_mib
from ebarf_ns.nerf import optimizers
from ebarf_ns.nerf.alignment import NOT_ALIGNED, Alignment, align
from ebarf_ns.nerf.averaging import Averaging
from ebarf_ns.nerf.checkpoints import checkpoints_in, chosen_checkpoint, not_finite, read_checkpoint, write_checkpoint
from ebarf_ns.nerf.guard import GuardedOptimizers
from ebarf_ns.nerf.metrics_file import begin_metrics, flags_of, read_header
from ebarf_ns.nerf.moments import write_moments
from ebarf_ns.nerf.pipeline import EbarfPipeline
from ebarf_ns.nerf.replay import write_replay
from ebarf_ns.nerf.run_evaluation import record_evaluation, write_refined
from ebarf_ns.nerf.run_folder import remove_checkpoints, take_folder
from ebarf_ns.nerf.run_start import (
    check_scene_is_the_same,
    keep_run,
    opening_config,
    plan_run,
    read_scene_of,
    run_header,
)
from ebarf_ns.nerf.settings_check import changed_flags, check_settings
from ebarf_ns.nerf.signals import end, output_may_end, signals_to
from ebarf_ns.nerf.support import Support, support
from ebarf_ns.nerf.terminal import LiveLine, evaluation_line, plan_line, say, scene_line, summary
from ebarf_ns.nerf.trainer_config import EbarfTrainerConfig
from ebarf_ns.nerf.trainer_state import restore, trainer_state
from ebarf_ns.nerf.warm_up import compile_kernels

# The config.yml files of earlier versions expect these names here.
FusedAdamConfig, KeyframeAdamConfig = optimizers.FusedAdamConfig, optimizers.KeyframeAdamConfig
BudgetDecayConfig, BudgetDecayScheduler = optimizers.BudgetDecayConfig, optimizers.BudgetDecayScheduler

_ALIGNMENT_SHARE, _ALIGNMENT_SECONDS = 0.35, 30.0


class EbarfTrainer(Trainer):
    """Trains within the budget, evaluates along the way, and writes trajectories and metrics to the run's folder."""

    config: EbarfTrainerConfig
    pipeline: EbarfPipeline
    optimizers: GuardedOptimizers

    def setup(self, test_mode: Any = "val") -> None:
        """Build pipeline and optimizers; user errors are reported in one line."""
        self.begun_s = monotonic()
        self.live = LiveLine()
        self.results: dict[str, Any] = {}
        self.train_seconds = 0.0
        self.steps_done = self.evaluated_step = self.saved_step = self.event_pairs = self.signal = 0
        self.last_loss = math.nan
        self.alignment: Alignment | None = None
        self.config.pipeline.datamanager.seed = self.config.machine.seed  # pyright: ignore[reportAttributeAccessIssue]
        self.config.pipeline.model.learn_intrinsics = self.config.learn_intrinsics  # pyright: ignore[reportAttributeAccessIssue]
        with one_line_errors(), signals_to(end):
            check_settings(self.config)
            self._take_folder()
            try:
                self._plan()
                super().setup(test_mode)
                self._say_plan()
                self.compile_seconds = compile_kernels(self.pipeline)
                self._align()
                if self.progress() >= 1:
                    raise TrainingError(
                        f"the loaded run has used its budget ({self.steps_done} steps, {self.train_seconds:.0f} s); "
                        "expected a larger --max-num-iterations or --max-train-seconds to go on"
                    )
                self._keep()
            except BaseException:
                self._release_folder()
                raise

    @check_main_thread
    def _release_folder(self) -> None:
        self.lock.release()

    @check_main_thread
    def _take_folder(self) -> None:
        self.lock = take_folder(self.base_dir, self._goes_on, self.config.overwrite)

    def _plan(self) -> None:
        """Fill in the planned settings, and prepare the content of config.yml."""
        scene, header = read_scene_of(self.config), self._header_of_resumed_run
        if self._loaded_path and not self.config.allow_changed_scene:
            check_scene_is_the_same(scene, header, self._loaded_path)
        self.plan = plan_run(self.config, scene, self.device, header)
        self.opening = opening_config(self.config, self.base_dir)
        use_threads(self.config.threads)

    @check_main_thread
    def _keep(self) -> None:
        """Prepare the folder once the training is sure to start: an overwritten run's checkpoints are removed."""
        if not self._goes_on:
            remove_checkpoints(self.base_dir)
        keep_run(self.opening, self.config, self.pipeline.scene, self.base_dir)

    @check_main_thread
    def _say_plan(self) -> None:
        scene, given = self.pipeline.scene, self.pipeline.trajectory(refined=False)
        self.errors_given = trajectory_results(given, read_tum(scene.groundtruth)) if scene.groundtruth else {}
        say(scene_line(scene, len(self.pipeline.datamanager.index.events), len(given.t_us)))
        say(plan_line(self.plan))

    @property
    def _goes_on(self) -> bool:
        """Whether a run is resumed in its own folder."""
        loaded = self._loaded_path
        return loaded is not None and loaded.parent.resolve() == (self.base_dir / "nerfstudio_models").resolve()

    @cached_property
    def _header_of_resumed_run(self) -> dict[str, Any]:
        return read_header(self._loaded_path.parent.parent) if self._loaded_path else {}

    def _align(self) -> None:
        """Correct large errors of the trajectory at the start of a new run, if its budget allows it."""
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
        say(str(self.alignment or NOT_ALIGNED))

    def _has_budget_for_coarse_fields(self) -> bool:
        """Whether there are enough steps: with too few, every trajectory seems good."""
        settings, seconds = self.pipeline.model.config.camera_optimizer, self.config.max_train_seconds
        enough = 0 < settings.align_steps <= _ALIGNMENT_SHARE * self.config.max_num_iterations
        return enough and settings.mode == "refine" and not (seconds and seconds < _ALIGNMENT_SECONDS)

    def setup_optimizers(self) -> GuardedOptimizers:
        """One optimizer for each parameter group."""
        groups = self.pipeline.get_param_groups()
        parameters = [parameter for group in groups.values() for parameter in group]
        self.averaging = Averaging(parameters, self.config.averaged_steps)
        return GuardedOptimizers(self.config.optimizers.copy(), groups)

    def progress(self) -> float:
        """Used fraction of the budget, by steps or seconds, whichever is larger."""
        by_steps = self.steps_done / self.config.max_num_iterations
        seconds = self.config.max_train_seconds
        return max(by_steps, self.train_seconds / seconds if seconds else 0.0)

    def train(self) -> None:
        """Train until the budget is used or a signal arrives; all is then saved, and the exit code is 128 + number."""
        try:
            with one_line_errors(), output_may_end(), signals_to(self._stop):
                self._begin_metrics()
                with self.live:
                    super().train()
        finally:
            self._release_folder()
        if self.signal:
            raise SystemExit(128 + self.signal)

    def _stop(self, number: int) -> None:
        if self.training_state == "completed":
            # Everything is saved, and only the viewer is still running.
            end(number)
        say("ends after this step; a second signal ends it at once")
        self.signal, self.stop_training = number, True

    def _after_train(self) -> None:
        if self.signal:
            if self.steps_done and self.evaluated_step != self.steps_done:
                self._evaluate(self.last_loss)
            self.save_checkpoint(self.step)
            self._write_report()
            return
        self.live.stop()
        self.training_state = "completed"
        self.save_checkpoint(self.step)
        self._write_report()
        writer.write_out_storage()
        for callback in self.callbacks:
            callback.run_callback_at_location(step=self.step, location=TrainingCallbackLocation.AFTER_TRAIN)
        if not self.config.viewer.quit_on_train_completion:
            self._train_complete_viewer()

    @check_main_thread
    def _write_report(self) -> None:
        write_report(self.base_dir, self.pipeline.scene.groundtruth)
        wall_seconds = monotonic() - self.begun_s
        say(summary(self.base_dir, self.train_seconds, wall_seconds, self.results, self.errors_given))

    def _check_viewer_warnings(self) -> None:
        """Do nothing: nerfstudio's warning that nothing is evaluated does not apply."""

    def _train_complete_viewer(self) -> None:
        with self.averaging.shown():
            super()._train_complete_viewer()

    def train_iteration(self, step: int) -> Any:
        """Run one step, update the budget, and evaluate if due."""
        started = monotonic()
        before = self.progress()
        for scheduler in self.optimizers.schedulers.values():
            if isinstance(scheduler, optimizers.BudgetDecay):
                scheduler.progress = before
        try:
            result = super().train_iteration(step)
            self.optimizers.check_parameters(step)
        except TrainingError as error:
            raise TrainingError(f"{error}{self._left_for_others(step)}") from None
        self.steps_done = step + 1
        self.averaging.follow(self.steps_done)
        self.train_seconds = self._agreed(self.train_seconds + monotonic() - started)
        self.event_pairs += self.pipeline.datamanager.get_train_rays_per_batch() // 2 * self.world_size
        self.pipeline.record_cost(self.train_seconds, self.event_pairs)
        after = self.progress()
        self.last_loss = float(result[0].detach())
        if after >= 1:
            # Save first, since evaluation may fail or take long.
            self.save_checkpoint(step)
        if int(after * self.config.evaluations) > int(before * self.config.evaluations) or after >= 1:
            try:
                self._evaluate(self.last_loss)
            except (EbarfError, OSError):
                # The scene's folder may be gone.
                self.save_checkpoint(step)
                raise
        if after >= 1 or self.signal:
            self.stop_training = True
        self.live.update(after, self.steps_done, self.train_seconds, monotonic() - started, self.last_loss)
        return result

    @check_main_thread
    def _left_for_others(self, step: int) -> str:
        """Write the last good state and a replay file after a failed step; returns the rest of the error message."""
        replay = self.base_dir / f"replay-{step:09d}.pt"
        try:
            write_replay(replay, self.pipeline, self.optimizers.usual, step)
            self.save_checkpoint(step)
        except TrainingError as error:
            return f"; {error}"
        saved = checkpoints_in(self.checkpoint_dir)
        again = f"; --load-checkpoint {saved[-1]} resumes before it" if saved else ""
        return f"; ebarf replay {replay} looks for where they begin{again}"

    def _agreed(self, seconds: float) -> float:
        """The first process's clock, so that all processes have the same schedules and end at the same step."""
        if self.world_size == 1:
            return seconds
        clock = torch.tensor([seconds], dtype=torch.float64, device=self.device)
        torch.distributed.broadcast(clock, 0)
        return float(clock)

    @check_main_thread
    def _evaluate(self, loss: float) -> None:
        final = self.progress() >= 1
        self.evaluated_step = self.steps_done
        with self.averaging.shown():
            results = self.pipeline.evaluate(self.base_dir / "renders" if final else None)
            write_refined(self.pipeline, self.base_dir)
            if final:
                say("trained; the trajectory is now checked on held-out events")
                write_moments(self.pipeline, self.base_dir / "moments.npz")
            found = self._support() if final else None
        self.results = {
            "step": self.steps_done,
            "train_seconds": round(self.train_seconds, 3),
            "event_pairs": self.event_pairs,
            "loss": loss if loss == loss else None,
            **results,
            "skipped_steps": self.optimizers.skipped,
            "peak_memory_mib": round(peak_memory_mib(self.device), 1),
        }
        record_evaluation(self.results, found, self.base_dir)
        say(evaluation_line(self.train_seconds, self.steps_done, self.results, self.errors_given))
        if found:
            say(str(found))

    def _support(self) -> Support | None:
        """How well held-out events support the refined trajectory; None if the budget is too small."""
        if not self._has_budget_for_coarse_fields():
            return None
        model, steps = self.pipeline.model, self.pipeline.model.config.camera_optimizer.align_steps // 2
        return support(model, self.pipeline.datamanager, steps, self.config.machine.seed)

    @check_main_thread
    def _begin_metrics(self) -> None:
        write_tum(self.base_dir / "trajectory_initial.txt", self.pipeline.trajectory(refined=False))
        header = lambda: {  # noqa: E731
            **run_header(self.config, self.pipeline, self.device, self.plan, self.alignment),
            "compile_seconds": round(self.compile_seconds, 1),
        }
        begin_metrics(self.base_dir, header, self._start_step)

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Write a checkpoint after the last completed step, unless it is saved already or not finite."""
        last = max(self.steps_done - 1, 0)
        path = self.checkpoint_dir / f"step-{last:09d}.ckpt"
        if self.saved_step == self.steps_done and path.is_file():
            return
        state = trainer_state(self, last)
        if name := not_finite(state):
            say(f"no checkpoint of step {self.steps_done}, which is not finite in {name}: older ones stay")
            return
        write_checkpoint(state, path)
        self.saved_step = self.steps_done

    def _load_checkpoint(self) -> None:
        path = self._loaded_path
        if path is None:
            return
        state = read_checkpoint(path)
        changed = changed_flags(self._header_of_resumed_run.get("flags", {}), flags_of(self.config))
        restore(self, state, path, changed)
        self._start_step = self.steps_done = state["step"] + 1
        say(f"resumes from {path}{changed and f', which was made with {changed}'}")

    @cached_property
    def _loaded_path(self) -> Path | None:
        path, damaged = chosen_checkpoint(self.config)
        for error in damaged:
            say(f"{error}; resumes from an older one")
        return path
