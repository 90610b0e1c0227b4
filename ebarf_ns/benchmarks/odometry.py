"""Errors of trajectories estimated from events alone, against the ground truth of scenes.

python -m ebarf_ns.benchmarks.odometry SCENE ... [--output FILE.json] makes the table of docs/odometry.md.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from time import monotonic, process_time
from typing import Annotated, Any

import numpy as np
import tyro

from ebarf_ns.errors import OdometryError, one_line_errors
from ebarf_ns.evaluation.trajectory_error import errors_under_each_alignment, rotation_error_deg
from ebarf_ns.events.recording import RecordingFile
from ebarf_ns.files import whole_file
from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.odometry.estimate import Estimate
from ebarf_ns.odometry.output import of_scene
from ebarf_ns.odometry.settings import OdometrySettings
from ebarf_ns.scene import Scene, read_scene


def measured(folder: Path) -> dict[str, Any]:
    """The record of one scene: its estimate or the failure, errors, and seconds of computation per recorded second."""
    scene = read_scene(folder, trajectory_to_come=True)
    _, first_us, last_us = RecordingFile(scene.events, scene.camera.width, scene.camera.height).span()
    record: dict[str, Any] = {"scene": folder.name, "length_s": (last_us - first_us) * 1e-6}
    wall_s, cpu_s = monotonic(), process_time()
    try:
        estimate = of_scene(scene, OdometrySettings())
        record |= {"verdict": estimate.quality.kind, **_errors(estimate, scene)}
        record |= {name: getattr(estimate.quality, name) for name in ("span_share", "keyframes", "tracks")}
        record |= {"reprojection_px": estimate.quality.reprojection_px, "disagreement": estimate.quality.disagreement}
    except OdometryError as error:
        record |= {"verdict": str(error).split(": ", 1)[1]}
    record |= {"wall_s_per_s": (monotonic() - wall_s) / record["length_s"]}
    return record | {"cpu_s_per_s": (process_time() - cpu_s) / record["length_s"]}


def _errors(estimate: Estimate, scene: Scene) -> dict[str, float]:
    """Position errors as shares of the true path's extent, aligned by sim3 if defined, and by orientation."""
    if scene.groundtruth is None:
        return {}
    true = read_tum(scene.groundtruth)
    extent = float(np.linalg.norm(np.ptp(true.poses.position.numpy(), axis=0)))
    found = {"rotation_deg": rotation_error_deg(estimate.trajectory, true)}
    if estimate.quality.kind == "rotation only":
        return found
    errors, _ = errors_under_each_alignment(estimate.trajectory, true)
    of_positions = {f"{name}_share": error.ate_m / extent for name, error in errors.items() if name != "se3"}
    return found | of_positions


def table(records: list[dict[str, Any]]) -> str:
    """A Markdown table with one row per recording."""
    rows = ["| recording | verdict | span | error | by halves | rotation | s per s |", "|---|---|---|---|---|---|---|"]
    for one in records:
        share = one.get("sim3_share", one.get("orientation_share"))
        shown = [
            one["scene"],
            one["verdict"],
            _text(one.get("span_share"), "{:.0%}"),
            _text(share, "{:.1%}"),
            _text(one.get("disagreement"), "{:.1%}"),
            _text(one.get("rotation_deg"), "{:.2f}°"),
            f"{one['cpu_s_per_s']:.1f}",
        ]
        rows.append(f"| {' | '.join(shown)} |")
    return "\n".join(rows)


def _text(value: float | None, form: str) -> str:
    return "" if value is None else form.format(value)


def main(scenes: Annotated[tuple[Path, ...], tyro.conf.Positional], output: Path | None = None) -> None:
    """Measure scenes one after another."""
    with one_line_errors():
        records = [measured(folder) for folder in scenes]
    if output:
        with whole_file(output) as temporary:
            temporary.write_text(json.dumps(records, indent=1) + "\n", encoding="utf-8")
    sys.stdout.write(table(records) + "\n")


if __name__ == "__main__":
    tyro.cli(main)
