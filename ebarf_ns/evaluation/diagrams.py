"""Error against run time over many trainings: work-precision diagrams, performance profiles, time to target.

Everything here is a function of the records that a comparison leaves.
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
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from ebarf_ns.evaluation.basin import basin_figure, worse_lines
from ebarf_ns.files import whole_file

Record = dict[str, Any]
Panels = dict[tuple[str, str], list[Record]]

_ERRORS = {
    "ate_m": "position error [m]",
    "rotation_deg": "rotation error [deg]",
    "image": "image error (RMSE)",
    "heldout_event_loss": "unexplained events",
}
_POSE_ERRORS = ("ate_m", "rotation_deg")
_AS_GOOD_AS_NOTHING = 1e-7
_STYLES = {"method": "-", "floor": "--", "ceiling": ":"}
_HUGE = 1e300
_TOLERANCES = (0.1, 0.01, 0.001)
_PSNR_TARGETS = (20.0, 22.0, 24.0, 26.0, 28.0)
_POSITION_TARGETS_M = (0.05, 0.02, 0.01, 0.005)


def write_diagrams(result: dict[str, Any], folder: Path) -> list[Path]:
    """Write the diagrams as SVG and the tables as Markdown; returns their paths."""
    records = result["records"]
    written = []
    figures = {"work_precision": _work_precision(records, result["roles"]), "profile": _profiles(records)}
    refining = _refining(result)
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


def _refining(result: dict[str, Any]) -> list[Record]:
    return [record for record in result["records"] if result["roles"].get(record["method"], "method") == "method"]


def error_of(evaluation: Record, name: str) -> float:
    """One error of one evaluation, smaller is better; infinite where it is not known."""
    if name == "image":
        psnr = evaluation.get("psnr")
        return math.inf if psnr is None else 10 ** (-psnr / 20)
    value = evaluation.get(name)
    if value is None and name == "ate_m":
        # Along a line only orientation and scale can be aligned.
        value = evaluation.get("ate_m_orientation")
    return math.inf if value is None else float(value)


def _last(record: Record) -> Record:
    """The last evaluation; of a training that failed or that there is none of, nothing, which is infinitely bad."""
    return record["evaluations"][-1] if record.get("evaluations") else {}


def seconds_to(records: Sequence[Record], name: str, target: float) -> float:
    """Training time after which an error is at most ``target`` in trainings of one problem; infinite where never."""
    reached = [
        evaluation["train_seconds"]
        for record in records
        for evaluation in record["evaluations"]
        if error_of(evaluation, name) <= target
    ]
    return min(reached, default=math.inf)


def performance_profile(seconds: Mapping[str, Sequence[float]], factors: Sequence[float]) -> dict[str, list[float]]:
    """Share of the problems that each method solves within a factor of the fastest one's time (Dolan, Moré 2002).

    ``seconds`` has each method's time for every problem, in the same order, infinite where it fails.
    """
    best = np.min(list(seconds.values()), axis=0)
    with np.errstate(invalid="ignore"):
        ratios = {name: np.asarray(times) / best for name, times in seconds.items()}
    solved = {name: np.where(np.isnan(ratio), np.inf, ratio) for name, ratio in ratios.items()}
    return {name: [float(np.mean(ratio <= factor)) for factor in factors] for name, ratio in solved.items()}


def _problems(records: Sequence[Record], *keys: str) -> dict[tuple, list[Record]]:
    """Records grouped by some of what they are about, in order of appearance."""
    groups: dict[tuple, list[Record]] = {}
    for record in records:
        groups.setdefault(tuple(record[key] for key in keys), []).append(record)
    return groups


def _panels(records: Sequence[Record], roles: dict[str, str]) -> Panels:
    """The records of each scene and trajectory; floors go into all panels of their scene."""
    floors = [record for record in records if roles.get(record["method"]) == "floor"]
    others = [record for record in records if roles.get(record["method"]) != "floor"]
    panels = _problems(others, "scene", "trajectory")
    return {
        (scene, trajectory): [*own, *(floor for floor in floors if floor["scene"] == scene)]
        for (scene, trajectory), own in panels.items()
    }


def _work_precision(records: Sequence[Record], roles: dict[str, str]) -> Figure:
    """One row for each scene and trajectory, one column for each error."""
    panels = _panels(records, roles)
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
            for (method,), own in _problems(group, "method").items():
                if name in _POSE_ERRORS and roles.get(method) == "floor":
                    # Poses that are given as they are say nothing here.
                    continue
                _draw_curve(axis, own, name, colours[method], _STYLES[roles.get(method, "method")], method)
            given = [error_of(record["initial"], name) for record in group if record["trajectory"] == trajectory]
            if _AS_GOOD_AS_NOTHING < np.median(given) < math.inf:
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
    """Where the faint way of the longest training begins."""
    longest = max(records, key=lambda record: record["seconds"])
    return {round(evaluation["train_seconds"], 1) for evaluation in longest["evaluations"][:1]}


def _draw_curve(axis: Axes, records: Sequence[Record], name: str, colour: Any, style: str, label: str) -> None:
    """Where trainings of each length end, median and quartiles of the seeds; faintly, the way of the longest there."""
    ends = {
        seconds: [error_of(_last(record), name) for record in group]
        for (seconds,), group in sorted(_problems(records, "seconds").items())
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


def quartiles(errors: Sequence[float]) -> Float[np.ndarray, "3"]:
    """First quartile, median and third; infinite where a failed training takes part in them."""
    found = np.quantile(np.minimum(errors, _HUGE), (0.25, 0.5, 0.75))
    return np.where(found > math.sqrt(_HUGE), math.inf, found)


def _profiles(records: Sequence[Record]) -> Figure:
    """Share of scenes, trajectories and seeds solved to a tolerance, over the time that the fastest takes."""
    errors = {"ate_m": "position error", "heldout_event_loss": "unexplained events"}
    figure, axes = plt.subplots(len(errors), len(_TOLERANCES), figsize=(12, 6.4), squeeze=False)
    problems = _problems(
        [record for record in records if record["trajectory"] != "true"], "scene", "trajectory", "seed"
    )
    methods = list(dict.fromkeys(record["method"] for group in problems.values() for record in group))
    factors = np.geomspace(1, 30, 100)
    for row, (name, title) in zip(axes, errors.items(), strict=True):
        for axis, tolerance in zip(row, _TOLERANCES, strict=True):
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
    """best + tolerance * (initial - best), the best of any method."""
    best = min((error_of(one, name) for record in group for one in record["evaluations"]), default=math.inf)
    initial = 1.0 if name == "heldout_event_loss" else error_of(group[0]["initial"], name)
    if not math.isfinite(best):
        return -math.inf
    return best + tolerance * (max(initial, best) - best if math.isfinite(initial) else 0.0)


def tables(result: dict[str, Any]) -> str:
    """How good after each time, each seed against others, and how long to each target, as Markdown."""
    panels = _panels(result["records"], result["roles"])
    failed = [record for record in result["records"] if record.get("error")]
    count = f"{len(failed)} training{'s' if len(failed) > 1 else ''}" if failed else "No training"
    lines = [
        f"{result['machine']}, {result['date']}; medians over the seeds",
        *("", *_ends(panels)),
        *("", "Seed by seed against others, medians [quartiles]:"),
        *("", *_against_others(panels, result["roles"])),
        *("", "Seconds of training until reached:"),
        *("", *_seconds_until(panels)),
        *("", *worse_lines(_refining(result))),
        *("", f"{count} failed."),
        *(f"- {record['method']}, {record['scene']}, seed {record['seed']}: {record['error']}" for record in failed),
    ]
    return "\n".join(lines) + "\n"


def _ends(panels: Panels) -> list[str]:
    lines = _head("scene", "trajectory", "method", "time", "PSNR", "position error", "rotation error", "unexplained")
    for (scene, trajectory), group in panels.items():
        initial = [record["initial"] for record in group if record["trajectory"] == trajectory]
        given = (_shown(_median(initial, name), unit) for name, unit in (("ate_m", "m"), ("rotation_deg", "deg")))
        lines += _row(scene, trajectory, "as given", "", "", *given, "")
        for (method, seconds), own in _problems(group, "method", "seconds").items():
            last = [_last(record) for record in own]
            psnr = float(np.median([_psnr(one) for one in last]))
            errors = (_shown(_median(last, name), unit) for name, unit in (("ate_m", "m"), ("rotation_deg", "deg")))
            unexplained = _shown(_median(last, "heldout_event_loss"), "")
            lines += _row(scene, trajectory, method, f"{seconds:g} s", _shown(psnr, "dB"), *errors, unexplained)
    return lines


def _against_others(panels: Panels, roles: dict[str, str]) -> list[str]:
    """What each training has over that of the same scene, trajectory, seed and time by the first method, and by the
    floor, after all and after equally many steps, and which part of the trajectory's errors it left."""
    first = next((method for method, role in roles.items() if role == "method"), "")
    floor = next((method for method, role in roles.items() if role == "floor"), "")
    lines = _head(
        *("scene", "trajectory", "method", "time", f"PSNR over {first}", "PSNR over the floor", "at equal steps"),
        *("position error left", "rotation error left", f"time a step over {first}"),
    )
    for (scene, trajectory), group in panels.items():
        by_name = {(record["method"], record["seed"], record["seconds"]): record for record in group}
        for (method, seconds), own in _problems(group, "method", "seconds").items():
            compared = []
            for record in own:
                # Nothing is told of the first method against itself.
                by_first = {} if method == first else by_name.get((first, record["seed"], seconds), {})
                by_floor = by_name.get((floor, record["seed"], seconds), {})
                compared.append(_compared(record, by_first, by_floor))
            cells = (_spread(values) for values in zip(*compared, strict=True))
            lines += _row(scene, trajectory, method, f"{seconds:g} s", *cells)
    return lines


def _compared(record: Record, by_first: Record, by_floor: Record) -> list[float]:
    end, end_of_first = _last(record), _last(by_first)
    return [
        _psnr(end) - _psnr(end_of_first),
        _psnr(end) - _psnr(_last(by_floor)),
        _psnr_over_at_equal_steps(record, by_floor),
        *(_ratio(error_of(end, name), error_of(record["initial"], name)) for name in _POSE_ERRORS),
        _ratio(_seconds_a_step(end), _seconds_a_step(end_of_first)),
    ]


def _psnr_over_at_equal_steps(record: Record, other: Record) -> float:
    """After the most steps that both have had, on straight lines over log(steps) between evaluations."""
    curves = _psnr_over_log_steps(record), _psnr_over_log_steps(other)
    if not all(log_steps for log_steps, _ in curves):
        return math.nan
    both_had = min(log_steps[-1] for log_steps, _ in curves)
    ours, theirs = (np.interp(both_had, *curve) for curve in curves)
    return float(ours - theirs)


def _psnr_over_log_steps(record: Record) -> tuple[list[float], list[float]]:
    counted = [evaluation for evaluation in record.get("evaluations", []) if evaluation.get("step")]
    return [math.log(evaluation["step"]) for evaluation in counted], [_psnr(evaluation) for evaluation in counted]


def _seconds_until(panels: Panels) -> list[str]:
    targets = [("image", 10 ** (-psnr / 20), f"{psnr:g} dB") for psnr in _PSNR_TARGETS]
    targets += [("ate_m", metres, f"{100 * metres:g} cm") for metres in _POSITION_TARGETS_M]
    lines = _head("scene", "trajectory", "method", *(title for _, _, title in targets))
    for (scene, trajectory), group in panels.items():
        for (method,), own in _problems(group, "method").items():
            cells = []
            for name, target, _ in targets:
                times = [seconds_to(of_seed, name, target) for of_seed in _problems(own, "seed").values()]
                middle = float(np.median(times))
                cells.append(f"{middle:.0f}" if math.isfinite(middle) else "not reached")
            lines += _row(scene, trajectory, method, *cells)
    return lines


def _psnr(evaluation: Record) -> float:
    psnr = evaluation.get("psnr")
    return -math.inf if psnr is None else psnr


def _seconds_a_step(evaluation: Record) -> float:
    return _ratio(evaluation.get("train_seconds", math.nan), evaluation.get("step", 0))


def _ratio(error: float, other: float) -> float:
    """Unknown where the other one is as good as nothing, as errors of true poses are."""
    return error / other if other > _AS_GOOD_AS_NOTHING else math.nan


def _spread(values: Sequence[float]) -> str:
    """Median and quartiles, where all of them are known."""
    if not np.isfinite(values).all():
        return "-"
    low, middle, high = quartiles(values)
    return f"{middle:.2f} [{low:.2f}, {high:.2f}]"


def _head(*titles: str) -> list[str]:
    return [*_row(*titles), "|---" * len(titles) + "|"]


def _row(*cells: str) -> list[str]:
    return ["| " + " | ".join(cells) + " |"]


def _median(evaluations: Sequence[Record], name: str) -> float:
    return float(np.median([error_of(evaluation, name) for evaluation in evaluations]))


def _shown(value: float, unit: str) -> str:
    return f"{value:.3g} {unit}".strip() if math.isfinite(value) else "-"
