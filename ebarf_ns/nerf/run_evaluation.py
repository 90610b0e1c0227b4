"""What an evaluation leaves in a run's folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE

from ebarf_ns.geometry.trajectory_file import write_tum
from ebarf_ns.nerf.metrics_file import record_metrics
from ebarf_ns.scene import write_camera

if TYPE_CHECKING:
    from ebarf_ns.nerf.pipeline import EbarfPipeline


def write_refined(pipeline: EbarfPipeline, results: dict[str, Any], folder: Path) -> None:
    """Write the refined trajectory, and the camera where its intrinsics are learned."""
    comments = []
    if results["keyframes_inserted"]:
        comments.append(f"inserted keyframes: {results['keyframes_inserted']}")
    given, refined = pipeline.trajectory(refined=False), pipeline.trajectory()
    if added_us := int(refined.t_us[0] - given.t_us[0]):
        comments.append(f"clock of the events: {added_us:+} us were added to the times given")
    write_tum(folder / "trajectory_refined.txt", refined, comments)
    if pipeline.model.intrinsics:
        write_camera(folder / "camera_refined.json", pipeline.model.intrinsics.refined())


def record_evaluation(record: dict[str, Any], results: dict[str, Any], folder: Path) -> None:
    """Add a record to the run's metrics, and show the numbers among its results."""
    record_metrics(folder, record)
    numbers = {name: value for name, value in results.items() if isinstance(value, float)}
    writer.put_dict(name="Evaluation", scalar_dict=numbers, step=record["step"] - 1)
    shown = "  ".join(f"{name} {value:.4g}" for name, value in numbers.items())
    CONSOLE.print(f"step {record['step']}, {record['train_seconds']:.1f} s, {record['event_pairs']:,} pairs:  {shown}")
