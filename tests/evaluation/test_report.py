import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from ebarf_ns.evaluation.report import write_report
from ebarf_ns.evaluation.report_figures import drawn
from ebarf_ns.evaluation.verdict import verdict
from ebarf_ns.geometry.trajectory import Poses, Trajectory
from ebarf_ns.geometry.trajectory_file import write_tum

BY_ORIENTATION, BY_SIMILARITY = "position error (orientation)", "position error (sim3)"


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
    says = "held-out events support the given trajectory\nleast certain is a tilt"
    record = {"step": 1, "train_seconds": 1.0, "support": {"verdict": "worse", "says": says}}
    (tmp_path / "metrics.jsonl").write_text("\n".join(json.dumps(line) for line in [{}, record]))
    page = write_report(tmp_path, None).read_text()
    assert (
        "support the given trajectory<br>least certain is a tilt" in page
        and "support the given trajectory, not the refined one" in page
    )


def trajectories(folder: Path, reference: bool = True) -> Path | None:
    """A helix, its refined estimate a little off, its initial one further; one reference pose more at either end."""
    random = np.random.default_rng(0)
    t_us = torch.arange(22) * 50_000
    seconds = t_us.double() * 1e-6
    position = torch.stack([seconds.cos(), seconds.sin(), 0.3 * seconds], dim=1)
    quat_wxyz = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand(22, 4)
    write_tum(folder / "groundtruth.txt", Trajectory(t_us, Poses(position, quat_wxyz)))
    for name, deviation in (("initial", 0.03), ("refined", 0.003)):
        noise = torch.from_numpy(random.normal(0, deviation, (20, 3)))
        write_tum(
            folder / f"trajectory_{name}.txt", Trajectory(t_us[1:-1], Poses(position[1:-1] + noise, quat_wxyz[1:-1]))
        )
    return folder / "groundtruth.txt" if reference else None


def metrics(folder: Path, **last: object) -> None:
    header: dict[str, object] = {
        "method": "ebarf",
        "scene": "/somewhere/my <scene>",
        "command": "ns-train ebarf --data my_scene",
    }
    header["plan"] = {"pipeline.model.grid_levels": {"value": 8, "reason": "a pixel covers 3 mm"}}
    records = [{"step": k, "train_seconds": 10.0 * k, "heldout_event_loss": 1 / k, "psnr": 10.0 + k} for k in (1, 2)]
    lines = [header, *records, {"step": 3, "train_seconds": 30.0, "heldout_event_loss": 0.11, "psnr": 25.0, **last}]
    (folder / "metrics.jsonl").write_text("\n".join(json.dumps(line) for line in lines))


def test_a_page_says_all_and_needs_nothing_else(tmp_path: Path):
    metrics(tmp_path, implied_threshold_on=0.2, implied_threshold_off=0.25)
    (tmp_path / "renders").mkdir()
    render = np.tile(np.arange(40, dtype=np.uint8), (30, 1))
    cv2.imwrite(str(tmp_path / "renders" / "0000.png"), np.concatenate([render, render + 10], axis=1))
    events = np.random.default_rng(0).integers(-2, 3, (2, 30, 40)).astype(np.float32)
    moments = {"t_us": np.array([1000, 2000]), "width_us": np.array([500, 500])}
    np.savez(tmp_path / "moments.npz", **moments, recorded=events, predicted=events)
    page = write_report(tmp_path, trajectories(tmp_path)).read_text()
    for words in (
        "my &lt;scene&gt;", "The field explains the recording.", "89% of the changes", "25.0 dB",
        "C_on / C_off is 0.80", "as given",
        "ns-train ebarf --data my_scene", "--pipeline.model.grid-levels 8", "a pixel covers 3 mm", "Errors over time",
        "28.1 dB as", "correlation 1.00",
    ):  # fmt: skip
        assert words in page, words
    assert "width=device-width" in page
    for needed in ('src="http', 'href="http', "<link", "<script", "url(http"):
        assert needed not in page


def test_without_reference_and_frames_held_out_events_speak(tmp_path: Path):
    metrics(tmp_path, psnr=None, heldout_event_loss=0.7)
    page = write_report(tmp_path, trajectories(tmp_path, reference=False)).read_text()
    assert "does not explain the recording" in page and "30% of the changes" in page
    assert "there is no reference" in page and "no frames to compare with" in page and "Errors over time" not in page
    assert "as given" not in page


def test_a_verdict_says_where_positions_are_undecided():
    support = {"verdict": "better", "positions_undecided": True}
    (reason,) = (one for one in verdict({"support": support}).reasons if "refined trajectory" in one)
    assert "positions moved by less than is certain" in reason
    (reason,) = (one for one in verdict({"support": {**support, "positions_undecided": False}}).reasons)
    assert "positions" not in reason


@pytest.mark.parametrize(
    "results, mark",
    [
        ({"heldout_event_loss": 0.1}, "good"),
        ({"heldout_event_loss": 0.4}, "doubtful"),
        ({"heldout_event_loss": 0.9}, "bad"),
        ({"heldout_event_loss": 1.3}, "bad"),
        ({"heldout_event_loss": 0.1, "support": {"verdict": "worse"}}, "doubtful"),
        ({"heldout_event_loss": 0.1, "inverted": 1.0, "psnr": 14.8}, "bad"),
        ({}, "doubtful"),
    ],
)
def test_a_verdict_follows_from_held_out_events(results: dict, mark: str):
    found = verdict(results)
    assert found.mark == mark
    assert all("nan" not in reason for reason in found.reasons)


def test_renders_that_do_not_follow_the_frames_are_doubtful():
    found = verdict({"heldout_event_loss": 0.28, "log_correlation": 0.41})
    assert found.mark == "doubtful" and any("correlation 0.41" in one for one in found.reasons)
    assert verdict({"heldout_event_loss": 0.28, "log_correlation": 0.9}).mark == "good"


def test_of_a_long_trajectory_only_some_poses_are_drawn():
    t_us = torch.arange(50_000) * 20
    quat_wxyz = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(len(t_us), 4)
    long = Trajectory(t_us, Poses(torch.stack([t_us * 1e-6] * 3, dim=-1).double(), quat_wxyz))
    for one in drawn(long, long, None):
        assert 1000 < len(one.seconds) == len(one.position) == len(one.rotation) <= 2000
        assert np.allclose(one.position[:, 0], one.seconds)
