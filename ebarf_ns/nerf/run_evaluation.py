"""The files that an evaluation writes to a run's folder."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfstudio.utils import writer

from ebarf_ns.nerf.metrics_file import record_metrics
from ebarf_ns.scene import write_camera

if TYPE_CHECKING:
    from ebarf_ns.nerf.pipeline import EbarfPipeline
    from ebarf_ns.nerf.support import Support


def write_refined(pipeline: EbarfPipeline, folder: Path) -> None:
    """Write the refined trajectory, and the camera if its intrinsics are learned."""
    pipeline.write_refined(folder / "trajectory_refined.txt")
    if pipeline.model.intrinsics:
        write_camera(folder / "camera_refined.json", pipeline.model.intrinsics.refined())


def record_evaluation(record: dict[str, Any], found: Support | None, folder: Path) -> None:
    """Add a record to the run's metrics and logs, with the trajectory's support by held-out events, if given."""
    if found:
        record["support"] = {
            "verdict": found.verdict,
            "says": str(found),
            "positions_undecided": found.positions_undecided,
            **asdict(found),
        }
    record_metrics(folder, record)
    numbers = {name: value for name, value in record.items() if isinstance(value, float)}
    writer.put_dict(name="Evaluation", scalar_dict=numbers, step=record["step"] - 1)
