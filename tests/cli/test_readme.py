"""Every command of the README and of the pages that it points to is run, with less time to train."""

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ebarf_ns.events.recording import read_recording
from ebarf_ns.scene import read_scene
from tests.conftest import REPOSITORY, TINY_TRAINING, run_ok
from tests.formats import writers

README = (REPOSITORY / "README.md").read_text(encoding="utf-8")
DOCS = {page.name: page.read_text(encoding="utf-8") for page in (REPOSITORY / "docs").glob("*.md")}


def blocks(text: str) -> list[list[str]]:
    return [block.splitlines() for block in re.findall(r"```sh\n(.*?)```", text, re.S)]


BLOCKS = blocks(README)


def test_make_demo_goes_from_nothing_to_a_report(tmp_path: Path):
    environment = Path(sys.executable).parent.parent
    if not (environment / ".installed").exists():
        pytest.skip(f"{environment} was not made by make setup")
    finished = subprocess.run(
        ["make", "-C", REPOSITORY, "demo", f"VENV={environment}", f"DEMO={tmp_path}", "DEMO_SECONDS=5"],
        capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    assert finished.returncode == 0, finished.stdout[-2000:] + finished.stderr[-2000:]
    run = tmp_path / "runs" / "scene" / "ebarf" / "run"
    for name in ("report/report.html", "report/trajectory.svg", "renders/0000.png", "trajectory_refined.txt"):
        assert (run / name).stat().st_size > 500
        assert str(run / name.split("/", maxsplit=1)[0]) in finished.stdout
    assert json.loads((run / "metrics.jsonl").read_text().splitlines()[-1])["psnr"] > 10


def test_the_first_block_is_the_two_commands_of_the_makefile():
    targets = re.findall(r"^make (\w+)", "\n".join(BLOCKS[0]), re.M)
    assert targets == ["demo", "test"]
    makefile = (REPOSITORY / "Makefile").read_text()
    assert all(f"\n{target}:" in makefile for target in targets)


@pytest.mark.slow
def test_the_real_recording_block_runs(slider_depth: Path, tmp_path: Path):
    (block,) = [block for block in blocks(DOCS["benchmarks.md"]) if any("slider_depth" in line for line in block)]
    shutil.copytree(slider_depth, tmp_path / "slider_depth")
    for line in block:
        words = shlex.split(line.replace("--max-train-seconds 60", "--max-train-seconds 5"))
        run_ok(*words, cwd=tmp_path)
    (metrics,) = (tmp_path / "outputs").rglob("metrics.jsonl")
    last = json.loads(metrics.read_text().splitlines()[-1])
    assert last["heldout_event_loss"] < 1 and last["ate_m_orientation"] < 0.05


def test_the_block_of_an_own_recording_runs(tiny_scene: Path, tmp_path: Path):
    (block,) = [block for block in BLOCKS if any("recording.raw" in line for line in block)]
    scene = read_scene(tiny_scene)
    events = read_recording(scene.events, scene.camera.width, scene.camera.height)
    columns = (events.t_us, events.x, events.y, events.polarity > 0)
    rows = list(zip(*(column.astype(int).tolist() for column in columns), strict=True))
    writers.raw(tmp_path / "recording.raw", "3.0", writers.evt3(rows), size=(scene.camera.width, scene.camera.height))
    camera = scene.camera
    (tmp_path / "calibration.yaml").write_text(
        f"cam0:\n  intrinsics: [{camera.fx}, {camera.fy}, {camera.cx}, {camera.cy}]\n"
        f"  distortion_coeffs: []\n  resolution: [{camera.width}, {camera.height}]\n"
    )
    shutil.copy(scene.trajectory, tmp_path / "odometry.txt")
    for line in block:
        words = shlex.split(line)
        trains = words[0] == "ns-train" or words[:2] == ["ebarf", "train"]
        quick = [*TINY_TRAINING, "--max-num-iterations=20", "--vis=tensorboard"] if trains else []
        run_ok(*words, *quick, cwd=tmp_path)
    made = read_recording(tmp_path / "my_scene" / "events.h5", camera.width, camera.height)
    assert (made.t_us == events.t_us).all() and (made.polarity == events.polarity).all()


def test_a_run_is_looked_at_as_the_readme_says(trained_run: Path, tmp_path: Path):
    (block,) = [block for block in BLOCKS if any("ns-viewer" in line for line in block)]
    run = tmp_path / "run"
    shutil.copytree(trained_run, run)
    for line in block:
        words = shlex.split(line.replace("RUN", str(run)))
        # After 80 steps surfaces are still a fog.
        coarse = ["--blur=1"] if words[:2] == ["ebarf", "mesh"] else []
        if words[0] != "ns-viewer":
            run_ok(*words, *coarse, cwd=tmp_path)
    made = sorted(path.relative_to(run / "exports").as_posix() for path in (run / "exports").rglob("*"))
    assert any(name.endswith(".mp4") for name in made) and any(name.endswith(".ply") for name in made)
    assert any(name.endswith("images.txt") for name in made)


def test_the_readme_is_short():
    assert len(README.splitlines()) <= 150


def test_links_lead_somewhere():
    for folder, text in ((REPOSITORY, README), *((REPOSITORY / "docs", page) for page in DOCS.values())):
        for target in re.findall(r"\]\(([^)#\s]+)", text):
            assert target.startswith("http") or (folder / target).exists(), target


def test_the_scene_of_the_page_of_formats_is_a_scene(tmp_path: Path):
    (content,) = re.findall(r"```json\n(.*?)```", DOCS["formats.md"], re.S)
    (tmp_path / "scene.json").write_text(content)
    for name in ("events.h5", "trajectory.txt"):
        (tmp_path / name).touch()
    assert read_scene(tmp_path).camera.model == "radtan"


def test_the_table_names_commands_that_exist():
    commands = re.findall(r"^\| `(ebarf [a-z ]+|ns-[a-z]+)", README, re.M)
    assert len(commands) >= 7
    for command in commands:
        words = [word for word in command.split() if word.islower()]
        assert "usage" in run_ok(*words, "--help").lower()


def test_its_pictures_are_there():
    for picture in re.findall(r"!\[.*?\]\((.*?)\)", README, re.S):
        assert (REPOSITORY / picture).stat().st_size > 10_000
