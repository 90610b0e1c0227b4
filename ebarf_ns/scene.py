"""The scene folder: scene.json and the files it names, read, validated and written."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import torch

from ebarf_ns.errors import SceneError, did_you_mean
from ebarf_ns.geometry.cameras import COEFFICIENTS, Camera
from ebarf_ns.json_file import JsonObject, is_number, read_json, write_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jaxtyping import Float
    from torch import Tensor

    from ebarf_ns.geometry.trajectory import Trajectory

FORMAT, VERSION = "ebarf-scene", 1
_LARGE_SHARE = 0.05
# A trajectory this much longer than its recording, with no keyframes among the events, is in another time unit.
_LONGEST_SPAN_RATIO = 100
_LONGEST_REFRACTORY_US = 1_000_000
_LONGEST_TIME_CONSTANT_US = 1_000_000
# Far beyond real sensors: larger values are mistakes, for which no memory is allocated.
_MOST_PIXELS, _MOST_SIDES, _MOST_EXTENT, _MOST_THRESHOLD = 1 << 26, 1e4, 1e9, 1e3
_LATEST_US = 1 << 61
_SENSOR_KEYS = "contrast_threshold refractory_us time_constant_us"
_KEYS = f"format version events trajectory groundtruth frames camera {_SENSOR_KEYS} bounds"
FrameIntensity = Literal["linear", "srgb", "log"]


@dataclass(frozen=True)
class ContrastThreshold:
    """The contrast thresholds in log brightness, per polarity."""

    on: float
    off: float


@dataclass(frozen=True)
class Frame:
    """A validation frame, never used for training."""

    path: Path
    t_us: int
    camera: Camera
    event_camera_from_frame_camera: tuple[tuple[float, ...], ...]
    """4x4 transform; identity if the event sensor itself took the frame."""
    intensity: FrameIntensity
    depth: Path | None = None
    """Distances along the pixels' rays in the reference's unit (npy), if known."""


@dataclass(frozen=True)
class Scene:
    """The contents of a scene folder; paths are absolute or relative to the working directory, never to the folder."""

    folder: Path
    events: Path
    trajectory: Path
    camera: Camera
    groundtruth: Path | None = None
    frames: tuple[Frame, ...] = ()
    contrast_threshold: ContrastThreshold | None = None
    refractory_us: int | None = None
    """Refractory period of a pixel after an event."""
    time_constant_us: float | None = None
    """Time constant of the photoreceptor's low-pass filter at the mean log brightness of the scene."""
    bounds: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """Lower and upper corner in world units."""
    missing: tuple[Path, ...] = ()
    """Missing files of validation frames; such frames, or their depths, are left out."""


def read_scene(folder: Path, trajectory_to_come: bool = False) -> Scene:
    """Read ``folder/scene.json``; raises :class:`SceneError` naming file, key, value and expectation.

    Validation frames may be missing, since training does not use them; so may the trajectory with
    ``trajectory_to_come``.
    """
    path = folder / "scene.json"
    if not folder.is_dir():
        what = "a file" if folder.exists() else "no such folder"
        raise SceneError(f"{folder}: {what}, expected a scene folder with scene.json in it{did_you_mean(folder)}")
    content = JsonObject(path, "", read_json(path))
    content.only(_KEYS.split())
    content.choice("format", (FORMAT,))
    if content.integer("version", positive=True) > VERSION:
        raise content.wrong("version", f"at most {VERSION}: a newer ebarf_ns made it")
    camera = _camera(content.object("camera"))
    frames, missing = _read_frames(content.optional_file("frames", must_exist=False), camera)
    return Scene(
        folder=folder,
        # A trained run can be viewed and exported without its recording: a missing one is an error only when read.
        events=content.file("events", must_exist=False, absolute=True),
        trajectory=_trajectory(content, trajectory_to_come),
        camera=camera,
        groundtruth=content.optional_file("groundtruth"),
        frames=frames,
        missing=missing,
        contrast_threshold=_threshold(content.object("contrast_threshold"))
        if content.get("contrast_threshold") is not None
        else None,
        refractory_us=_refractory_us(content) if content.get("refractory_us") is not None else None,
        time_constant_us=_time_constant_us(content) if content.get("time_constant_us") is not None else None,
        bounds=_bounds(content) if content.get("bounds") is not None else None,
    )


def _trajectory(content: JsonObject, to_come: bool) -> Path:
    path = content.file("trajectory", must_exist=False)
    if not to_come and not path.is_file():
        raise SceneError(
            f"{content.path}: trajectory names {path.name!r}, but there is no file {path}; expected one, or make it: "
            f"ebarf trajectory estimate {content.path.parent}"
        )
    return path


def check_bounds(scene: Scene, trajectory: Trajectory) -> None:
    """Raise :class:`SceneError` if no keyframe lies within the bounds."""
    if scene.bounds is None:
        return
    lower, upper = torch.tensor(scene.bounds, dtype=torch.float64)
    position = trajectory.poses.position
    if ((position < lower) | (position > upper)).any(dim=-1).all():
        raise SceneError(
            f"{scene.folder / 'scene.json'}: bounds {scene.bounds} hold none of the {len(position)} keyframes of "
            f"{scene.trajectory.name}, the first of which is at {position[0].tolist()}; expected bounds around them"
        )


def box_of_bounds(bounds: Sequence[Sequence[float]]) -> tuple[Float[Tensor, "3"], float, Float[Tensor, "3"]]:
    """Centre, scale and half sides of bounds: the longest side of ``(x - centre) * scale`` reaches from -1 to 1."""
    lower, upper = torch.tensor(bounds, dtype=torch.float64)
    scale = 2 / float((upper - lower).max())
    return (lower + upper) / 2, scale, (upper - lower) * scale / 2


def check_clocks(scene: Scene, events_us: tuple[int, int], trajectory: Trajectory) -> None:
    """Raise :class:`SceneError` if events and trajectory cannot be on one clock in one time unit.

    ``events_us`` are the times of the first and the last event.
    """
    keyframe_t_us = trajectory.t_us.numpy()
    (start_us, end_us), (first_us, last_us) = events_us, keyframe_t_us[[0, -1]].tolist()
    among = int(((keyframe_t_us >= start_us) & (keyframe_t_us <= end_us)).sum())
    expected = f"expected {scene.trajectory.name} to be in seconds on the clock of the events"
    if start_us > last_us or end_us < first_us:
        raise SceneError(
            f"{scene.events}: none of the events, {start_us} to {end_us} us, lies within the span of "
            f"{scene.trajectory.name}, {first_us} to {last_us} us; {expected}; ebarf process "
            f"--time-offset-us {first_us - start_us} would let both begin together"
        )
    if among < 2 and last_us - first_us > _LONGEST_SPAN_RATIO * max(end_us - start_us, 1):
        raise SceneError(
            f"{scene.trajectory}: spans {last_us - first_us} us with {among} keyframes among the events, which span "
            f"{end_us - start_us} us; {expected}"
        )


def events_left_out(outside: int, events: int) -> list[str]:
    """Return a warning if a large share of events lies outside the trajectory's span."""
    large = outside > _LARGE_SHARE * events
    return [f"{outside / events:.0%} of the events lie outside the trajectory's span and are left out"] if large else []


def write_scene(scene: Scene) -> None:
    """Write ``scene.json`` and, with frames, ``frames.json``; the caller writes the files that they name."""
    content: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "events": _relative(scene.events, scene.folder),
        "trajectory": _relative(scene.trajectory, scene.folder),
        "groundtruth": _relative(scene.groundtruth, scene.folder) if scene.groundtruth else None,
        "frames": "frames.json" if scene.frames else None,
        "camera": _camera_json(scene.camera),
        "contrast_threshold": vars(scene.contrast_threshold) if scene.contrast_threshold else None,
        "refractory_us": scene.refractory_us,
        "time_constant_us": scene.time_constant_us,
        "bounds": scene.bounds,
    }
    if scene.frames:
        write_json(scene.folder / "frames.json", [_frame_json(frame, scene) for frame in scene.frames])
    write_json(scene.folder / "scene.json", content)


def _relative(path: Path, folder: Path) -> str:
    """The path of a file for scene.json: relative to the folder, or absolute for files elsewhere."""
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.resolve().as_posix()


def write_camera(path: Path, camera: Camera) -> None:
    """Write a camera in the format of "camera" in ``scene.json``."""
    write_json(path, _camera_json(camera))


def _camera_json(camera: Camera) -> dict[str, Any]:
    return {**vars(camera), "distortion": list(camera.distortion)}


def _frame_json(frame: Frame, scene: Scene) -> dict[str, Any]:
    content: dict[str, Any] = {
        "file": _relative(frame.path, scene.folder),
        "t_us": frame.t_us,
        "intensity": frame.intensity,
    }
    if frame.depth:
        content["depth"] = _relative(frame.depth, scene.folder)
    if frame.camera != scene.camera:
        content["camera"] = _camera_json(frame.camera)
    if not np.array_equal(frame.event_camera_from_frame_camera, np.eye(4)):
        content["event_camera_from_frame_camera"] = frame.event_camera_from_frame_camera
    return content


def _camera(content: JsonObject) -> Camera:
    content.only("model width height fx fy cx cy distortion".split())
    model = content.choice("model", tuple(COEFFICIENTS))
    distortion = content.get("distortion") or []
    counts = COEFFICIENTS[model]
    if not isinstance(distortion, list) or len(distortion) not in counts or not all(map(is_number, distortion)):
        raise content.wrong("distortion", f"a list of {' or '.join(map(str, counts))} numbers for model {model}")
    width, height = (content.integer(key, positive=True) for key in ("width", "height"))
    if width * height > _MOST_PIXELS:
        raise content.wrong("width", f"at most {_MOST_PIXELS:,} pixels, with height {height:.6g}")

    def sides(key: str, positive: bool = False) -> float:
        """A length in pixels that is plausible for the sensor's size."""
        value, most = content.number(key, positive=positive), _MOST_SIDES * max(width, height)
        if abs(value) > most or (positive and value < 1 / _MOST_SIDES):
            raise content.wrong(key, f"{f'{1 / _MOST_SIDES} to ' if positive else 'within ±'}{most:.6g} pixels")
        return value

    return Camera(
        model=model,
        width=width,
        height=height,
        fx=sides("fx", positive=True),
        fy=sides("fy", positive=True),
        cx=sides("cx"),
        cy=sides("cy"),
        distortion=tuple(float(value) for value in distortion),
    )


def _threshold(content: JsonObject) -> ContrastThreshold:
    content.only(["on", "off"])
    for key in ("on", "off"):
        if not 1 / _MOST_THRESHOLD <= content.number(key, positive=True) <= _MOST_THRESHOLD:
            raise content.wrong(key, f"a number from {1 / _MOST_THRESHOLD:g} to {_MOST_THRESHOLD:g}")
    return ContrastThreshold(content.number("on"), content.number("off"))


def _refractory_us(content: JsonObject) -> int:
    value = content.integer("refractory_us")
    if not 0 <= value <= _LONGEST_REFRACTORY_US:
        raise content.wrong("refractory_us", f"whole microseconds from 0 to {_LONGEST_REFRACTORY_US}")
    return value


def _time_constant_us(content: JsonObject) -> float:
    value = content.number("time_constant_us")
    if not 0 <= value <= _LONGEST_TIME_CONSTANT_US:
        raise content.wrong("time_constant_us", f"microseconds from 0 to {_LONGEST_TIME_CONSTANT_US}")
    return value


def _bounds(content: JsonObject) -> tuple[tuple[float, ...], tuple[float, ...]]:
    bounds = content.get("bounds")
    expected = "two corners [[x, y, z], [x, y, z]], the first below the second on every axis"
    if not isinstance(bounds, list) or len(bounds) != 2:
        raise content.wrong("bounds", expected)
    lower, upper = bounds
    for corner in bounds:
        if not isinstance(corner, list) or len(corner) != 3 or not all(map(is_number, corner)):
            raise content.wrong("bounds", expected)
    if not all(low < high for low, high in zip(lower, upper, strict=True)):
        raise content.wrong("bounds", expected)
    if max(map(abs, [*lower, *upper])) > _MOST_EXTENT:
        raise content.wrong("bounds", f"{expected}, within ±{_MOST_EXTENT:g}")
    return tuple(map(float, lower)), tuple(map(float, upper))


def _read_frames(path: Path | None, event_camera: Camera) -> tuple[tuple[Frame, ...], tuple[Path, ...]]:
    """The frames whose files exist, and the missing files."""
    if path is None or not path.exists():
        return (), (path,) if path else ()
    content = read_json(path)
    if not isinstance(content, list):
        raise SceneError(f"{path}: holds a {type(content).__name__}, expected a list of frames")
    frames = [_frame(JsonObject(path, f"[{k}]", item), event_camera) for k, item in enumerate(content)]
    named = [file for frame in frames for file in (frame.path, frame.depth) if file]
    missing = tuple(file for file in named if not file.is_file())
    present = [frame for frame in frames if frame.path not in missing]
    return tuple(replace(one, depth=None) if one.depth in missing else one for one in present), missing


def _frame(content: JsonObject, event_camera: Camera) -> Frame:
    content.only("file t_us camera event_camera_from_frame_camera intensity depth".split())
    extrinsic = content.get("event_camera_from_frame_camera")
    if extrinsic is not None:
        rows = isinstance(extrinsic, list) and len(extrinsic) == 4 and all(isinstance(row, list) for row in extrinsic)
        if not rows or not all(len(row) == 4 and all(map(is_number, row)) for row in extrinsic):
            raise content.wrong("event_camera_from_frame_camera", "a 4x4 matrix of numbers")
    if abs(content.integer("t_us")) > _LATEST_US:
        raise content.wrong("t_us", f"microseconds within ±{_LATEST_US}")
    return Frame(
        path=content.file("file", must_exist=False),
        t_us=content.integer("t_us"),
        camera=_camera(content.object("camera")) if content.get("camera") is not None else event_camera,
        event_camera_from_frame_camera=tuple(tuple(map(float, row)) for row in extrinsic or np.eye(4).tolist()),
        intensity=content.choice("intensity", get_args(FrameIntensity)),
        depth=content.optional_file("depth", must_exist=False),
    )
