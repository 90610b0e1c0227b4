"""Other people's layouts to scene folders; sources are only read."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from ebarf_ns.errors import SceneError, TrajectoryError
from ebarf_ns.events.readers.text import read_text_events
from ebarf_ns.events.recording import Recording, write_recording
from ebarf_ns.files import whole_folder
from ebarf_ns.geometry.cameras import Camera
from ebarf_ns.geometry.trajectory import Poses, Trajectory
from ebarf_ns.geometry.trajectory_file import read_tum, write_tum
from ebarf_ns.scene import Frame, Scene, write_scene

_DAVIS240C = (240, 180)
Bounds = tuple[tuple[float, float, float], tuple[float, float, float]]


def process_ecd(
    source: Path,
    output: Path,
    trajectory: Path | None = None,
    sensor_size: tuple[int, int] = _DAVIS240C,
    bounds: Bounds | None = None,
) -> str:
    """Make a scene of an event camera dataset folder (Mueggler et al. 2017) and say what was kept.

    ``events.txt`` (t x y p), ``calib.txt`` (fx fy cx cy k1 k2 p1 p2 k3), ``groundtruth.txt`` (TUM) and, where there,
    ``images.txt`` (t file). The initial trajectory is ``trajectory``, or the ground truth itself. Trajectories are
    clipped to the events' span and one pose more at either end.
    """
    camera = _read_calibration(source / "calib.txt", sensor_size)
    recording = read_text_events(source / "events.txt", *sensor_size)
    groundtruth_file = source / "groundtruth.txt"
    initial = _clip(trajectory or groundtruth_file, recording)
    groundtruth = _clip(groundtruth_file, recording) if groundtruth_file.is_file() else None
    images = _read_image_list(source / "images.txt") if (source / "images.txt").is_file() else []
    start_us, end_us = int(recording.t_us[0]), int(recording.t_us[-1])
    kept_images = [(t_us, path) for t_us, path in images if start_us <= t_us <= end_us]
    with whole_folder(output) as folder:
        write_recording(folder / "events.h5", recording)
        write_tum(folder / "trajectory.txt", initial)
        if groundtruth:
            write_tum(folder / "groundtruth.txt", groundtruth)
        scene = Scene(
            folder=folder,
            events=folder / "events.h5",
            trajectory=folder / "trajectory.txt",
            camera=camera,
            groundtruth=folder / "groundtruth.txt" if groundtruth else None,
            frames=tuple(_copy_frame(path, t_us, camera, folder) for t_us, path in kept_images),
            bounds=bounds,
        )
        write_scene(scene)
    return (
        f"{len(recording):,} events over {(end_us - start_us) * 1e-6:.3f} s, {len(initial.t_us)} keyframes, "
        f"{len(kept_images)} of {len(images)} frames within the events' span"
    )


def _read_calibration(path: Path, sensor_size: tuple[int, int]) -> Camera:
    expected = "9 numbers 'fx fy cx cy k1 k2 p1 p2 k3'"
    try:
        text = path.read_text(encoding="utf-8")
        values = [float(field) for field in text.split()]
    except OSError as error:
        raise SceneError(f"{path}: {error.strerror or error}, expected {expected}") from None
    except ValueError as error:
        raise SceneError(f"{path}: {error}, expected {expected}") from None
    if len(values) != 9 or not np.isfinite(values).all() or min(values[:2]) <= 0:
        raise SceneError(f"{path}: holds {' '.join(text.split())[:80]!r}, expected {expected}")
    return Camera("radtan", *sensor_size, *values[:4], distortion=tuple(values[4:]))


def _clip(path: Path, recording: Recording) -> Trajectory:
    """The poses within the events' span, and one more at either end."""
    trajectory = read_tum(path)
    span = torch.tensor([recording.t_us[0], recording.t_us[-1]])
    first, last = torch.searchsorted(trajectory.t_us, span).tolist()
    chosen = slice(max(first - 1, 0), last + 1)
    clipped = Trajectory(trajectory.t_us[chosen], Poses(*(column[chosen] for column in trajectory.poses)))
    if len(clipped.t_us) < 2:
        raise TrajectoryError(
            f"{path}: poses from {trajectory.t_us[0]} to {trajectory.t_us[-1]} us, but events from {span[0]} to "
            f"{span[1]} us; expected at least 2 poses around the events, in seconds on the same clock"
        )
    return clipped


def _read_image_list(path: Path) -> list[tuple[int, Path]]:
    images = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        fields: Sequence[str] = line.split()
        if not fields:
            continue
        try:
            t_us = round(float(fields[0]) * 1e6)
        except ValueError:
            raise SceneError(f"{path}:{number}: {line!r:.60}, expected 't[s] file'") from None
        if len(fields) != 2 or not (path.parent / fields[1]).is_file():
            raise SceneError(f"{path}:{number}: {line!r:.60}, expected 't[s] file' with an existing file")
        images.append((t_us, path.parent / fields[1]))
    return images


def _copy_frame(source: Path, t_us: int, camera: Camera, folder: Path) -> Frame:
    path = folder / "frames" / source.name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(source.read_bytes())
    # The DAVIS' frames are linear up to its sensor's offset.
    return Frame(path, t_us, camera, tuple(map(tuple, np.eye(4).tolist())), "linear")
