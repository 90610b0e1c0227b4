"""Methods x scenes x trajectories x seeds x seconds, trained one after another; a stopped comparison can be resumed."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import date
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ebarf_ns.benchmarks.figures import machine
from ebarf_ns.benchmarks.manifest import TRUE, Manifest, Other, Stated
from ebarf_ns.benchmarks.training import train
from ebarf_ns.errors import BenchmarkError
from ebarf_ns.evaluation.outside import evaluate_files
from ebarf_ns.files import whole_file, whole_folder
from ebarf_ns.geometry.trajectory import Trajectory, interpolate, within_span
from ebarf_ns.geometry.trajectory_file import read_tum, write_tum
from ebarf_ns.scene import ContrastThreshold, Scene, read_scene, write_scene
from ebarf_ns.simulation.simulate import Simulation, simulate
from ebarf_ns.simulation.trajectory_errors import NO_ERRORS, perturb

_ANOTHER_WORLD = 0.1


@dataclass(frozen=True)
class Job:
    """One training."""

    method: str
    scene: str
    trajectory: str
    seed: int
    seconds: float

    def name(self, *made_of: object) -> str:
        """Folder name with a hash of everything that defines the training."""
        return _named(f"{self.scene}-{self.trajectory}-{self.seed}-{self.seconds:g}s-{self.method}", *made_of)


def _named(words: str, *made_of: object) -> str:
    return f"{words.replace(' ', '_')}-{sha256(repr(made_of).encode()).hexdigest()[:8]}"


def jobs(manifest: Manifest) -> list[Job]:
    """All trainings, seed by seed, so that a stopped comparison covers every combination."""
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
    """Run every training without a result in ``folder``; returns all results, also written to ``records.json``.

    A failed training is a result too: it has an ``error`` and no evaluations.
    """
    todo = [job for job in jobs(manifest) if job.trajectory != TRUE or _has_reference(manifest.scenes[job.scene])]
    records = []
    for done, job in enumerate(todo):
        progress(done, len(todo), f"{job.method}, {job.scene}, {job.trajectory}, seed {job.seed}, {job.seconds:g} s")
        records.append(_result(manifest, job, folder))
    progress(len(todo), len(todo), "")
    # A stopped comparison may have been resumed on another day and machine.
    measured = [record.pop("measured") for record in records]
    when, where, torch_version = (", ".join(sorted({one[what] for one in measured})) for what in _measured())
    records += [_joined(manifest, other, folder) for other in manifest.others]
    result = {
        "name": manifest.name,
        "date": when,
        "machine": where,
        "versions": {"torch": torch_version},
        "roles": {name: method.role for name, method in manifest.methods.items()},
        "records": records,
    }
    with whole_file(folder / "records.json") as temporary:
        temporary.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return result


def _has_reference(source: Simulation | Stated) -> bool:
    return isinstance(source, Simulation) or read_scene(source.folder).groundtruth is not None


def _result(manifest: Manifest, job: Job, folder: Path) -> dict[str, Any]:
    (scene, made_of), method = _scene(manifest, job, folder), manifest.methods[job.method]
    name = job.name(made_of, method, manifest.evaluations)
    path = folder / "results" / f"{name}.json"
    if path.is_file():
        return json.loads(path.read_text(encoding="utf-8"))
    record = {**vars(job), "measured": _measured(), "initial": _initial_errors(read_scene(scene)), "evaluations": []}
    run = folder / "runs" / name / method.words[0] / "run"
    shutil.rmtree(folder / "runs" / name, ignore_errors=True)
    try:
        record["evaluations"] = train(method.words, scene, run, job.seed, job.seconds, manifest.evaluations)
    except BenchmarkError as error:
        record["error"] = str(error)
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(record) + "\n", encoding="utf-8")
    return record


def _measured() -> dict[str, str]:
    return {"date": date.today().isoformat(), "machine": machine(), "torch": torch.__version__}


def _scene(manifest: Manifest, job: Job, folder: Path) -> tuple[Path, object]:
    """The folder of the simulated or given scene with the requested trajectory, and what defines it, for hashing."""
    source = manifest.scenes[job.scene]
    if isinstance(source, Simulation):
        simulation = replace(source, seed=job.seed)
        simulated = folder / "scenes" / _named(f"{job.scene}-{job.seed}", simulation)
        if not (simulated / "scene.json").is_file():
            simulate(simulation, simulated)
        scene, stated = read_scene(simulated), {}
    else:
        scene, stated = read_scene(source.folder), _stated(source)
    errors = NO_ERRORS if job.trajectory == TRUE else manifest.trajectories[job.trajectory]
    made_of = _contents(scene), errors, *([stated] if stated else [])
    if errors is None and not stated:
        return scene.folder, made_of
    made = folder / "scenes" / _named(f"{job.scene}-{job.seed}-{job.trajectory}", made_of, job.seed)
    if not (made / "scene.json").is_file():
        true = None if errors is None else _true_keyframes(scene)
        if true is not None:
            _check_bounds_are_of_reference(scene, true)
        with whole_folder(made) as temporary:
            scene = replace(_copied(scene, temporary), **stated)
            if true is not None and errors is not None:
                trajectory = temporary / "trajectory.txt"
                write_tum(trajectory, perturb(true, errors, job.seed))
                bounds = scene.bounds and tuple(tuple(errors.scale * one for one in corner) for corner in scene.bounds)
                scene = replace(scene, trajectory=trajectory, bounds=bounds or None)
            write_scene(scene)
    return made, made_of


def _copied(scene: Scene, folder: Path) -> Scene:
    """The scene copied to another folder; its events, the only large file, stay in place."""

    def copied(path: Path | None) -> Path | None:
        if path is None:
            return None
        inside = path.is_relative_to(scene.folder)
        copy = folder / (path.relative_to(scene.folder) if inside else path.name)
        copy.parent.mkdir(parents=True, exist_ok=True)
        return Path(shutil.copyfile(path, copy))

    frames = (replace(frame, path=copied(frame.path), depth=copied(frame.depth)) for frame in scene.frames)
    return replace(
        scene,
        folder=folder,
        events=scene.events.absolute(),
        trajectory=copied(scene.trajectory),
        groundtruth=copied(scene.groundtruth),
        frames=tuple(frames),
    )


def _stated(source: Stated) -> dict[str, Any]:
    """Sensor facts given in the manifest, under the field names of :class:`Scene`."""
    facts = {name: getattr(source, name) for name in ("refractory_us", "time_constant_us")}
    if source.threshold_on is not None and source.threshold_off is not None:
        facts["contrast_threshold"] = ContrastThreshold(source.threshold_on, source.threshold_off)
    return {name: fact for name, fact in facts.items() if fact is not None}


def _contents(scene: Scene) -> object:
    """Identity of a scene's contents: small files in full, large ones by size."""
    small = (scene.folder / "scene.json", scene.trajectory, scene.groundtruth)
    large = (scene.events, *(frame.path for frame in scene.frames))
    return [path.read_bytes() for path in small if path], [path.stat().st_size for path in large if path.is_file()]


def _true_keyframes(scene: Scene) -> Trajectory:
    if scene.groundtruth is None:
        raise BenchmarkError(f"{scene.folder}: no groundtruth, expected one to make trajectories of; or use: as given")
    reference, t_us = read_tum(scene.groundtruth), read_tum(scene.trajectory).t_us
    t_us = t_us[within_span(t_us, reference.t_us)]
    return Trajectory(t_us, interpolate(reference.t_us, reference.poses, t_us))


def _check_bounds_are_of_reference(scene: Scene, true: Trajectory) -> None:
    """Bounds are in the frame of the scene's own trajectory; trajectories made from the reference must share it."""
    if scene.bounds is None:
        return
    own = read_tum(scene.trajectory)
    apart = interpolate(own.t_us, own.poses, true.t_us).position - true.poses.position
    off, size = float(apart.norm(dim=-1).median()), float(np.diff(scene.bounds, axis=0).max())
    if off > _ANOTHER_WORLD * size:
        raise BenchmarkError(
            f"{scene.folder}: bounds are those of its trajectory, which is {off:.3g} from the groundtruth (median) in "
            f"bounds {size:.3g} wide; expected both in one world to make trajectories of the groundtruth, or: as given"
        )


def _initial_errors(scene: Scene) -> dict[str, float | None]:
    return {"ate_m": None, "rotation_deg": None, **evaluate_files(scene, scene.trajectory, None)}


def _joined(manifest: Manifest, other: Other, folder: Path) -> dict[str, Any]:
    """Results of another program, evaluated from its files."""
    job = Job(other.method, other.scene, other.trajectory, other.seed, float(other.seconds))
    folder_of_scene, _ = _scene(manifest, job, folder)
    scene = read_scene(folder_of_scene)
    evaluation = {"train_seconds": job.seconds, **evaluate_files(scene, other.refined, other.renders)}
    return {**vars(job), "initial": _initial_errors(scene), "evaluations": [evaluation]}
