"""A run's folder as pictures: trajectories, error against run time, renders beside references, one page with all."""

import base64
import html
import json
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from ebarf_ns.errors import EvaluationError, did_you_mean
from ebarf_ns.evaluation.frames import lpips_note
from ebarf_ns.evaluation.trajectory_error import aligned_positions
from ebarf_ns.files import whole_file
from ebarf_ns.geometry.trajectory_file import read_tum

_CURVES = {
    "heldout_event_loss": "unexplained share of held-out events",
    "psnr": "PSNR [dB]",
    "ate_m": "position error, sim3 [m]",
    "ate_m_orientation": "position error, by orientation [m]",
    "rotation_deg": "rotation error [deg]",
}


def read_metrics(run: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Header and evaluations of ``run/metrics.jsonl``; raises :class:`EvaluationError`."""
    path = run / "metrics.jsonl"
    try:
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    except OSError as error:
        expected = f"expected the folder of a training run{_runs_below(run)}"
        raise EvaluationError(f"{path}: {error.strerror or error}; {expected}") from None
    except json.JSONDecodeError as error:
        raise EvaluationError(f"{path}: not one JSON object a line ({error})") from None
    evaluations = [line for line in lines if "train_seconds" in line]
    if not evaluations:
        raise EvaluationError(f"{path}: holds no evaluation yet, expected at least one")
    return lines[0], evaluations


def _runs_below(folder: Path) -> str:
    found = sorted(path.parent for path in folder.rglob("metrics.jsonl")) if folder.is_dir() else []
    return f", such as {', '.join(map(str, found[-3:]))}" if found else did_you_mean(folder)


def write_report(run: Path, groundtruth: Path | None) -> Path:
    """Write ``run/report/`` from the run's files and return the page."""
    header, evaluations = read_metrics(run)
    report = run / "report"
    figures = {
        "trajectory.svg": _trajectory_figure(run, groundtruth),
        "work_precision.svg": _curves_figure(evaluations),
    }
    for name, figure in figures.items():
        with whole_file(report / name) as temporary:
            figure.savefig(temporary, format="svg", bbox_inches="tight")
        plt.close(figure)
    page = _page(header, evaluations, report, sorted((run / "renders").glob("*.png")))
    with whole_file(report / "report.html") as temporary:
        temporary.write_text(page, encoding="utf-8")
    return report / "report.html"


def _trajectory_figure(run: Path, groundtruth: Path | None) -> Figure:
    reference = read_tum(groundtruth) if groundtruth else None
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.5))
    styles = {
        "trajectory_initial.txt": ("initial", "tab:blue", 0.8),
        "trajectory_refined.txt": ("refined", "tab:orange", 2),
    }
    for name, (label, colour, width) in styles.items():
        estimate = read_tum(run / name)
        position = aligned_positions(estimate, reference) if reference else estimate.poses.position.numpy()
        for axis, (first, second) in zip(axes, ((0, 1), (0, 2)), strict=True):
            axis.plot(position[:, first], position[:, second], color=colour, lw=width, marker=".", ms=4, label=label)
    if reference:
        inside = (reference.t_us >= estimate.t_us[0]) & (reference.t_us <= estimate.t_us[-1])
        position = reference.poses.position[inside].numpy()
        for axis, (first, second) in zip(axes, ((0, 1), (0, 2)), strict=True):
            axis.plot(position[:, first], position[:, second], "--", color="tab:green", lw=1.5, label="reference")
    for axis, names in zip(axes, ("xy", "xz"), strict=True):
        axis.set(xlabel=names[0], ylabel=names[1], aspect="equal")
        axis.set_adjustable("datalim")
        axis.grid(alpha=0.3)
    axes[0].legend()
    return figure


def _curves_figure(evaluations: list[dict[str, Any]]) -> Figure:
    names = [name for name in _CURVES if any(record.get(name) is not None for record in evaluations)]
    # Of motion along a line there is no other than by orientation.
    names = [name for name in names if name != "ate_m_orientation" or "ate_m" not in names]
    count = max(1, len(names))
    figure, axes = plt.subplots(1, count, figsize=(3.6 * count, 3.2), squeeze=False)
    for axis, name in zip(axes[0], names, strict=False):
        points = [(record["train_seconds"], record[name]) for record in evaluations if record.get(name) is not None]
        axis.plot(*zip(*points, strict=True), marker="o", ms=4)
        axis.set(xscale="log", xlabel="training time [s]", title=_CURVES[name])
        if name != "psnr":
            axis.set_yscale("log")
        axis.grid(alpha=0.3, which="both")
    figure.tight_layout()
    return figure


def _page(header: dict[str, Any], evaluations: list[dict[str, Any]], report: Path, renders: list[Path]) -> str:
    missing = lpips_note(evaluations[-1])
    columns = [
        key
        for key in evaluations[-1]
        if key != "support" and any(record.get(key) is not None for record in evaluations)
    ]
    says = html.escape((evaluations[-1].get("support") or {}).get("says", "")).replace("\n", "<br>")
    rows = "".join(
        "<tr>" + "".join(f"<td>{_cell(record.get(key))}</td>" for key in columns) + "</tr>" for record in evaluations
    )
    pictures = "".join(
        f'<figure><img src="data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}">'
        f"<figcaption>{html.escape(path.stem)}: render, reference</figcaption></figure>"
        for path in renders
    )
    svgs = "".join((report / name).read_text(encoding="utf-8") for name in ("trajectory.svg", "work_precision.svg"))
    facts = html.escape(", ".join(f"{key} {value}" for key, value in header.items() if key != "plan"))
    plan = "".join(
        f"<tr><td class=text>{html.escape(field)}<td>{_cell(line['value'])}<td class=text>{html.escape(line['reason'])}"
        for field, line in header.get("plan", {}).items()
    )
    return f"""<!doctype html><meta charset="utf-8"><title>{html.escape(report.parent.name)}</title>
<style>body{{font:14px sans-serif;max-width:70rem;margin:2rem auto}}svg{{max-width:100%;height:auto}}
td,th{{padding:.1rem .6rem;text-align:right}}.text{{text-align:left}}figure{{display:inline-block;margin:.3rem}}
img{{width:24rem;image-rendering:pixelated}}table{{display:block;overflow-x:auto}}</style>
<h1>{html.escape(str(header.get("method", "run")))}</h1><p>{facts}</p>
<h2>Trajectory</h2><p>{says}</p>
<p>Aligned to the reference where there is one (by orientation and scale).</p>{svgs}
<h2>Evaluations</h2><table><tr>{"".join(f"<th>{html.escape(key)}</th>" for key in columns)}</tr>{rows}</table>
<p>{html.escape(missing or "")}</p>
<h2>Views at the refined poses</h2>{pictures or "<p>The scene has no frames to compare with.</p>"}
<h2>Plan</h2><table>{plan}</table>
"""


def _cell(value: Any) -> str:
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else html.escape(str(value))
