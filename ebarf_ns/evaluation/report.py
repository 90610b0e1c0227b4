"""The report of a run, a self-contained HTML page: verdict, trajectories, renders, events, numbers, plan."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from ebarf_ns.errors import EvaluationError, did_you_mean
from ebarf_ns.evaluation.frames import lpips_note
from ebarf_ns.evaluation.report_figures import (
    axes_figure,
    curves_figure,
    drawn,
    errors_figure,
    moments_figure,
    read_moments,
    views_figure,
    with_error_map,
)
from ebarf_ns.evaluation.trajectory_error import trajectory_results
from ebarf_ns.evaluation.verdict import verdict
from ebarf_ns.files import whole_file
from ebarf_ns.geometry.trajectory import Trajectory, interpolate, within_span
from ebarf_ns.geometry.trajectory_file import read_tum

Record = dict[str, Any]
_NAMES: dict[str, tuple[str, str]] = {
    "train_seconds": ("training time", "{:.0f} s"),
    "step": ("steps", "{:,.0f}"),
    "event_pairs": ("event pairs", "{:,.0f}"),
    "heldout_event_loss": ("unexplained share of held-out events", "{:.1%}"),
    "psnr": ("PSNR", "{:.2f} dB"),
    "ssim": ("SSIM", "{:.3f}"),
    "lpips": ("LPIPS", "{:.3f}"),
    "ate_m": ("position error, aligned by similarity, in the reference's unit", "{:.3g}"),
    "ate_m_orientation": ("position error, aligned by orientation and scale", "{:.3g}"),
    "rotation_deg": ("rotation error", "{:.3f}°"),
    "implied_threshold_on": ("threshold of brighter events that renders imply", "{:.3f}"),
    "implied_threshold_off": ("threshold of darker events that renders imply", "{:.3f}"),
    "time_constant_us": ("time constant of the photoreceptor", "{:.0f} us"),
    "clock_offset_ms": ("clock offset", "{:.2f} ms"),
    "peak_memory_mib": ("peak memory", "{:,.0f} MiB"),
}
_HEAD = '<meta charset="utf-8"><meta name="viewport" content="width=device-width,initial-scale=1">'
_MOST_RENDERS = 12
_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;max-width:62rem;margin:0 auto;padding:1rem;color:#222;background:#fff}
h1{font-size:1.5rem}h2{font-size:1.15rem;margin-top:2rem;border-top:1px solid #ddd;padding-top:1rem}
svg,img{max-width:100%;height:auto}img{width:48rem;image-rendering:pixelated}
figure{margin:.6rem 0}figcaption{color:#555}
.verdict{border-left:.5rem solid #888;background:#f4f4f4;padding:.6rem 1rem}.good{border-color:#2a8a3a}
.doubtful{border-color:#d99b00}.bad{border-color:#c62828}.scroll{overflow-x:auto}pre{white-space:pre-wrap;
overflow-wrap:anywhere;background:#f4f4f4;padding:.6rem}table{border-collapse:collapse}
td,th{padding:.15rem .6rem;text-align:right;vertical-align:top}td:first-child,th:first-child,.text{text-align:left}
@media print{h2{break-before:auto}figure{break-inside:avoid}}
"""


def read_metrics(run: Path) -> tuple[Record, list[Record]]:
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
    """Write ``run/report/report.html`` and its figures from the run's files, and return the page's path."""
    header, evaluations = read_metrics(run)
    reference = read_tum(groundtruth) if groundtruth else None
    initial, refined = (read_tum(run / f"trajectory_{name}.txt") for name in ("initial", "refined"))
    trajectories = drawn(initial, refined, reference)
    figures: dict[str, Figure | None] = {
        "trajectory": views_figure(trajectories),
        "axes": axes_figure(trajectories),
        "errors_over_time": errors_figure(initial, refined, reference) if reference else None,
        "work_precision": curves_figure(evaluations),
    }
    svgs = {name: _svg(figure) for name, figure in figures.items() if figure}
    for name in ("trajectory", "work_precision"):
        with whole_file(run / "report" / f"{name}.svg") as temporary:
            temporary.write_text(svgs[name], encoding="utf-8")
    given = trajectory_results(initial, reference) if reference else {}
    moved = _moved(initial, refined)
    page = _page(run, header, evaluations, given, moved, svgs)
    with whole_file(run / "report" / "report.html") as temporary:
        temporary.write_text(page, encoding="utf-8")
    return run / "report" / "report.html"


def _svg(figure: Figure) -> str:
    file = BytesIO()
    figure.savefig(file, format="svg", bbox_inches="tight")
    plt.close(figure)
    text = file.getvalue().decode()
    return text[text.index("<svg") :]


def _moved(initial: Trajectory, refined: Trajectory) -> tuple[float, float] | None:
    """RMS correction of the trajectory: share of its extent, and degrees; None for too few poses."""
    shared = initial.t_us[within_span(initial.t_us, refined.t_us)]
    if len(shared) < 3:
        return None
    now = Trajectory(shared, interpolate(refined.t_us, refined.poses, shared))
    results = trajectory_results(now, initial)
    position = next((results[name] for name in ("ate_m", "ate_m_orientation") if results[name] is not None), None)
    extent = float((initial.poses.position - initial.poses.position.mean(0)).norm(dim=-1).square().mean().sqrt())
    if position is None or results["rotation_deg"] is None or extent == 0:
        return None
    return position / extent, results["rotation_deg"]


def _page(
    run: Path,
    header: Record,
    evaluations: list[Record],
    given: Record,
    moved: tuple[float, float] | None,
    svgs: dict[str, str],
) -> str:
    last, scene = evaluations[-1], Path(header.get("scene", run.name)).name
    found = verdict(last, moved)
    aligned = "Aligned to the reference by orientation and scale." if given else "As given: there is no reference."
    sections = [
        f"<h1>{_text(scene)}: {_text(header.get('method', 'run'))}</h1>",
        f"<p>{_text(_what_was_run(header, last))}</p>",
        f"<div class='verdict {found.mark}'><b>{_text(found.headline)}</b>{_list(found.reasons)}{_support(last)}</div>",
        f"<h2>Before and after</h2>{_numbers(evaluations, given)}",
        f"<h2>Error against run time</h2><div>{svgs['work_precision']}</div>",
        f"<h2>Trajectory</h2><p>{aligned}</p><div>{svgs['trajectory']}</div><div>{svgs['axes']}</div>",
    ]
    if "errors_over_time" in svgs:
        sections.append(f"<h3>Errors over time</h3><div>{svgs['errors_over_time']}</div>")
    sections += [
        f"<h2>Renders beside frames that were never used</h2>{_renders(run)}",
        f"<h2>Events, recorded and predicted</h2>{_moments(run)}",
        f"<h2>Sensor, as found</h2>{_sensor(header, last)}",
        f"<h2>How it was run</h2>{_how(header)}",
    ]
    title = f"<title>{_text(scene)}: {_text(header.get('method', 'run'))}</title>"
    return f"<!doctype html>{_HEAD}{title}<style>{_STYLE}</style>{''.join(sections)}\n"


def _text(value: object) -> str:
    return html.escape(str(value))


def _list(lines: Iterable[str]) -> str:
    return f"<ul>{''.join(f'<li>{_text(line)}' for line in lines)}</ul>"


def _what_was_run(header: Record, last: Record) -> str:
    parts = [f"{last['train_seconds']:.0f} s of training, {last.get('step', 0):,} steps"]
    for name, word in (("device", "on"), ("date", "on"), ("seed", "seed")):
        if header.get(name) is not None:
            parts.append(f"{word} {header[name]}")
    return ", ".join(parts)


def _support(last: Record) -> str:
    says = (last.get("support") or {}).get("says", "")
    return f"<p>{_text(says)}</p>".replace("\n", "<br>") if says else ""


def _numbers(evaluations: list[Record], given: Record) -> str:
    """A table with metrics in rows and evaluations in columns; the given trajectory comes first, if evaluated."""
    rows, judged = [], any(isinstance(given.get(name), int | float) for name in _NAMES)
    for name, (words, form) in _NAMES.items():
        values = [record.get(name) for record in ((given, *evaluations) if judged else evaluations)]
        if any(isinstance(value, int | float) for value in values[judged:]):
            shown = ("" if value is None else form.format(value) for value in values)
            rows.append(f"<tr><td>{words}{''.join(f'<td>{value}' for value in shown)}")
    heads = "".join(f"<th>{name}" for name in ("", *["as given"] * judged, *range(1, len(evaluations)), "last"))
    every = _text(json.dumps(evaluations[-1], indent=1))
    # Omit the path of the weights, which is specific to this machine.
    note, weights, _ = (lpips_note(evaluations[-1]) or "").partition(" are not at ")
    note += " are not installed" if weights else ""
    return (
        f"<div class=scroll><table><tr>{heads}{''.join(rows)}</table></div>{f'<p>{_text(note)}</p>' if note else ''}"
        f"<details><summary>all numbers of the last evaluation</summary><pre>{every}</pre></details>"
    )


def _renders(run: Path) -> str:
    paths = sorted((run / "renders").glob("*.png"))
    if not paths:
        return "<p>The scene has no frames to compare with. What held-out events say stands above.</p>"
    chosen = paths[:: -(-len(paths) // _MOST_RENDERS)]
    count = "" if len(chosen) == len(paths) else f"{len(chosen)} of {len(paths)} frames. "
    figures = [f"<p>{count}The table's PSNR is of linear brightness, that of a picture of its grey values.</p>"]
    for path in chosen:
        picture, psnr = with_error_map(path)
        source = f"data:image/png;base64,{base64.b64encode(picture).decode()}"
        figures.append(
            f'<figure><img alt="render, frame and error" src="{source}">'
            f"<figcaption>{_text(path.stem)}: render, frame, error (blue: too dark, red: too bright); {psnr:.1f} dB as "
            "shown</figcaption></figure>"
        )
    return "".join(figures)


def _moments(run: Path) -> str:
    moments = read_moments(run / "moments.npz")
    if moments is None:
        return "<p>This run left none.</p>"
    return (
        "<p>Sums of polarities per pixel. Predicted: the change of the rendered log brightness over the window, in "
        f"thresholds. Pixels that are blind after an event report fewer.</p><div>{_svg(moments_figure(moments))}</div>"
    )


def _sensor(header: Record, last: Record) -> str:
    on, off = last.get("implied_threshold_on"), last.get("implied_threshold_off")
    constant_us = last.get("time_constant_us")
    facts = [
        f"ratio of thresholds C_on / C_off: {on / off:.2f}" if on and off else "",
        f"blind time after an event: {header['blind_us']:,} us" if header.get("blind_us") is not None else "",
        f"hot pixels left out: {header['hot_pixels_left_out']:,}" if header.get("hot_pixels_left_out") else "",
        f"time constant of the photoreceptor: {constant_us:.0f} us" if constant_us else "",
    ]
    return _list(fact for fact in facts if fact)


def _how(header: Record) -> str:
    command = f"<pre>{_text(header['command'])}</pre>" if header.get("command") else ""
    plan = {f"--{field.replace('_', '-')}": line for field, line in header.get("plan", {}).items()}
    lines = "".join(
        f"<tr><td class=text>{_text(flag)} {_text(line['value'])}<td class=text>{_text(line['reason'])}"
        for flag, line in plan.items()
    )
    rest = {key: value for key, value in header.items() if key not in ("plan", "command")}
    settings = _text(json.dumps(rest, indent=1))
    return (
        f"{command}<details open><summary>plan</summary><div class=scroll><table>{lines}</table></div></details>"
        f"<details><summary>versions, digests, settings</summary><pre>{settings}</pre></details>"
    )
