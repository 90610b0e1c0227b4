"""Methods x scenes x trajectories x seeds x seconds: trained one after another, stopped and gone on with at will."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any

import torch

from ebarf_ns.benchmarks.engine import machine
from ebarf_ns.benchmarks.manifest import Manifest, Other
from ebarf_ns.benchmarks.training import train
from ebarf_ns.errors import BenchmarkError
from ebarf_ns.evaluation.outside import evaluate_files
from ebarf_ns.files import whole_file, whole_folder
from ebarf_ns.geometry.trajectory import Trajectory, interpolate, within_span
from ebarf_ns.geometry.trajectory_file import read_tum, write_tum
from ebarf_ns.scene import Scene, read_scene
from ebarf_ns.simulation.simulate import simulate
from ebarf_ns.simulation.trajectory_errors import TrajectoryErrors, perturb

TRUE = "true"
_TRUE_ERRORS = TrajectoryErrors(position_noise=0.0, rotation_noise_rad=0.0)


@dataclass(frozen=True)
class Job:
    """One training."""

    method: str
    scene: str
    trajectory: str
    seed: int
    seconds: float

    @property
    def name(self) -> str:
        """A folder's name."""
        words = f"{self.scene}-{self.trajectory}-{self.seed}-{self.seconds:g}s-{self.method}"
        return "".join(letter if letter.isalnum() or letter in "-._" else "_" for letter in words)


def jobs(manifest: Manifest) -> list[Job]:
    """All trainings, seed by seed, so that a comparison that is stopped has something of everything."""
    found = dict.fromkeys(
        Job(name, scene, TRUE if method.role == "floor" else trajectory, seed, float(seconds))
        for seed in manifest.seeds
        for scene in manifest.scenes
        for trajectory in manifest.trajectories
        for seconds in manifest.seconds
        for name, method in manifest.methods.items()
    )
    return list(found)


def run_comparison(
    manifest: Manifest, folder: Path, progress: Callable[[int, int, str], None] = lambda done, of, what: None
) -> dict[str, Any]:
    """Train whatever has no result in ``folder`` yet; returns all results, which are in ``records.json`` as well.

    A training that fails is a result too: it has an ``error`` and no evaluations.
    """
    todo = jobs(manifest)
    records = []
    for done, job in enumerate(todo):
        progress(done, len(todo), f"{job.method}, {job.scene}, {job.trajectory}, seed {job.seed}, {job.seconds:g} s")
        records.append(_result(manifest, job, folder))
    progress(len(todo), len(todo), "")
    records += [_joined(manifest, other, folder) for other in manifest.others]
    result = {
        "name": manifest.name,
        "date": date.today().isoformat(),
        "machine": machine(),
        "versions": {"torch": torch.__version__},
        "roles": {name: method.role for name, method in manifest.methods.items()},
        "records": records,
    }
    with whole_file(folder / "records.json") as temporary:
        temporary.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return result


def _result(manifest: Manifest, job: Job, folder: Path) -> dict[str, Any]:
    path = folder / "results" / f"{job.name}.json"
    if path.is_file():
        return json.loads(path.read_text(encoding="utf-8"))
    scene = _scene(manifest, job, folder)
    shutil.rmtree(folder / "runs" / job.name, ignore_errors=True)
    record = {**vars(job), "initial": _initial_errors(read_scene(scene)), "evaluations": []}
    method = manifest.methods[job.method]
    run = folder / "runs" / job.name / method.words[0] / "run"
    try:
        record["evaluations"] = train(method.words, scene, run, job.seed, job.seconds, manifest.evaluations)
    except BenchmarkError as error:
        record["error"] = str(error)
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(record) + "\n", encoding="utf-8")
    return record


def _scene(manifest: Manifest, job: Job, folder: Path) -> Path:
    """The scene folder that a training gets: as simulated or as given, with the trajectory that it shall have."""
    source = manifest.scenes[job.scene]
    if not isinstance(source, Path):
        simulation = replace(source, seed=job.seed)
        source = folder / "scenes" / f"{job.scene}-{job.seed}"
        if not (source / "scene.json").is_file():
            simulate(simulation, source)
    errors = _TRUE_ERRORS if job.trajectory == TRUE else manifest.trajectories[job.trajectory]
    if errors is None:
        return source
    made = folder / "scenes" / f"{job.scene}-{job.seed}-{job.trajectory}"
    if not (made / "scene.json").is_file():
        scene = read_scene(source)
        with whole_folder(made) as temporary:
            shutil.copytree(source, temporary, copy_function=_link, dirs_exist_ok=True)
            placed = temporary / scene.trajectory.relative_to(source)
            write_tum(placed, perturb(_true_keyframes(scene), errors, job.seed))
    return made


def _link(source: str, target: str) -> None:
    """Files are replaced, never changed, so that two folders can share them."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def _true_keyframes(scene: Scene) -> Trajectory:
    if scene.groundtruth is None:
        raise BenchmarkError(f"{scene.folder}: no groundtruth, expected one to make trajectories of; or use: as given")
    reference, t_us = read_tum(scene.groundtruth), read_tum(scene.trajectory).t_us
    t_us = t_us[within_span(t_us, reference.t_us)]
    return Trajectory(t_us, interpolate(reference.t_us, reference.poses, t_us))


def _initial_errors(scene: Scene) -> dict[str, float | None]:
    return {"ate_m": None, "rotation_deg": None, **evaluate_files(scene, scene.trajectory, None)}


def _joined(manifest: Manifest, other: Other, folder: Path) -> dict[str, Any]:
    """What another program reached, from its files."""
    if other.scene not in manifest.scenes or other.trajectory not in manifest.trajectories:
        raise BenchmarkError(f"others: {other.method} names {other.scene} and {other.trajectory}, not in the manifest")
    job = Job(other.method, other.scene, other.trajectory, other.seed, float(other.seconds))
    scene = read_scene(_scene(manifest, job, folder))
    evaluation = {"train_seconds": job.seconds, **evaluate_files(scene, other.refined, other.renders)}
    return {**vars(job), "initial": _initial_errors(scene), "evaluations": [evaluation]}
