from pathlib import Path

import pytest

from ebarf_ns.benchmarks.comparison import jobs
from ebarf_ns.benchmarks.manifest import TRUE, Stated, read_manifest
from ebarf_ns.errors import BenchmarkError
from ebarf_ns.simulation.simulate import Simulation
from tests.conftest import REPOSITORY

WHOLE = """
methods:
  ebarf: ebarf
  floor: {command: ebarf --pipeline.model.camera-optimizer.mode off, role: floor}
scenes:
  room: {scene: orbit, frames: 2, sensor: {leak_hz: 0.1}}
  slide: some/folder
  dim: {folder: other, refractory_us: 300}
trajectories:
  white: {position_noise: 0.03}
  given: as given
seeds: [0, 4]
seconds: [5, 10]
evaluations: 3
others:
  - {method: theirs, scene: room, trajectory: white, seed: 0, seconds: 99, refined: theirs.txt}
"""


def read(tmp_path: Path, text: str):
    (tmp_path / "theirs.txt").touch()
    text = text.replace("theirs.txt", str(tmp_path / "theirs.txt"))
    path = tmp_path / "some.yaml"
    path.write_text(text)
    return read_manifest(path)


def test_a_manifest_defines_the_comparison(tmp_path: Path):
    manifest = read(tmp_path, WHOLE)
    assert manifest.name == "some" and manifest.seeds == (0, 4) and manifest.seconds == (5, 10)
    assert manifest.methods["floor"].words[1:] == ["--pipeline.model.camera-optimizer.mode", "off"]
    room = manifest.scenes["room"]
    assert isinstance(room, Simulation) and room.scene == "orbit" and room.sensor.leak_hz == 0.1
    assert (
        manifest.scenes["slide"] == Stated(Path("some/folder"))
        and manifest.others[0].refined == tmp_path / "theirs.txt"
    )
    dim = manifest.scenes["dim"]
    assert isinstance(dim, Stated) and (dim.folder, dim.threshold_on, dim.refractory_us) == (Path("other"), None, 300)
    white = manifest.trajectories["white"]
    assert (
        white and white.position_noise == 0.03 and white.rotation_noise_rad == 0 and not manifest.trajectories["given"]
    )


def test_floors_are_trained_once_whatever_the_trajectory(tmp_path: Path):
    found = jobs(read(tmp_path, WHOLE))
    assert len(found) == len(set(found)) == 2 * 3 * 2 * (2 + 1)
    assert {job.trajectory for job in found if job.method == "floor"} == {TRUE}
    names = {job.name("this") for job in found}
    assert len(names) == len(found) and all("/" not in name for name in names)
    # A different definition has a different name, so that results are not confused.
    assert found[0].name("this") != found[0].name("that")


@pytest.mark.parametrize(
    "path", sorted((REPOSITORY / "configs" / "benchmarks").glob("*.yaml")), ids=lambda path: path.stem
)
def test_shipped_manifests_are_whole(path: Path):
    manifest = read_manifest(path)
    assert jobs(manifest) and len(manifest.seeds) >= 3


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "the file is None, expected names with values"),
        ("methods: [", "not valid YAML"),
        ("scenes: {}", "methods is None"),
        (WHOLE + "colour: red\n", "unknown key colour, expected among: methods"),
        (WHOLE.replace("role: floor", "role: roof"), "methods.floor.role is 'roof', expected one of method, floor"),
        (WHOLE.replace("ebarf: ebarf", "ebarf: {flags: 3}"), "unknown key methods.ebarf.flags"),
        (WHOLE.replace("ebarf: ebarf", "ebarf: {role: floor}"), "methods.ebarf: .*command"),
        (WHOLE.replace("leak_hz", "leek_hz"), "unknown key scenes.room.sensor.leek_hz"),
        (WHOLE.replace("frames: 2", "frame: 2"), "unknown key scenes.room.frame"),
        (WHOLE.replace("{position_noise: 0.03}", "0.03"), "trajectories.white is 0.03"),
        (WHOLE.replace("seeds: [0, 4]", "seeds: 3"), "seeds is 3, expected one number or more"),
        (WHOLE.replace("[5, 10]", "[5, fast]"), "seconds is .5, 'fast'."),
        (WHOLE.replace("evaluations: 3", "evaluations: many"), "evaluations is .'many'."),
        (WHOLE.replace(", refined: theirs.txt", ""), "others.0.: .*refined"),
        (WHOLE.replace("theirs.txt", "nothing.txt"), "names nothing.txt, but there is no such file"),
        (WHOLE.replace("theirs, scene: room", "theirs, scene: hall"), "of scene 'hall'"),
        (WHOLE.replace("0.03}", "1e-2}"), "trajectories.white.position_noise is '1e-2', expected float"),
        (WHOLE.replace("refractory_us: 300", "threshold_on: 0.3"), "both threshold_on and threshold_off"),
        (WHOLE.replace("scene: orbit", "scene: nope"), "scenes.room.scene is 'nope'"),
        (WHOLE.replace("frames: 2", "frames: 2, errors: {}"), "scenes.room.errors: expected under trajectories"),
        (WHOLE.replace("mode off", "mode 'off"), "methods.floor.command"),
        (WHOLE.replace("[0, 4]", "[-1]"), "seeds is .-1., expected one number or more, none below 0"),
        (WHOLE.replace("  white:", "  'true':"), "a name in trajectories is 'true'"),
        (WHOLE.replace("  slide:", "  ../slide:"), "a name in scenes is '../slide'"),
    ],
)
def test_errors_are_named(tmp_path: Path, text: str, complaint: str):
    with pytest.raises(BenchmarkError, match=complaint):
        read(tmp_path, text)


def test_a_missing_manifest_is_named(tmp_path: Path):
    with pytest.raises(BenchmarkError, match="nothing.yaml: No such file"):
        read_manifest(tmp_path / "nothing.yaml")
