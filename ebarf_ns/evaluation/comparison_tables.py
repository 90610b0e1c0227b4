"""A comparison of methods as Markdown tables."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ebarf_ns.evaluation.basin import worse_lines
from ebarf_ns.evaluation.comparison_records import (
    AS_GOOD_AS_NOTHING,
    POSE_ERRORS,
    Panels,
    Record,
    by_problem,
    error_of,
    last_evaluation,
    panels_of,
    quartiles,
    refining_records,
    seconds_to,
)

_PSNR_TARGETS = (20.0, 22.0, 24.0, 26.0, 28.0)
_POSITION_TARGETS_M = (0.05, 0.02, 0.01, 0.005)


def tables(result: dict[str, Any]) -> str:
    """Markdown tables: errors after each time, methods against each other by seed, and time to each target."""
    panels = panels_of(result["records"], result["roles"])
    failed = [record for record in result["records"] if record.get("error")]
    count = f"{len(failed)} training{'s' if len(failed) > 1 else ''}" if failed else "No training"
    lines = [
        f"{result['machine']}, {result['date']}; medians over the seeds",
        *("", *_ends(panels)),
        *("", "Seed by seed against others, medians [quartiles]:"),
        *("", *_against_others(panels, result["roles"])),
        *("", "Seconds of training until reached:"),
        *("", *_seconds_until(panels)),
        *("", *worse_lines(refining_records(result))),
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
        for (method, seconds), own in by_problem(group, "method", "seconds").items():
            last = [last_evaluation(record) for record in own]
            psnr = float(np.median([_psnr(one) for one in last]))
            errors = (_shown(_median(last, name), unit) for name, unit in (("ate_m", "m"), ("rotation_deg", "deg")))
            unexplained = _shown(_median(last, "heldout_event_loss"), "")
            lines += _row(scene, trajectory, method, f"{seconds:g} s", _shown(psnr, "dB"), *errors, unexplained)
    return lines


def _against_others(panels: Panels, roles: dict[str, str]) -> list[str]:
    """Differences in PSNR to the first method and to the floor, with equal scene, trajectory, seed and time, for the
    floor also at equal steps; the share of trajectory errors left; and time per step relative to the first method."""
    first = next((method for method, role in roles.items() if role == "method"), "")
    floor = next((method for method, role in roles.items() if role == "floor"), "")
    lines = _head(
        *("scene", "trajectory", "method", "time", f"PSNR over {first}", "PSNR over the floor", "at equal steps"),
        *("position error left", "rotation error left", f"time a step over {first}"),
    )
    for (scene, trajectory), group in panels.items():
        by_name = {(record["method"], record["seed"], record["seconds"]): record for record in group}
        for (method, seconds), own in by_problem(group, "method", "seconds").items():
            compared = []
            for record in own:
                # The first method is not compared with itself.
                by_first = {} if method == first else by_name.get((first, record["seed"], seconds), {})
                by_floor = by_name.get((floor, record["seed"], seconds), {})
                compared.append(_compared(record, by_first, by_floor))
            cells = (_spread(values) for values in zip(*compared, strict=True))
            lines += _row(scene, trajectory, method, f"{seconds:g} s", *cells)
    return lines


def _compared(record: Record, by_first: Record, by_floor: Record) -> list[float]:
    end, end_of_first = last_evaluation(record), last_evaluation(by_first)
    return [
        _psnr(end) - _psnr(end_of_first),
        _psnr(end) - _psnr(last_evaluation(by_floor)),
        _psnr_over_at_equal_steps(record, by_floor),
        *(_ratio(error_of(end, name), error_of(record["initial"], name)) for name in POSE_ERRORS),
        _ratio(_seconds_a_step(end), _seconds_a_step(end_of_first)),
    ]


def _psnr_over_at_equal_steps(record: Record, other: Record) -> float:
    """PSNR difference at the largest step count of both, interpolated linearly over log(steps)."""
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
        for (method,), own in by_problem(group, "method").items():
            cells = []
            for name, target, _ in targets:
                times = [seconds_to(of_seed, name, target) for of_seed in by_problem(own, "seed").values()]
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
    """Ratio of two values; NaN if the second is close to zero, as errors of true poses are."""
    return error / other if other > AS_GOOD_AS_NOTHING else math.nan


def _spread(values: Sequence[float]) -> str:
    """Median and quartiles as text; "-" unless all values are known."""
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
