"""Terminal output of a training: its scene and plan, one live line, a line per evaluation, a summary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import BarColumn, Progress, TextColumn

from ebarf_ns.plan import Line
from ebarf_ns.scene import Scene

Results = Mapping[str, Any]
_SAME = 1e-5
"""Errors, in degrees and in the reference's unit, below which a trajectory is the reference itself."""


def say(text: str) -> None:
    """Print text literally, since a path may contain rich markup."""
    CONSOLE.print(text, markup=False, soft_wrap=not CONSOLE.is_terminal)


def scene_line(scene: Scene, events: int, keyframes: int) -> str:
    """A line that describes the scene."""
    given = scene.contrast_threshold
    parts = [
        f"{events:,} events",
        f"{keyframes} keyframes",
        f"thresholds {given.on:g}/{given.off:g}" if given else "thresholds not stated",
        "bounds given" if scene.bounds else "no bounds",
        *(["reference trajectory"] if scene.groundtruth else []),
        *([f"{len(scene.frames)} frames"] if scene.frames else []),
    ]
    return f"scene   {scene.folder}: {', '.join(parts)}"


def plan_line(plan: Sequence[Line]) -> str:
    """A line that summarises the plan; ``ebarf inspect`` gives the reasons."""
    made = {line.field.rsplit(".", 1)[-1]: line.value for line in plan}
    parts = [
        f"grid of {made['grid_levels']} levels to {made['grid_finest']} cells",
        f"{made['samples']} samples a ray",
        str(made["precision"]),
        "spline between keyframes" if made["interpolation"] == "cubic" else "straight between keyframes",
        f"{made['train_num_rays_per_batch']:,} rays a step",
    ]
    return f"plan    {', '.join(parts)} (ebarf inspect says why)"


def errors_line(results: Results, given: Results) -> str:
    """Errors in common units, those of the given trajectory before those of the refined one.

    ``given`` are the errors of the initial trajectory, see
    :func:`~ebarf_ns.evaluation.trajectory_error.trajectory_results`; empty without a reference.
    """
    parts = []
    if results.get("heldout_event_loss") is not None:
        parts.append(f"unexplained events {results['heldout_event_loss']:.1%}")
    if results.get("psnr") is not None:
        parts.append(f"PSNR {results['psnr']:.1f} dB")
    # On a straight line or without translation, positions are aligned differently or not at all.
    position = next((name for name in ("ate_m", "ate_m_orientation") if results.get(name) is not None), None)
    if position:
        parts.append(f"position {_was(given, position, 100, '.3g')}{100 * results[position]:.3g} cm")
    if results.get("rotation_deg") is not None:
        parts.append(f"rotation {_was(given, 'rotation_deg', 1, '.2f')}{results['rotation_deg']:.2f}°")
    errors = [given[name] for name in ("rotation_deg", "ate_m", "ate_m_orientation") if given.get(name) is not None]
    if len(errors) > 1 and max(errors) < _SAME:
        parts.append("(the given trajectory is the reference)")
    return "  ".join(parts)


def _was(given: Results, name: str, factor: float, form: str) -> str:
    return f"{factor * given[name]:{form}} → " if given.get(name) is not None else ""


def evaluation_line(seconds: float, step: int, results: Results, given: Results) -> str:
    """The line of one evaluation."""
    return f"{seconds:6.0f} s  step {step:,}  {errors_line(results, given)}"


def summary(folder: Path, train_seconds: float, wall_seconds: float, results: Results, given: Results) -> str:
    """The summary of a run: its errors, its cost, its files, and what to do next."""
    config = folder / "config.yml"
    return "\n".join(
        [
            f"done    {errors_line(results, given)}",
            f"        {train_seconds:.0f} s of training in {wall_seconds:.0f} s, with evaluations",
            f"run     {folder}",
            f"report  {folder / 'report' / 'report.html'}",
            f"poses   {folder / 'trajectory_refined.txt'}",
            f"next    ns-viewer --load-config {config}",
        ]
    )


class LiveLine:
    """A progress line, updated in place: share of the budget, step, rate, time left; only shown on a terminal."""

    def __init__(self) -> None:
        columns = (BarColumn(24), TextColumn("{task.percentage:3.0f} %  {task.fields[said]}"))
        self._progress = Progress(*columns, console=CONSOLE, transient=True, refresh_per_second=4)
        self._progress.disable = not CONSOLE.is_terminal
        self._task = self._progress.add_task("training", total=1.0, said="")

    def __enter__(self) -> LiveLine:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """Remove the line."""
        self._progress.stop()

    def update(self, share: float, step: int, seconds: float, seconds_a_step: float, loss: float) -> None:
        """Show the used share of the budget after ``seconds`` of training."""
        left = seconds * (1 - share) / share if share > 0 else 0.0
        said = f"step {step:,}  {1e3 * seconds_a_step:.0f} ms a step  {_clock(left)} left  loss {loss:.3g}"
        self._progress.update(self._task, completed=min(share, 1.0), said=said)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
