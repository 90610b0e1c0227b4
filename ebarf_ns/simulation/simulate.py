"""Scene + motion + sensor: a scene folder like any other, with the truth beside it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float

from ebarf_ns.errors import SimulationError
from ebarf_ns.events.recording import Recording, write_recording
from ebarf_ns.files import whole_folder
from ebarf_ns.geometry.cameras import Camera
from ebarf_ns.geometry.trajectory_file import write_tum
from ebarf_ns.scene import ContrastThreshold, Frame, Scene, write_scene
from ebarf_ns.simulation.motion import HandheldMotion, perturb, sample_trajectory
from ebarf_ns.simulation.room import Room
from ebarf_ns.simulation.sensor import EventSensor

_LARGEST = 1e5
_PIXELS_PER_STEP = 1 / 3
_MARGIN_M = 0.2
_SUBPIXELS = (-0.25, 0.25)
_FRAME_SUBPIXELS = (-0.375, -0.125, 0.125, 0.375)


@dataclass(frozen=True)
class Simulation:
    """What to simulate; the defaults are the demo scene."""

    duration_s: float = 2.0
    width: int = 128
    height: int = 96
    focal_px: float = 110.0
    threshold_on: float = 0.25
    threshold_off: float = 0.25
    keyframe_rate_hz: float = 20.0
    position_noise_m: float = 0.03
    """Standard deviation per axis of the error of each keyframe of the initial trajectory."""
    rotation_noise_rad: float = 0.03
    frames: int = 12
    """Validation frames, evenly spaced."""
    seed: int = 0
    """Of the motion, the room's pattern and the trajectory errors."""


def simulate(settings: Simulation, folder: Path, progress: Callable[[float], None] = lambda fraction: None) -> Scene:
    """Write a scene folder; raises :class:`SimulationError` for settings that describe no scene."""
    for name in ("duration_s", "width", "height", "focal_px", "threshold_on", "threshold_off", "keyframe_rate_hz"):
        value = getattr(settings, name)
        if not 0 < value < _LARGEST:
            raise SimulationError(f"{name} is {value}, expected a value above 0 and below {_LARGEST:g}")
    room, motion = Room(seed=settings.seed), HandheldMotion(seed=settings.seed)
    camera = Camera(
        "pinhole", settings.width, settings.height, settings.focal_px, settings.focal_px,
        (settings.width - 1) / 2, (settings.height - 1) / 2,
    )  # fmt: skip
    end_us = round(settings.duration_s * 1e6)
    if end_us * settings.keyframe_rate_hz < 1e6:
        raise SimulationError(
            f"{settings.duration_s} s at {settings.keyframe_rate_hz} Hz is fewer than 2 keyframes, expected 2 or more"
        )
    recording = _record(room, motion, camera, settings, end_us, progress)
    if not len(recording):
        raise SimulationError(
            f"no event in {settings.duration_s} s at thresholds {settings.threshold_on} and {settings.threshold_off}, "
            "expected lower thresholds or a longer duration"
        )
    keyframes = sample_trajectory(motion, _times_us(end_us, settings.keyframe_rate_hz))
    with whole_folder(folder) as temporary:
        write_recording(temporary / "events.h5", recording)
        write_tum(temporary / "groundtruth.txt", sample_trajectory(motion, _times_us(end_us, 200.0)))
        initial = perturb(keyframes, settings.position_noise_m, settings.rotation_noise_rad, settings.seed)
        write_tum(temporary / "trajectory.txt", initial)
        scene = Scene(
            folder=temporary,
            events=temporary / "events.h5",
            trajectory=temporary / "trajectory.txt",
            camera=camera,
            groundtruth=temporary / "groundtruth.txt",
            frames=_write_frames(room, motion, camera, settings.frames, end_us, temporary),
            contrast_threshold=ContrastThreshold(settings.threshold_on, settings.threshold_off),
            bounds=(
                tuple(value - _MARGIN_M for value in room.lower),
                tuple(value + _MARGIN_M for value in room.upper),
            ),
        )
        write_scene(scene)
    return scene


def _times_us(end_us: int, rate_hz: float) -> np.ndarray:
    return np.unique(np.r_[np.arange(0, end_us, 1e6 / rate_hz).round().astype(np.int64), end_us])


def _render(
    room: Room, motion: HandheldMotion, camera: Camera, t_us: int, subpixels: tuple[float, ...]
) -> tuple[Float[np.ndarray, "pixels"], float]:
    """Mean radiance over each pixel, and the distance of the nearest thing in view."""
    times = np.array([t_us])
    rotation, origin = motion.rotation(times).as_matrix()[0], motion.position(times)[0]
    grid = camera.pixel_grid().reshape(-1, 2)
    total, nearest = np.zeros(len(grid)), np.inf
    for dy in subpixels:
        for dx in subpixels:
            bearings = camera.bearings(grid + torch.tensor([dx, dy])).numpy()
            radiance, distance = room.cast(origin, bearings @ rotation.T)
            total += radiance
            nearest = min(nearest, float(distance.min()))
    return total / len(subpixels) ** 2, nearest


def _record(
    room: Room,
    motion: HandheldMotion,
    camera: Camera,
    settings: Simulation,
    end_us: int,
    progress: Callable[[float], None],
) -> Recording:
    sensor = EventSensor(settings.threshold_on, settings.threshold_off, camera.width)
    t_us = 0
    while True:
        radiance, nearest_m = _render(room, motion, camera, t_us, _SUBPIXELS)
        sensor.see(t_us, np.log(radiance))
        if t_us == end_us:
            return sensor.recording()
        t_us = min(end_us, t_us + _step_us(motion, camera, t_us, nearest_m))
        progress(t_us / end_us)


def _step_us(motion: HandheldMotion, camera: Camera, t_us: int, nearest_m: float) -> int:
    """The time in which no pixel moves further than a third of a pixel."""
    probe_us = 500
    times = np.array([t_us, t_us + probe_us])
    speed_m_s = np.linalg.norm(np.diff(motion.position(times), axis=0)) / (probe_us * 1e-6)
    first, second = motion.rotation(times)
    turn_rad_s = (first.inv() * second).magnitude() / (probe_us * 1e-6)
    corner = max(camera.width, camera.height) / 2 / camera.fx
    flow_px_s = camera.fx * (1 + corner**2) * (turn_rad_s + speed_m_s / nearest_m)
    return max(1, int(_PIXELS_PER_STEP / max(flow_px_s, 1e-3) * 1e6))


def _write_frames(
    room: Room, motion: HandheldMotion, camera: Camera, count: int, end_us: int, folder: Path
) -> tuple[Frame, ...]:
    frames = []
    (folder / "frames").mkdir()
    for k in range(count):
        t_us = round(end_us * (k + 0.5) / count)
        radiance, _ = _render(room, motion, camera, t_us, _FRAME_SUBPIXELS)
        # 16 bits over radiance 0 to 4: the pattern's brightest patches are below 2.
        grey = np.clip(radiance / 4 * 65535, 0, 65535).round().astype(np.uint16)
        path = folder / "frames" / f"{k:04d}.png"
        cv2.imwrite(str(path), grey.reshape(camera.height, camera.width))
        frames.append(Frame(path, t_us, camera, tuple(map(tuple, np.eye(4).tolist())), "linear"))
    return tuple(frames)
