"""Lines for people: names, units, what was and what is."""

from pathlib import Path

import pytest

from ebarf_ns.nerf import terminal
from ebarf_ns.nerf.terminal import LiveLine, errors_line, evaluation_line, plan_line, scene_line, summary
from ebarf_ns.plan import plan_for
from ebarf_ns.scene import read_scene

GIVEN = {"ate_m": 0.052, "ate_m_orientation": 0.05, "rotation_deg": 2.79}
RESULTS = {"heldout_event_loss": 0.4213, "psnr": 18.13, "ate_m": 0.021, "ate_m_orientation": 0.02, "rotation_deg": 0.81}


def test_errors_have_units_and_what_they_were():
    assert errors_line(RESULTS, GIVEN) == (
        "unexplained events 42.1%  PSNR 18.1 dB  position 5.2 → 2.1 cm  rotation 2.79 → 0.81°"
    )


def test_a_reference_that_is_also_given_is_named():
    given = {**GIVEN, "rotation_deg": 2e-6, "ate_m": 3e-10, "ate_m_orientation": 2e-10}
    assert errors_line(RESULTS, given).endswith("(the given trajectory is the reference)")
    assert "reference" not in errors_line(RESULTS, {**given, "ate_m": 0.05})


def test_what_is_not_known_is_left_out():
    assert errors_line({"heldout_event_loss": 0.1, "psnr": None, "ate_m": None, "rotation_deg": None}, {}) == (
        "unexplained events 10.0%"
    )
    straight = {**RESULTS, "ate_m": None}
    assert "position 5 → 2 cm" in errors_line(straight, {**GIVEN, "ate_m": None})


def test_scene_and_plan_are_a_line_each(tiny_scene: Path):
    from ebarf_ns.geometry.trajectory_file import read_tum

    scene = read_scene(tiny_scene)
    said = scene_line(scene, 12345, 7)
    assert "12,345 events" in said and "7 keyframes" in said and "\n" not in said
    lines = plan_for(scene, read_tum(scene.trajectory), 12345, "cpu")
    assert "levels to" in plan_line(lines) and "\n" not in plan_line(lines)


def test_a_summary_names_every_place(tmp_path: Path):
    said = summary(tmp_path, 20.0, 51.0, RESULTS, GIVEN)
    for word in ("5.2 → 2.1 cm", "20 s of training in 51 s", "report.html", "trajectory_refined.txt", "ns-viewer"):
        assert word in said
    assert evaluation_line(5.2, 640, RESULTS, GIVEN).startswith("     5 s  step 640  unexplained events")


def test_the_live_line_stays_one_line(monkeypatch: pytest.MonkeyPatch):
    from io import StringIO

    from rich.console import Console

    console = Console(file=StringIO(), force_terminal=True, width=100)
    monkeypatch.setattr(terminal, "CONSOLE", console)
    live = LiveLine()
    live.__enter__()
    live.update(0.25, 640, 15.0, 0.024, 0.123)
    live._progress.refresh()
    shown = console.file.getvalue()  # pyright: ignore[reportAttributeAccessIssue]
    live.stop()
    assert "25 %  step 640  24 ms a step  0:45 left  loss 0.123" in shown
    assert max(len(line) for line in shown.replace("\r", "\n").splitlines()) < 200


def test_nobody_looks_and_nothing_is_written(monkeypatch: pytest.MonkeyPatch):
    from io import StringIO

    from rich.console import Console

    console = Console(file=StringIO(), force_terminal=False, width=100)
    monkeypatch.setattr(terminal, "CONSOLE", console)
    live = LiveLine()
    live.__enter__()
    live.update(0.25, 640, 15.0, 0.024, 0.123)
    live.stop()
    assert console.file.getvalue().strip() == ""  # pyright: ignore[reportAttributeAccessIssue]
