"""Simulate a scene folder with ground truth from surroundings, motion and sensor."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from ebarf_ns.errors import SimulationError
from ebarf_ns.events.recording import write_recording
from ebarf_ns.files import whole_folder, write_picture
from ebarf_ns.geometry.cameras import COEFFICIENTS, Camera, CameraModel
from ebarf_ns.geometry.trajectory_file import write_tum
from ebarf_ns.scene import ContrastThreshold, Frame, Scene, read_scene, write_scene
from ebarf_ns.simulation.catalogue import CATALOGUE, Place, SceneName
from ebarf_ns.simulation.mesh import RoomWithMesh
from ebarf_ns.simulation.motion import Faster, sample_trajectory
from ebarf_ns.simulation.record import record
from ebarf_ns.simulation.room import Room
from ebarf_ns.simulation.sensor import SensorModel
from ebarf_ns.simulation.trajectory_errors import TrajectoryErrors, check_errors, perturb
from ebarf_ns.simulation.view import View

_LARGEST = 1e5
_MARGIN_M = 0.2
_MESH_SIZE_M = 1.2
_FRAME_RAYS = 16
_EXPOSURES = 32
_WHITE = 4.0
"""Radiance at which frames saturate; indoors, the brightest patches are below 2."""


@dataclass(frozen=True)
class Simulation:
    """Simulation settings; the defaults are the demo scene."""

    scene: SceneName = "handheld-room"
    """Surroundings and motion."""
    mesh: Path | None = None
    """A textured mesh, scaled to 1.2 m, that replaces the boxes and balls in the room."""
    speed: float = 1.0
    """Speed of the camera relative to the scene's default."""
    duration_s: float = 2.0
    width: int = 128
    height: int = 96
    focal_px: float = 110.0
    lens: CameraModel = "pinhole"
    distortion: tuple[float, ...] = ()
    """Distortion coefficients: k1 k2 p1 p2 [k3] for radtan, k1 k2 k3 k4 for equidistant."""
    rays_per_pixel: Literal[1, 4, 16] = 16
    """Rays averaged per pixel: with fewer, sharp edges cause jumps of several events at once."""
    sensor: SensorModel = field(default_factory=SensorModel)
    """Pixel parameters."""
    tell_thresholds: bool = True
    """Write the contrast thresholds into the scene, although they are seldom known for real recordings."""
    keyframe_rate_hz: float = 20.0
    errors: TrajectoryErrors = field(default_factory=TrajectoryErrors)
    """Errors of the initial trajectory."""
    frames: int = 12
    """Number of evenly spaced validation frames."""
    exposure_ms: float = 0.0
    """If above 0, frames with motion blur of this exposure time are also written, to frames_blurred."""
    seed: int = 0
    """Random seed of the motion, the room's pattern, the sensor and the trajectory errors."""


def simulate(
    settings: Simulation,
    folder: Path,
    progress: Callable[[float], None] = lambda fraction: None,
    place: Place | None = None,
) -> Scene:
    """Simulate and write a scene folder, of ``place`` if given; raises :class:`SimulationError` for bad settings."""
    end_us = _check(settings)
    place = place or CATALOGUE[settings.scene](settings.seed)
    view = _view(place, settings)
    recording = record(view, settings.sensor, end_us, settings.seed, progress)
    if not len(recording):
        raise SimulationError(
            f"no event in {settings.duration_s} s at thresholds {settings.sensor.threshold_on} and "
            f"{settings.sensor.threshold_off}, expected lower thresholds or a longer duration"
        )
    keyframes = sample_trajectory(view.motion, _times_us(end_us, settings.keyframe_rate_hz))
    with whole_folder(folder) as temporary:
        write_recording(temporary / "events.h5", [recording])
        write_tum(temporary / "groundtruth.txt", sample_trajectory(view.motion, _times_us(end_us, 200.0)))
        write_tum(temporary / "trajectory.txt", perturb(keyframes, settings.errors, settings.seed))
        scene = Scene(
            folder=temporary,
            events=temporary / "events.h5",
            trajectory=temporary / "trajectory.txt",
            camera=view.camera,
            groundtruth=temporary / "groundtruth.txt",
            frames=_write_frames(_view(place, settings, _FRAME_RAYS), settings, end_us, temporary),
            contrast_threshold=ContrastThreshold(settings.sensor.threshold_on, settings.sensor.threshold_off)
            if settings.tell_thresholds
            else None,
            bounds=_bounds(place.room, settings.errors.scale),
        )
        write_scene(scene)
    return read_scene(folder)


def _check(settings: Simulation) -> int:
    """Validate the settings and return the recording's duration in microseconds."""
    positive = {
        name: getattr(settings, name) for name in "speed duration_s width height focal_px keyframe_rate_hz".split()
    }
    positive |= {name: getattr(settings.sensor, name) for name in ("threshold_on", "threshold_off")}
    for name, value in positive.items():
        if not 0 < value < _LARGEST:
            raise SimulationError(f"{name} is {value}, expected a value above 0 and below {_LARGEST:g}")
    for name, value in vars(settings.sensor).items():
        if name != "threshold_drift" and not 0 <= value < 1e9:
            raise SimulationError(f"{name} is {value}, expected 0 or more")
    if abs(settings.sensor.threshold_drift) > 1:
        raise SimulationError(f"threshold_drift is {settings.sensor.threshold_drift}, expected -1 to 1")
    if settings.seed < 0 or settings.frames < 0:
        raise SimulationError(f"seed is {settings.seed} and frames {settings.frames}, expected 0 or more")
    if not 0 <= settings.exposure_ms < _LARGEST:
        raise SimulationError(f"exposure_ms is {settings.exposure_ms}, expected 0 or more")
    if len(settings.distortion) not in COEFFICIENTS[settings.lens]:
        counts = " or ".join(map(str, COEFFICIENTS[settings.lens]))
        raise SimulationError(f"distortion has {len(settings.distortion)} values, expected {counts} of {settings.lens}")
    check_errors(settings.errors)
    end_us = round(settings.duration_s * 1e6)
    if end_us * settings.keyframe_rate_hz < 1e6:
        raise SimulationError(
            f"{settings.duration_s} s at {settings.keyframe_rate_hz} Hz is fewer than 2 keyframes, expected 2 or more"
        )
    return end_us


def _view(place: Place, settings: Simulation, rays_per_pixel: int | None = None) -> View:
    camera = Camera(
        settings.lens, settings.width, settings.height, settings.focal_px, settings.focal_px,
        (settings.width - 1) / 2, (settings.height - 1) / 2, settings.distortion,
    )  # fmt: skip
    room = place.room
    if settings.mesh:
        room = RoomWithMesh(replace(room, boxes=(), balls=()), settings.mesh, _MESH_SIZE_M, place.middle)
    motion = place.motion if settings.speed == 1 else Faster(place.motion, settings.speed)
    return View(room, motion, camera, rays_per_pixel or settings.rays_per_pixel)


def _times_us(end_us: int, rate_hz: float) -> np.ndarray:
    return np.unique(np.r_[np.arange(0, end_us, 1e6 / rate_hz).round().astype(np.int64), end_us])


def _bounds(room: Room, scale: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The room's bounds in the unit of the initial trajectory."""
    lower, upper = np.asarray(room.lower) - _MARGIN_M, np.asarray(room.upper) + _MARGIN_M
    return tuple((scale * lower).tolist()), tuple((scale * upper).tolist())


def _write_frames(view: View, settings: Simulation, end_us: int, folder: Path) -> tuple[Frame, ...]:
    """Write sharp frames with distance maps and, optionally, the same frames with motion blur."""
    frames = []
    half_us = settings.exposure_ms * 500
    for k in range(settings.frames):
        t_us = round(end_us * (k + 0.5) / settings.frames)
        radiance, distance = (image[0] for image in view.images(np.array([float(t_us)])))
        name = f"{k:04d}"
        _write_grey(folder / "frames" / f"{name}.png", radiance, view.camera)
        (folder / "depth").mkdir(exist_ok=True)
        depth = folder / "depth" / f"{name}.npy"
        np.save(depth, distance.astype(np.float32).reshape(view.camera.height, view.camera.width))
        if half_us:
            instants = t_us + half_us * (2 * (np.arange(_EXPOSURES) + 0.5) / _EXPOSURES - 1)
            blurred = view.images(instants)[0].mean(axis=0)
            _write_grey(folder / "frames_blurred" / f"{name}.png", blurred, view.camera)
        identity = tuple(map(tuple, np.eye(4).tolist()))
        frames.append(Frame(folder / "frames" / f"{name}.png", t_us, view.camera, identity, "linear", depth))
    return tuple(frames)


def _write_grey(path: Path, radiance: np.ndarray, camera: Camera) -> None:
    path.parent.mkdir(exist_ok=True)
    grey = np.clip(radiance / _WHITE * 65535, 0, 65535).round().astype(np.uint16)
    write_picture(path, grey.reshape(camera.height, camera.width))
