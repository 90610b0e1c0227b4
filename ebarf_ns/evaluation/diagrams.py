"""Error against run time over many trainings: work-precision diagrams, performance profiles, time to target.

All diagrams are functions of the records of a comparison.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from ebarf_ns.evaluation.basin import basin_figure
from ebarf_ns.evaluation.comparison_records import (
    AS_GOOD_AS_NOTHING,
    POSE_ERRORS,
    TOLERANCES,
    Record,
    by_problem,
    error_of,
    last_evaluation,
    panels_of,
    quartiles,
    refining_records,
    seconds_to,
)
from ebarf_ns.evaluation.comparison_tables import tables
from ebarf_ns.files import whole_file

_ERRORS = {
    "ate_m": "position error [m]",
    "rotation_deg": "rotation error [deg]",
    "image": "image error (RMSE)",
    "heldout_event_loss": "unexplained events",
}
_STYLES = {"method": "-", "floor": "--", "ceiling": ":"}


def write_diagrams(result: dict[str, Any], folder: Path) -> list[Path]:
    """Write the diagrams as SVG and the tables as Markdown; returns their paths."""
    records = result["records"]
    written = []
    figures = {"work_precision": _work_precision(records, result["roles"]), "profile": _profiles(records)}
    refining = refining_records(result)
    if len({record["trajectory"] for record in refining}) > 1:
        figures["basin"] = basin_figure(refining)
    for name, figure in figures.items():
        with whole_file(folder / f"{name}.svg") as temporary:
            figure.savefig(temporary, format="svg", bbox_inches="tight")
        plt.close(figure)
        written.append(folder / f"{name}.svg")
    with whole_file(folder / "tables.md") as temporary:
        temporary.write_text(tables(result), encoding="utf-8")
    return [*written, folder / "tables.md"]


def performance_profile(seconds: Mapping[str, Sequence[float]], factors: Sequence[float]) -> dict[str, list[float]]:
    """Share of problems that each method solves within a factor of the fastest one's time (Dolan, Moré 2002).

    ``seconds`` has each method's times for all problems, in the same order, infinite for failures.
    """
    best = np.min(list(seconds.values()), axis=0)
    with np.errstate(invalid="ignore"):
        ratios = {name: np.asarray(times) / best for name, times in seconds.items()}
    solved = {name: np.where(np.isnan(ratio), np.inf, ratio) for name, ratio in ratios.items()}
    return {name: [float(np.mean(ratio <= factor)) for factor in factors] for name, ratio in solved.items()}


def _work_precision(records: Sequence[Record], roles: dict[str, str]) -> Figure:
    """One row per scene and trajectory, one column per error."""
    panels = panels_of(records, roles)
    shape = (max(1, len(panels)), len(_ERRORS))
    figure, axes = plt.subplots(*shape, figsize=(4 * shape[1], 3.2 * shape[0]), squeeze=False)
    colours = dict(
        zip(
            dict.fromkeys(record["method"] for record in records),
            itertools.cycle(f"C{k}" for k in range(10)),
            strict=False,
        )
    )
    for row, ((scene, trajectory), group) in enumerate(panels.items()):
        for axis, (name, title) in zip(axes[row], _ERRORS.items(), strict=True):
            for (method,), own in by_problem(group, "method").items():
                if name in POSE_ERRORS and roles.get(method) == "floor":
                    # Methods that keep the given poses have no pose error to show.
                    continue
                _draw_curve(axis, own, name, colours[method], _STYLES[roles.get(method, "method")], method)
            given = [error_of(record["initial"], name) for record in group if record["trajectory"] == trajectory]
            if AS_GOOD_AS_NOTHING < np.median(given) < math.inf:
                axis.axhline(float(np.median(given)), color="grey", lw=1, ls="-.", label="as given")
            axis.set(xscale="log", yscale="log", title=f"{scene}, {trajectory}: {title}")
            seconds = sorted({record["seconds"] for record in group} | _first_seconds(group))
            axis.set_xticks(seconds, [f"{one:g}" for one in seconds])
            axis.xaxis.set_minor_formatter(NullFormatter())
            axis.title.set_fontsize(9)
            axis.grid(alpha=0.3, which="both")
            axis.set_xlabel("training time [s]")
    handles = {label: line for axis in axes.flat for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    axes[0][-1].legend(handles.values(), handles.keys(), fontsize=8)
    figure.tight_layout()
    return figure


def _first_seconds(records: Sequence[Record]) -> set[float]:
    """Times at which the faint curves of the longest trainings start."""
    longest = max(records, key=lambda record: record["seconds"])
    return {round(evaluation["train_seconds"], 1) for evaluation in longest["evaluations"][:1]}


def _draw_curve(axis: Axes, records: Sequence[Record], name: str, colour: Any, style: str, label: str) -> None:
    """Final errors of trainings of each length, median and quartiles over seeds; faint: the longest one's progress."""
    ends = {
        seconds: [error_of(last_evaluation(record), name) for record in group]
        for (seconds,), group in sorted(by_problem(records, "seconds").items())
    }
    low, middle, high = np.array([quartiles(errors) for errors in ends.values()]).T
    known = np.isfinite(middle)
    if not known.any():
        return
    seconds = np.array(list(ends))
    axis.plot(seconds[known], middle[known], style, marker="o", ms=4, color=colour, label=label)
    axis.vlines(seconds[known], low[known], np.where(np.isfinite(high), high, middle)[known], color=colour, lw=1.5)
    longest = [record for record in records if record["seconds"] == seconds.max() and record["evaluations"]]
    if not longest:
        return
    count = min(len(record["evaluations"]) for record in longest)
    way = np.median([[error_of(one, name) for one in record["evaluations"][:count]] for record in longest], axis=0)
    at = np.median([[one["train_seconds"] for one in record["evaluations"][:count]] for record in longest], axis=0)
    axis.plot(at, way, style, color=colour, lw=1, alpha=0.35)


def _profiles(records: Sequence[Record]) -> Figure:
    """Share of scenes, trajectories and seeds solved to a tolerance, over time relative to the fastest method."""
    errors = {"ate_m": "position error", "heldout_event_loss": "unexplained events"}
    figure, axes = plt.subplots(len(errors), len(TOLERANCES), figsize=(12, 6.4), squeeze=False)
    problems = by_problem(
        [record for record in records if record["trajectory"] != "true"], "scene", "trajectory", "seed"
    )
    methods = list(dict.fromkeys(record["method"] for group in problems.values() for record in group))
    factors = np.geomspace(1, 30, 100)
    for row, (name, title) in zip(axes, errors.items(), strict=True):
        for axis, tolerance in zip(row, TOLERANCES, strict=True):
            seconds: dict[str, list[float]] = {method: [] for method in methods}
            for group in problems.values():
                target = _target(group, name, tolerance)
                for method in methods:
                    own = [record for record in group if record["method"] == method]
                    seconds[method].append(seconds_to(own, name, target))
            if methods and problems:
                for method, shares in performance_profile(seconds, factors.tolist()).items():
                    axis.step(factors, 100 * np.array(shares), where="post", label=method)
            axis.set(xscale="log", ylim=(-3, 103), title=f"{title}, tolerance {tolerance:g}")
            axis.set(xlabel="time over the fastest's", ylabel="solved [%]")
            axis.grid(alpha=0.3)
    axes[0][0].legend(fontsize=8)
    figure.tight_layout()
    return figure


def _target(group: Sequence[Record], name: str, tolerance: float) -> float:
    """best + tolerance * (initial - best), with the best error of any method."""
    best = min((error_of(one, name) for record in group for one in record["evaluations"]), default=math.inf)
    initial = 1.0 if name == "heldout_event_loss" else error_of(group[0]["initial"], name)
    if not math.isfinite(best):
        return -math.inf
    return best + tolerance * (max(initial, best) - best if math.isfinite(initial) else 0.0)
