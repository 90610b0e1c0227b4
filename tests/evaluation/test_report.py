import json
from pathlib import Path

import pytest
import torch

from ebarf_ns.evaluation.report import write_report
from ebarf_ns.geometry.trajectory import Poses, Trajectory
from ebarf_ns.geometry.trajectory_file import write_tum

BY_ORIENTATION, BY_SIMILARITY = "position error, by orientation", "position error, sim3"


@pytest.mark.parametrize("ate_m, shown", [(0.02, BY_SIMILARITY), (None, BY_ORIENTATION)])
def test_the_curve_of_position_errors_is_there_for_motion_along_a_line_too(
    tmp_path: Path, ate_m: float | None, shown: str
):
    keyframes = Trajectory(
        torch.arange(5) * 100_000,
        Poses(torch.arange(15.0).reshape(5, 3), torch.tensor([1.0, 0, 0, 0]).expand(5, 4)),
    )
    for name in ("trajectory_initial.txt", "trajectory_refined.txt"):
        write_tum(tmp_path / name, keyframes)
    evaluations = [
        {"step": step, "train_seconds": 1.0 * step, "ate_m": ate_m, "ate_m_orientation": 0.1 / step} for step in (1, 2)
    ]
    (tmp_path / "metrics.jsonl").write_text("\n".join(json.dumps(line) for line in [{}, *evaluations]))
    write_report(tmp_path, None)
    drawn = (tmp_path / "report" / "work_precision.svg").read_text()
    assert [name for name in (BY_ORIENTATION, BY_SIMILARITY) if name in drawn] == [shown]


def test_the_report_says_what_held_out_events_say(tmp_path: Path):
    keyframes = Trajectory(torch.arange(5) * 100_000, Poses(torch.rand(5, 3), torch.eye(4)[:1].expand(5, 4)))
    for name in ("trajectory_initial.txt", "trajectory_refined.txt"):
        write_tum(tmp_path / name, keyframes)
    says = "events that were held out speak for the trajectory given\nleast certain is a tilt"
    record = {"step": 1, "train_seconds": 1.0, "support": {"verdict": "worse", "says": says}}
    (tmp_path / "metrics.jsonl").write_text("\n".join(json.dumps(line) for line in [{}, record]))
    page = write_report(tmp_path, None).read_text()
    assert "speak for the trajectory given<br>least certain is a tilt" in page and "verdict" not in page
