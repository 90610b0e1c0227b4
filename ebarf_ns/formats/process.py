"""Convert foreign recordings to scene folders; sources are never changed, and everything left out is counted."""

from __future__ import annotations

import tempfile
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

import cv2
import numpy as np
import torch

from ebarf_ns.errors import SceneError, did_you_mean
from ebarf_ns.evaluation.compare import read_beside_reference
from ebarf_ns.evaluation.polarity import polarity_contradicted, polarity_correlations
from ebarf_ns.files import read_picture, whole_folder, write_picture
from ebarf_ns.formats.calibration import Size, camera_notes, read_calibration
from ebarf_ns.formats.intake import Intake, hot_pixels, take_in
from ebarf_ns.formats.layouts import LAYOUTS, FrameFile, Given, Ingredients, Layout, recognised_layout
from ebarf_ns.formats.recognise import RecordingFormat, open_recording, recognised, recognised_folder
from ebarf_ns.formats.source import Source, TimeUnit
from ebarf_ns.formats.trajectory_beside_events import apart, clipped, doubts, outside
from ebarf_ns.formats.trajectory_formats import TrajectoryFormat, read_trajectory
from ebarf_ns.geometry.cameras import Camera, Crop, cropped
from ebarf_ns.geometry.so3 import rotate
from ebarf_ns.geometry.trajectory import Trajectory
from ebarf_ns.geometry.trajectory_file import write_tum
from ebarf_ns.geometry.trajectory_jumps import torn
from ebarf_ns.scene import ContrastThreshold, Frame, Scene, write_scene

Bounds = tuple[tuple[float, float, float], tuple[float, float, float]]
Format = Literal[
    "auto", "ecd", "tumvie", "eds", "esim", "robust-e-nerf", "hdf5", "aedat4", "bag", "raw", "dat", "npz", "npy", "mat",
    "text",
]  # fmt: skip


@dataclass(frozen=True)
class ProcessSettings:
    """Scene settings that the source does not provide."""

    trajectory: Path | None = None
    """Initial keyframe poses; by default the reference."""
    trajectory_format: TrajectoryFormat = field(default_factory=TrajectoryFormat)
    """Conventions of that file, if it does not give them; without --trajectory, those of the reference."""
    groundtruth: Path | None = None
    """Reference poses of the event camera, on its clock, if the dataset's folder has none."""
    camera: Path | None = None
    """A calibration file that replaces the one in the dataset's folder."""
    camera_name: str | None = None
    """Which camera of that file; not needed for TUM-VIE's event cameras."""
    sensor_size: tuple[int, int] | None = None
    """Columns and rows, if given by neither recording nor calibration."""
    contrast_threshold: tuple[float, float] | None = None
    """ON and OFF thresholds, if known."""
    part: str | None = None
    """The group of an HDF5 file, the topic of a bag or the array of an npz or mat file with the events, if there are
    several; left or right for TUM-VIE."""
    event_time_unit: TimeUnit | None = None
    """Unit of event times in text, HDF5, npz, npy and mat files, if they do not give it."""
    event_columns: str | None = None
    """Order of unnamed columns in such files, such as 'x y p t'; by default inferred from their values."""
    events: Intake = field(default_factory=Intake)
    """Filters and repairs of events."""
    bounds: Bounds | None = None
    """Lower and upper corner of the scene in the trajectory's unit, if known."""
    farthest: float | None = None
    """Set bounds that contain everything in view up to this distance, in the trajectory's unit."""
    frames: bool = True
    """Import the dataset's frames."""


def process(
    format: Format,
    source: Path,
    output: Path,
    settings: ProcessSettings,
    progress: Callable[[int], None] = lambda events: None,
) -> list[str]:
    """Make a scene folder; returns notes on what was read, recognised, repaired and left out.

    Raises one of the package's errors, in which case no folder is written.
    """
    _check(settings)
    with _unpacked(source) as unpacked:
        ingredients = _ingredients(format, unpacked, settings)
        with whole_folder(output) as folder:
            return _assemble(ingredients, settings, folder, progress)


def _check(settings: ProcessSettings) -> None:
    """Raise :class:`SceneError` for impossible numbers before anything is read."""
    on, off = settings.contrast_threshold or (None, None)
    numbers = {"--contrast-threshold ON": on, "--contrast-threshold OFF": off, "--farthest": settings.farthest}
    for flag, value in numbers.items():
        if value is not None and not 0 < value < np.inf:
            raise SceneError(f"{flag} is {value}, expected a finite number above 0")
    if settings.bounds and not (np.isfinite(settings.bounds).all() and np.less(*settings.bounds).all()):
        raise SceneError(f"--bounds is {settings.bounds}, expected a first corner below the second on every axis")


@contextmanager
def _unpacked(source: Path) -> Iterator[Path]:
    """The source, unpacked if it is a zip file of a dataset."""
    if source.suffix != ".zip" or not source.exists():
        yield source
        return
    with tempfile.TemporaryDirectory() as folder:
        try:
            with zipfile.ZipFile(source) as archive:
                archive.extractall(folder)
        except (OSError, zipfile.BadZipFile, zlib.error, RuntimeError, NotImplementedError) as error:
            raise SceneError(f"{source}: not a whole zip file that can be opened ({error})") from None
        # Some systems add metadata next to the dataset's folder.
        inside = [one for one in Path(folder).iterdir() if one.name != "__MACOSX" and not one.name.startswith(".")]
        yield inside[0] if len(inside) == 1 and inside[0].is_dir() else Path(folder)


def _ingredients(format: Format, source: Path, settings: ProcessSettings) -> Ingredients:
    if not source.exists():
        raise SceneError(f"{source}: no such file or folder, expected a recording{did_you_mean(source)}")
    if format == "auto" and (source / "scene.json").is_file() and not settings.camera:
        raise SceneError(
            f"{source}: a scene folder already, train with: ebarf train {source}; to make another scene of its "
            f"recording, give its calibration too: --camera {source}/scene.json"
        )
    layout = _layout(format, source)
    if layout:
        if not source.is_dir():
            raise SceneError(f"{source}: a file, expected the folder of a {layout} recording")
        if settings.event_columns:
            raise SceneError(
                f"{source}: {layout} knows its columns, expected no --event-columns, or the recording's file"
            )
        given = Given(settings.camera, settings.sensor_size, settings.part, settings.frames, settings.event_time_unit)
        return LAYOUTS[layout](source, given)
    known: RecordingFormat | None = format if format in get_args(RecordingFormat) else None  # pyright: ignore[reportAssignmentType]
    known = known or recognised(source)
    opened = lambda: open_recording(source, known, settings.part, settings.event_time_unit, settings.event_columns)  # noqa: E731
    left_out: Counter[str] = Counter()
    frames = _frames_within(source, known, opened, settings.part, left_out) if settings.frames else ()
    return Ingredients(opened, frames=frames, frames_left_out=left_out)


def _layout(format: Format, source: Path) -> Layout | None:
    """The dataset layout of a folder; None for a bag or a folder with only event files."""
    if format in LAYOUTS:
        return format  # pyright: ignore[reportReturnType]
    if format != "auto" or not source.is_dir() or (source / "metadata.yaml").is_file():
        return None
    try:
        return recognised_layout(source)
    except SceneError:
        if recognised_folder(source):
            return None
        raise


def _frames_within(
    source: Path, format: RecordingFormat, opened: Callable[[], Source], part: str | None, left_out: Counter[str]
) -> Iterator[FrameFile]:
    """Frames that a DAVIS takes with the same pixels as its events."""
    if format == "aedat4":
        from ebarf_ns.formats.readers.aedat4 import read_aedat4_frames

        pictures = read_aedat4_frames(source)
    elif format == "bag":
        from ebarf_ns.formats.readers.bags import read_bag_frames

        pictures = read_bag_frames(source, opened().sensor_size or (0, 0), part, left_out)
    else:
        return
    for t_us, picture in pictures:
        yield FrameFile(_grey(picture), t_us, None, np.eye(4), "linear")


def _grey(picture: np.ndarray) -> np.ndarray:
    """Grey image from grey, BGR or BGRA."""
    channels = 1 if picture.ndim == 2 else picture.shape[2]
    if channels == 1:
        return picture.reshape(picture.shape[:2])
    return cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY if channels == 3 else cv2.COLOR_BGRA2GRAY)


def _assemble(
    ingredients: Ingredients, settings: ProcessSettings, folder: Path, progress: Callable[[int], None]
) -> list[str]:
    source = ingredients.open_events()
    camera, notes = _camera(ingredients, settings, source.sensor_size)
    size, intake = (camera.width, camera.height), settings.events
    whole = camera
    if intake.crop:
        left, top, right, bottom = intake.crop
        if not (0 <= left < right <= camera.width and 0 <= top < bottom <= camera.height):
            raise SceneError(
                f"--crop is {left} {top} {right} {bottom}, expected X0 Y0 X1 Y1 with 0 <= X0 < X1 <= {camera.width} "
                f"and 0 <= Y0 < Y1 <= {camera.height}"
            )
        camera = cropped(camera, intake.crop)
    hot = hot_pixels(source, size, intake, intake.hot_pixels) if intake.hot_pixels is not None else None
    source = ingredients.open_events() if hot is not None else source
    report = take_in(source, size, intake, folder / "events.h5", hot, progress)
    span_us = report.first_us, report.last_us
    groundtruth = ingredients.groundtruth
    if settings.groundtruth:
        known = settings.trajectory_format
        # With --trajectory, the format flags apply to that file, except --pose-times, for files without times.
        known = TrajectoryFormat(pose_times=known.pose_times) if settings.trajectory else known
        groundtruth, said = read_trajectory(settings.groundtruth, known, span_us)
        notes += said
    initial = groundtruth
    if settings.trajectory:
        initial, said = _initial(settings.trajectory, settings.trajectory_format, groundtruth, span_us)
        notes += said
    if initial is None:
        notes.append("no trajectory: training estimates one from the events, as does ebarf trajectory estimate")
    else:
        notes += doubts(source, span_us, initial, intake.time_offset_us)
        # With a time window or a given unit of event times, a mismatch is only a note.
        intended = intake.start_us is not None or intake.end_us is not None or settings.event_time_unit is not None
        notes += apart(initial, span_us, settings.trajectory or source.path, intended)
        initial = clipped(initial, span_us, settings.trajectory or source.path)
        notes += outside(folder / "events.h5", initial)
        notes += [f"trajectory.txt: {sentence}" for sentence in torn(initial)]
        write_tum(folder / "trajectory.txt", initial)
    if groundtruth is not None:
        groundtruth = clipped(groundtruth, span_us, settings.groundtruth or source.path)
        write_tum(folder / "groundtruth.txt", groundtruth)
    threshold = ContrastThreshold(*settings.contrast_threshold) if settings.contrast_threshold else None
    frames, seen, within, left_out = [], 0, 0, ingredients.frames_left_out
    for frame in ingredients.frames if settings.frames else ():
        frame = replace(frame, t_us=frame.t_us + intake.time_offset_us)  # noqa: PLW2901
        if span_us[0] <= frame.t_us <= span_us[1]:
            within += 1
            copied = _copied_frame(frame, f"{seen:06d}", whole, intake.crop, folder)
            if isinstance(copied, Frame):
                frames.append(copied)
            else:
                left_out[copied] += 1
        seen += 1
    notes += [f"left out: {count:,} frame{'s' * (count > 1)} of {why}" for why, count in left_out.items()]
    scene = Scene(
        folder=folder,
        events=folder / "events.h5",
        trajectory=folder / "trajectory.txt",
        camera=camera,
        groundtruth=folder / "groundtruth.txt" if groundtruth is not None else None,
        frames=tuple(frames),
        contrast_threshold=threshold or ingredients.contrast_threshold,
        bounds=settings.bounds
        or (_seen(initial, camera, settings.farthest) if settings.farthest and initial is not None else None),
    )
    write_scene(scene)
    contradicted = polarity_contradicted(polarity_correlations(scene))
    notes += [f"suspicious: {contradicted}"] if contradicted else []
    imported = "" if len(frames) == within else f", {len(frames)} imported"
    of_frames = f"{within} of {seen} frames within their span{imported}" if seen else "no frames"
    notes.append(f"{len(initial.t_us) if initial else 'no'} keyframes around the events, {of_frames}")
    return report.sentences() + notes


def _camera(ingredients: Ingredients, settings: ProcessSettings, said: Size | None) -> tuple[Camera, list[str]]:
    camera, notes = ingredients.camera, list(ingredients.notes)
    if settings.camera and camera is None:
        calibrated = read_calibration(
            settings.camera, settings.camera_name, settings.sensor_size or said or ingredients.sensor_size
        )
        camera, notes = calibrated.camera, [*notes, *calibrated.notes]
    if camera is None:
        raise SceneError(
            "no calibration with the recording, expected --camera with a file that has one: of kalibr, ROS, OpenCV, "
            "EuRoC, VINS, ORB-SLAM, DV, basalt, a scene.json, or a line of fx fy cx cy and distortion"
        )
    if said is not None and said != (camera.width, camera.height):
        raise SceneError(
            f"the recording gives a sensor size of {said[0]} x {said[1]} pixels, the calibration {camera.width} x "
            f"{camera.height}; expected both to be of one camera"
        )
    return camera, camera_notes(camera) + notes


def _initial(
    path: Path, known: TrajectoryFormat, groundtruth: Trajectory | None, span_us: tuple[int, int]
) -> tuple[Trajectory, list[str]]:
    """Read the initial trajectory; a quaternion order that the file does not give is inferred from the reference."""
    if groundtruth is None:
        return read_trajectory(path, known, span_us)
    return read_beside_reference(path, groundtruth, known, span_us)


def _seen(trajectory: Trajectory, camera: Camera, farthest: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Corners of a box around the cameras and everything in view up to a distance."""
    corners = torch.tensor(
        [
            [x, y]
            for x in (0, (camera.width - 1) / 2, camera.width - 1)
            for y in (0, (camera.height - 1) / 2, camera.height - 1)
        ]
    )
    bearings = camera.bearings(corners)
    position, quat_wxyz = trajectory.poses
    ends = position[:, None] + farthest * rotate(quat_wxyz[:, None], bearings[None].to(position))
    points = torch.cat([position, ends.flatten(0, 1)])
    return tuple(points.amin(0).tolist()), tuple(points.amax(0).tolist())


def _copied_frame(frame: FrameFile, name: str, camera: Camera, crop: Crop | None, folder: Path) -> Frame | str:
    """Copy a frame, a PNG unchanged; returns the reason if its size does not match its camera.

    Frames of the event camera are cropped with it.
    """
    crop = crop if frame.camera is None else None
    picture = frame.picture
    name = picture.stem if isinstance(picture, Path) else name
    is_png = isinstance(picture, Path) and picture.suffix.lower() == ".png"
    flag = cv2.IMREAD_UNCHANGED if is_png else cv2.IMREAD_GRAYSCALE
    image = read_picture(picture, flag) if isinstance(picture, Path) else picture
    if image is None:
        raise SceneError(f"{picture}: cannot be read as an image, expected one, or --no-frames")
    size, of = image.shape[1::-1], frame.camera or camera
    if size != (of.width, of.height):
        return f"{size[0]} x {size[1]} pixels, expected their camera's {of.width} x {of.height}"
    if crop:
        of = cropped(of, crop)
        image = image[crop[1] : crop[3], crop[0] : crop[2]]
    path = folder / "frames" / f"{name}.png"
    path.parent.mkdir(exist_ok=True)
    if is_png and crop is None:
        path.write_bytes(Path(picture).read_bytes())  # pyright: ignore[reportArgumentType]
    else:
        write_picture(path, image)
    extrinsic = tuple(map(tuple, np.asarray(frame.event_camera_from_frame_camera, float).tolist()))
    return Frame(path, frame.t_us, of, extrinsic, frame.intensity)
