"""A whole comparison in miniature, through the user's command."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from ebarf_ns.geometry.trajectory import Poses, Trajectory
from ebarf_ns.geometry.trajectory_file import read_tum, write_tum
from ebarf_ns.scene import ContrastThreshold, Scene, read_scene
from tests.conftest import run_command, run_ok

MANIFEST = """
methods:
  ebarf: ebarf --pipeline.model.grid-finest 32 --pipeline.model.density-cells 32
  broken: ebarf --pipeline.model.samples 0
  floor:
    command: enerf --pipeline.model.samples 16 --pipeline.model.grid-levels 4 --pipeline.model.grid-table-size-log2 10
    role: floor
scenes:
  tiny: {scene: orbit, width: 24, height: 18, focal_px: 20.0, duration_s: 0.3, frames: 2}
trajectories:
  drift: {position_drift: 0.05, rotation_drift_rad: 0.05, scale: 2.0}
seeds: [0]
seconds: [1.5]
evaluations: 2
"""


@pytest.fixture(scope="module")
def comparison(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("comparison")
    (folder / "mini.yaml").write_text(MANIFEST)
    run_ok("ebarf", "bench", folder / "mini.yaml", "--output", folder / "out", timeout_s=600)
    return folder


def test_every_job_has_a_record_with_its_cost(comparison: Path):
    result = json.loads((comparison / "out" / "records.json").read_text())
    records = {(record["method"], record["trajectory"]): record for record in result["records"]}
    assert set(records) == {("ebarf", "drift"), ("broken", "drift"), ("floor", "true")}
    for (method, _), record in records.items():
        if method == "broken":
            assert "samples" in record["error"] and not record["evaluations"]
            continue
        assert len(record["evaluations"]) >= 1
        last = record["evaluations"][-1]
        assert last["train_seconds"] >= 1.5 and last["event_pairs"] > 0 and last["heldout_event_loss"] <= 1.001
    assert records["floor", "true"]["initial"]["rotation_deg"] < 1e-3
    assert records["ebarf", "drift"]["initial"]["rotation_deg"] > 0.1


def made(comparison: Path, trajectory: str) -> Scene:
    (folder,) = (comparison / "out" / "scenes").glob(f"tiny-0-{trajectory}-*")
    return read_scene(folder)


def test_scenes_of_one_seed_share_their_events(comparison: Path):
    true, drift = made(comparison, "true"), made(comparison, "drift")
    assert true.events == drift.events and true.events.is_file()
    assert true.trajectory.read_text() != drift.trajectory.read_text()
    # A trajectory in another unit comes with bounds in that unit.
    assert np.allclose(np.array(drift.bounds), 2 * np.array(true.bounds))


def test_diagrams_and_tables_show_every_method(comparison: Path):
    out = comparison / "out"
    curves, profile = ((out / name).read_text() for name in ("work_precision.svg", "profile.svg"))
    assert all(f"<!-- {name} -->" in curves for name in ("ebarf", "floor", "as given"))
    # Floors are not part of the performance profile.
    assert "<!-- ebarf -->" in profile and "<!-- floor -->" not in profile
    tables = (out / "tables.md").read_text()
    assert "| tiny | drift | ebarf |" in tables and "not reached" in tables and "1 training failed" in tables


def test_a_stopped_comparison_resumes(comparison: Path):
    out = comparison / "out"
    before = {path: path.stat().st_mtime_ns for path in (out / "results").glob("*.json")}
    removed = next(path for path in before if "-ebarf-" in path.name)
    removed.unlink()
    result = json.loads(run_ok("ebarf", "bench", comparison / "mini.yaml", "--output", out, "--json", timeout_s=600))
    assert len(result["records"]) == 3
    after = {path: path.stat().st_mtime_ns for path in (out / "results").glob("*.json")}
    assert {path for path in before if after[path] != before[path]} == {removed}


def test_a_changed_scene_is_measured_again(comparison: Path, tmp_path: Path):
    folder = shutil.copytree(made(comparison, "drift").events.parent, tmp_path / "scene")
    (tmp_path / "given.yaml").write_text(
        f"methods: {{broken: ebarf --pipeline.model.samples 0}}\nscenes: {{given: {folder}}}\n"
        "trajectories: {given: as given}\nseeds: [0]\nseconds: [1]\n"
    )
    for number, line in enumerate(["", "# one more\n"]):
        with read_scene(folder).trajectory.open("a") as file:
            file.write(line)
        run_command("ebarf", "bench", tmp_path / "given.yaml", "--output", tmp_path / "out")
        assert len(list((tmp_path / "out" / "results").iterdir())) == number + 1


def test_sensor_facts_can_be_stated_and_floors_need_a_reference(comparison: Path, tmp_path: Path):
    folder = shutil.copytree(made(comparison, "drift").events.parent, tmp_path / "scene")
    content = json.loads((folder / "scene.json").read_text())
    (folder / "scene.json").write_text(json.dumps({**content, "groundtruth": None, "contrast_threshold": None}))
    facts = "threshold_on: 0.3, threshold_off: 0.2, refractory_us: 400"
    (tmp_path / "given.yaml").write_text(
        "methods:\n  broken: ebarf --pipeline.model.samples 0\n  floor: {command: enerf, role: floor}\n"
        f"scenes: {{given: {folder}, stated: {{folder: {folder}, {facts}}}}}\n"
        "trajectories: {given: as given}\nseeds: [0]\nseconds: [1]\n"
    )
    result = json.loads(
        run_command("ebarf", "bench", tmp_path / "given.yaml", "--output", tmp_path / "out", "--json").output
    )
    assert [(one["method"], one["scene"]) for one in result["records"]] == [("broken", "given"), ("broken", "stated")]
    (stated,) = (tmp_path / "out" / "scenes").iterdir()
    scene, given = read_scene(stated), read_scene(folder)
    assert scene.contrast_threshold == ContrastThreshold(0.3, 0.2) and scene.refractory_us == 400
    assert given.contrast_threshold is None and scene.trajectory.read_bytes() == given.trajectory.read_bytes()


def test_bounds_in_another_frame_than_the_groundtruth_are_an_error(comparison: Path, tmp_path: Path):
    folder = shutil.copytree(made(comparison, "drift").events.parent, tmp_path / "scene")
    path = read_scene(folder).groundtruth
    assert path
    true = read_tum(path)
    write_tum(path, Trajectory(true.t_us, Poses(true.poses.position + 10, true.poses.quat_wxyz)))
    (tmp_path / "given.yaml").write_text(
        f"methods: {{ebarf: ebarf}}\nscenes: {{given: {folder}}}\n"
        "trajectories: {drift: {position_drift: 0.05}}\nseeds: [0]\nseconds: [1]\n"
    )
    finished = run_command("ebarf", "bench", tmp_path / "given.yaml", "--output", tmp_path / "out")
    assert finished.code == 2 and "expected both in one world" in finished.errors


def test_another_program_is_compared_by_its_files(comparison: Path, tmp_path: Path):
    scene = made(comparison, "drift")
    assert scene.groundtruth
    shutil.copy(scene.groundtruth, tmp_path / "theirs.txt")
    (tmp_path / "pictures").mkdir()
    for frame in scene.frames:
        picture = cv2.imread(str(frame.path), -1)
        assert picture is not None
        np.save(tmp_path / "pictures" / f"{frame.path.stem}.npy", (picture / 65535.0) ** 0.5 + 0.001)
    theirs = f"theirs, scene: tiny, trajectory: drift, seed: 0, seconds: 77, refined: {tmp_path / 'theirs.txt'}"
    text = MANIFEST + f"others:\n  - {{method: {theirs}, renders: {tmp_path / 'pictures'}}}\n"
    (comparison / "joined.yaml").write_text(text)
    result = json.loads(run_ok("ebarf", "bench", comparison / "joined.yaml", "--output", comparison / "out", "--json"))
    (record,) = (record for record in result["records"] if record["method"] == "theirs")
    (evaluation,) = record["evaluations"]
    assert evaluation["ate_m"] < 1e-6 and evaluation["psnr"] > 50 and evaluation["train_seconds"] == 77
    (tmp_path / "pictures" / f"{scene.frames[0].path.stem}.npy").unlink()
    finished = run_command("ebarf", "bench", comparison / "joined.yaml", "--output", comparison / "out")
    assert finished.code == 2 and "expected a picture for every frame" in finished.errors


def test_an_invalid_manifest_is_refused_in_one_line(tmp_path: Path):
    finished = run_command("ebarf", "bench", "enigne")
    assert finished.code == 2 and "enigne" in finished.errors and "Traceback" not in finished.errors
