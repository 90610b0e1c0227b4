"""The ebarf command as users type it: what it prints, what it leaves, and what it says when it cannot."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.scene import read_scene
from tests.conftest import DATA, run_command, run_ok


def test_help_lists_the_commands():
    assert all(
        name in run_ok("ebarf", "--help") for name in ("simulate", "process", "inspect", "trajectory", "evaluate")
    )


def test_inspect_for_people_and_for_programs(tiny_scene: Path):
    text = run_ok("ebarf", "inspect", tiny_scene)
    assert (
        "48 x 36" in text
        and "stated: on 0.25, off 0.25" in text
        and "no lamp flickers" in text
        and "11 keyframes" in text
    )
    summary = json.loads(run_ok("ebarf", "inspect", tiny_scene, "--json"))
    assert summary["width"] == 48 and summary["events"] > 5000 and summary["end_us"] <= 500_000
    assert summary["events_within_trajectory"] == summary["events"]


def test_inspect_tells_what_there_is_of_a_scene_whose_trajectory_is_to_come(tiny_scene: Path, tmp_path: Path):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    (scene / "trajectory.txt").unlink()
    text = " ".join(run_ok("ebarf", "inspect", scene).split())
    assert "events" in text and "no trajectory yet: training estimates one first" in text
    assert json.loads(run_ok("ebarf", "inspect", scene, "--json"))["events"] > 1000


def test_inspect_draws_the_events_of_a_scene_too(tiny_scene: Path, tmp_path: Path):
    assert str(tmp_path / "sheet.png") in run_ok("ebarf", "inspect", tiny_scene, "--picture", tmp_path / "sheet.png")
    assert cv2.imread(str(tmp_path / "sheet.png")).std() > 5  # pyright: ignore


def test_inspect_points_at_what_is_wrong(tiny_scene: Path, tmp_path: Path):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    with h5py.File(scene / "events.h5", "r+") as file:
        polarity = np.asarray(file["events/p"])
        file["events/p"][...] = np.ones_like(polarity)  # pyright: ignore[reportIndexIssue]
        for name in ("x", "y"):
            column = np.asarray(file[f"events/{name}"])
            column[::2] = 3
            file[f"events/{name}"][...] = column  # pyright: ignore[reportIndexIssue]
    lines = (scene / "trajectory.txt").read_text().splitlines()
    (scene / "trajectory.txt").write_text("\n".join(lines[:7]))
    text = run_ok("ebarf", "inspect", scene)
    assert "100% of the events are brighter" in text and "outside the trajectory's span" in text
    assert "left out of training: 1" in text


def test_inspect_says_what_looks_wrong_first_and_flags_of_the_plan_a_line_each(tiny_scene: Path, tmp_path: Path):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene [1]")
    content = json.loads((scene / "scene.json").read_text())
    (scene / "scene.json").write_text(json.dumps({**content, "bounds": None}))
    title, *lines = run_ok("ebarf", "inspect", scene).splitlines()
    assert title == str(scene) and lines[0].startswith("! no bounds in scene.json") and "--farthest" in lines[0]
    assert "nothing suspicious" not in lines
    plan = json.loads(run_ok("ebarf", "inspect", scene, "--json"))["plan"]
    for line in plan:
        if line["field"] == "threads":
            # What else the processor does changes.
            assert any(shown.startswith("--threads = ") for shown in lines)
            continue
        flag = "--" + line["field"].replace("_", "-")
        assert f"{flag} = {line['value']}: {line['reason']}" in lines


def test_inspect_is_told_what_a_recording_does_not_say(tmp_path: Path):
    path = tmp_path / "events.txt"
    path.write_text("".join(f"{k % 40} {k % 30} {k} {k % 2}\n" for k in range(0, 4000, 7)))
    words = ["inspect", path, "--event-columns", "x y t p", "--json"]
    for unit, factor in (("us", 1), ("ms", 1000)):
        said = json.loads(run_ok("ebarf", *words, "--event-time-unit", unit))
        assert (said["start_us"], said["end_us"], said["events"]) == (0, 3997 * factor, 572)
    refused = run_command("ebarf", "inspect", tmp_path, "--event-columns", "x y t p")
    assert refused.code == 2


def test_a_path_of_nearly_that_name_is_offered(tmp_path: Path):
    source = ecd_folder(tmp_path / "recording")
    for words in (
        ("inspect", tmp_path / "recoding"),
        ("process", "ecd", tmp_path / "recoding", "--output", tmp_path / "scene"),
        ("trajectory", "compare", tmp_path / "recoding" / "groundtruth.txt", source / "groundtruth.txt"),
    ):
        finished = run_command("ebarf", *words)
        assert finished.code == 2 and f"did you mean {source}" in finished.errors and finished.errors.count("\n") == 1


def test_trajectory_compare_prints_one_object(tiny_scene: Path):
    output = run_ok(
        "ebarf", "trajectory", "compare", tiny_scene / "trajectory.txt", tiny_scene / "groundtruth.txt", "--json"
    )
    errors = json.loads(output)
    assert errors["matched"] == 11 and errors["sim3"]["ate_m"] > 0 and errors["se3"]["rotation_deg"] > 0


def test_trajectory_compare_prints_a_table_for_people(tiny_scene: Path):
    output = run_ok("ebarf", "trajectory", "compare", tiny_scene / "trajectory.txt", tiny_scene / "groundtruth.txt")
    assert "11 poses" in output and "similarity (sim3)" in output and "°" in output
    assert "ape_full" not in output and "quaternions x y z w" in output


def test_process_says_that_a_scene_is_one(tiny_scene: Path, tmp_path: Path):
    finished = run_command("ebarf", "process", "auto", tiny_scene, "--output", tmp_path / "scene")
    assert finished.code == 2 and finished.errors.count("\n") == 1 and not (tmp_path / "scene").exists()
    assert "a scene folder already" in finished.errors and f"--camera {tiny_scene}/scene.json" in finished.errors
    remade = ("--camera", tiny_scene / "scene.json", "--output", tmp_path / "scene")
    assert "no frames" in run_command("ebarf", "process", "auto", tiny_scene, *remade).errors


def test_trajectory_perturb_is_repeatable(tiny_scene: Path, tmp_path: Path):
    for name in ("a.txt", "b.txt"):
        run_ok("ebarf", "trajectory", "perturb", tiny_scene / "groundtruth.txt", tmp_path / name, "--seed=4")
    assert (tmp_path / "a.txt").read_bytes() == (tmp_path / "b.txt").read_bytes()
    given, moved = read_tum(tiny_scene / "groundtruth.txt"), read_tum(tmp_path / "a.txt")
    assert 0.01 < float((given.poses.position - moved.poses.position).std()) < 0.06


def test_trajectory_perturb_does_not_write_over_what_it_reads(tiny_scene: Path, tmp_path: Path):
    path = Path(shutil.copy(tiny_scene / "groundtruth.txt", tmp_path / "given.txt"))
    finished = run_command("ebarf", "trajectory", "perturb", path, path)
    assert finished.code == 2 and "expected another file to write" in finished.errors
    assert path.read_bytes() == (tiny_scene / "groundtruth.txt").read_bytes()


SLOW_COMMAND = """
import signal, sys, time
from pathlib import Path
from ebarf_ns.cli import entry, main
from ebarf_ns.files import whole_file, whole_folder

def write_slowly():
    with whole_folder(Path(sys.argv[2])) as folder, whole_file(Path(sys.argv[2] + ".txt")):
        (folder / "half").touch()
        print("begun", flush=True)
        time.sleep(60)

# A shell may have left it ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
main.entrypoint = write_slowly
entry.entrypoint()
"""


@pytest.mark.skipif(os.name == "nt", reason="no such signals there")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_command_that_is_told_to_end_leaves_nothing_half_written(tmp_path: Path, number: int, code: int):
    command = [sys.executable, "-c", SLOW_COMMAND, "simulate", tmp_path / "scene"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        assert running.stdout and running.stdout.readline() == "begun\n"
        running.send_signal(number)
        _, said = running.communicate(timeout=30)
    assert running.returncode == code and "Traceback" not in said and not list(tmp_path.iterdir())


INTERRUPTED_IMPORT = """
import sys
from importlib.metadata import EntryPoint
from ebarf_ns.cli import entry

def interrupt(_):
    raise KeyboardInterrupt

EntryPoint.load = interrupt
entry.entrypoint()
"""


def test_a_training_interrupted_during_imports_ends_without_a_traceback(tiny_scene: Path):
    command = [sys.executable, "-c", INTERRUPTED_IMPORT, "train", tiny_scene]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    assert finished.returncode == 130 and "Traceback" not in finished.stderr


def test_evaluate_makes_the_report_from_the_folder(trained_run: Path):
    shutil.rmtree(trained_run / "report")
    numbers = json.loads(run_ok("ebarf", "evaluate", trained_run, "--json"))
    assert numbers["method"] == "ebarf" and numbers["step"] == 80
    said = run_ok("ebarf", "evaluate", trained_run)
    assert said.startswith("The field ") and "held-out events" in said and str(numbers["report"]) in said
    page = Path(numbers["report"]).read_text()
    assert "data:image/png;base64," in page and "<svg" in page and "http" not in page.split("</style>")[0]
    assert "pipeline.model.grid_levels" in page and "no contraction" in page


def test_simulate_with_a_knob(tmp_path: Path):
    short = ["--width=16", "--height=12", "--duration-s=0.2", "--focal-px=14"]
    run_ok("ebarf", "simulate", tmp_path / "scene", *short)
    few = json.loads(run_ok("ebarf", "inspect", tmp_path / "scene", "--json"))["events"]
    run_ok("ebarf", "simulate", tmp_path / "fine", *short, "--threshold-on=0.1", "--threshold-off=0.1")
    many = json.loads(run_ok("ebarf", "inspect", tmp_path / "fine", "--json"))["events"]
    assert many > 1.8 * few > 0


def test_process_ecd_makes_a_scene_of_a_real_recording(slider_depth: Path, tmp_path: Path):
    before = {path: path.stat().st_mtime_ns for path in slider_depth.rglob("*")}
    run_ok("ebarf", "process", "ecd", slider_depth, "--output", tmp_path / "slider")
    assert {path: path.stat().st_mtime_ns for path in slider_depth.rglob("*")} == before
    summary = json.loads(run_ok("ebarf", "inspect", tmp_path / "slider", "--json"))
    assert summary["events"] == 50_000 and summary["start_us"] == 3811 and summary["frames"] == 4
    scene = read_scene(tmp_path / "slider")
    assert scene.camera.model == "radtan" and scene.camera.distortion[0] == pytest.approx(-0.1386, abs=1e-4)
    assert scene.contrast_threshold is None


def ecd_folder(folder: Path, **files: str) -> Path:
    content = {
        "events.txt": "0.0 1 1 0\n0.1 1 1 1\n0.2 1 1 1\n",
        "calib.txt": "200 200 120 90 0 0 0 0 0",
        "groundtruth.txt": "0.0 0 0 0 0 0 0 1\n0.2 1 0 0 0 0 0 1\n",
        **{name.replace("_", "."): text for name, text in files.items()},
    }
    folder.mkdir()
    for name, text in content.items():
        (folder / name).write_text(text)
    return folder


def test_process_ecd_without_frames(tmp_path: Path):
    run_ok("ebarf", "process", "ecd", ecd_folder(tmp_path / "raw"), "--output", tmp_path / "scene")
    assert read_scene(tmp_path / "scene").frames == ()


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"events_txt": "0.1 1 1\n"}, "events.txt:1:"),
        ({"events_txt": ""}, "holds no events"),
        ({"calib_txt": "1 2 3"}, "calib.txt: holds '1 2 3', expected 9 numbers"),
        ({"calib_txt": "a b c d e f g h i"}, "calib.txt: holds 'a b c d e f g h i', expected 9 numbers"),
        ({"groundtruth_txt": "50 0 0 0 0 0 0 1\n51 0 0 0 0 0 0 1\n"}, "expected at least 2 poses around the events"),
        ({"groundtruth_txt": "0 0 0 0 0 0 0 1\n200000 0 0 0 0 0 0 2\n"}, "has length 2, expected 1"),
        ({"images_txt": "0.1 gone.png\n"}, "images.txt:1:"),
    ],
)
def test_bad_source_is_one_line_exit_2_and_no_output(tmp_path: Path, files: dict[str, str], words: str):
    finished = run_command("ebarf", "process", "ecd", ecd_folder(tmp_path / "raw", **files), "--output", tmp_path / "s")
    assert finished.code == 2 and finished.errors.startswith("error: ") and words in finished.errors
    assert finished.errors.count("\n") == 1 and [path.name for path in tmp_path.iterdir()] == ["raw"]


def test_a_folder_with_something_in_it_is_never_replaced(tmp_path: Path):
    (tmp_path / "thesis.tex").write_text("years of work")
    finished = run_command("ebarf", "simulate", tmp_path)
    assert finished.code == 2 and "expected a new folder" in finished.errors and (tmp_path / "thesis.tex").exists()


def test_the_current_folder_is_not_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    finished = run_command("ebarf", "simulate", ".")
    assert finished.code == 2 and "the current folder" in finished.errors and tmp_path.is_dir()


def test_a_link_to_an_empty_folder_is_filled(tmp_path: Path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "scene").symlink_to(tmp_path / "disk")
    run_ok("ebarf", "process", "ecd", ecd_folder(tmp_path / "raw"), "--output", tmp_path / "scene")
    assert (tmp_path / "scene").is_symlink() and read_scene(tmp_path / "disk").events.is_file()


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path):
    (tmp_path / "file").write_text("where a folder should be")
    source = ecd_folder(tmp_path / "raw")
    finished = run_command("ebarf", "process", "ecd", source, "--output", tmp_path / "file" / "scene")
    assert finished.code == 2 and finished.errors.count("\n") == 1 and str(tmp_path / "file") in finished.errors


def test_flags_from_a_file_in_either_spelling(tmp_path: Path):
    (tmp_path / "flags.yaml").write_text("format: ecd\ncontrast-threshold: [0.2, 0.3]\n")
    for number, words in enumerate(([f"--config={tmp_path / 'flags.yaml'}"], ["--config", tmp_path / "flags.yaml"])):
        source, scene = ecd_folder(tmp_path / f"raw{number}"), tmp_path / f"scene{number}"
        run_ok("ebarf", "process", *words, "--source", source, "--output", scene)
        threshold = read_scene(scene).contrast_threshold
        assert threshold and (threshold.on, threshold.off) == (0.2, 0.3)
    (tmp_path / "flags.yaml").write_bytes(b"format: \xff\n")
    finished = run_command("ebarf", "process", "--config", tmp_path / "flags.yaml", "--output", tmp_path / "other")
    assert finished.code == 2 and "expected a YAML file" in finished.errors


def test_a_picture_of_another_kind_is_refused_before_anything_is_read(tmp_path: Path):
    source = ecd_folder(tmp_path / "raw") / "events.txt"
    finished = run_command("ebarf", "inspect", source, "--picture", tmp_path / "sheet")
    assert finished.code == 2 and "expected the name of a .png file" in finished.errors


def test_errors_that_leave_no_trajectory_are_said_before_anything_is_simulated(tmp_path: Path):
    finished = run_command("ebarf", "simulate", tmp_path / "scene", "--duration-s", 1e4, "--dropped", 1, timeout_s=20)
    assert finished.code == 2 and "dropped is 1" in finished.errors


def test_evaluate_of_no_run_is_one_line(tmp_path: Path):
    finished = run_command("ebarf", "evaluate", tmp_path)
    assert finished.code == 2 and "expected the folder of a training run" in finished.errors
    (tmp_path / "scene" / "ebarf" / "run").mkdir(parents=True)
    (tmp_path / "scene" / "ebarf" / "run" / "metrics.jsonl").touch()
    finished = run_command("ebarf", "evaluate", tmp_path)
    assert f"such as {tmp_path / 'scene' / 'ebarf' / 'run'}" in finished.errors


def test_swapped_columns_of_a_real_file_are_caught(tmp_path: Path, tiny_scene: Path):
    swapped = DATA / "readers" / "swapped_xy.hdf5"
    if not swapped.is_file():
        pytest.skip(f"no recordings at {DATA}; set EBARF_TEST_DATA to their folder")
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    shutil.copy(swapped, scene / "events.h5")
    finished = run_command("ebarf", "inspect", scene)
    assert finished.code == 2 and "events.h5" in finished.errors


def test_inspect_of_a_dataset_says_how_to_make_a_scene(tmp_path: Path):
    (tmp_path / "events.txt").write_text("0.1 1 1 1\n")
    finished = run_command("ebarf", "inspect", tmp_path)
    assert finished.code == 2 and f"ebarf process auto {tmp_path} --output SCENE" in finished.errors
