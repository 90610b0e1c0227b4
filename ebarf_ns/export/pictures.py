"""Pictures and videos along the refined trajectory."""

from __future__ import annotations

import os
import shutil
from typing import TYPE_CHECKING

import numpy as np

from ebarf_ns.errors import ExportError
from ebarf_ns.export.views import Tone, look, scaled, tone_of
from ebarf_ns.files import whole_file, whole_folder, write_picture
from ebarf_ns.geometry.trajectory_file import format_seconds

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from jaxtyping import Int64

    from ebarf_ns.export.settings import RenderSettings, Span
    from ebarf_ns.export.subject import Subject
    from ebarf_ns.geometry.cameras import Camera

_MOST_PICTURES = 1_000_000
FRAME_NAME = "frame_{:010d}"
"""File naming of event-to-video tools."""


def render(
    subject: Subject, settings: RenderSettings, output: Path, progress: Callable[[float], None] = lambda fraction: None
) -> int:
    """Write PNG or EXR pictures with timestamps.txt, or an mp4 with NAME_timestamps.txt; returns the picture count.

    Raises :class:`ExportError` for invalid settings, before anything is rendered.
    """
    t_us = picture_times(subject, settings)
    if settings.height is not None and not 1 <= settings.height <= 1 << 14:
        raise ExportError(f"height is {settings.height}, expected 1 to {1 << 14} rows")
    camera = scaled(subject.camera, settings.height) if settings.height else subject.camera
    if settings.format == "mp4":
        _write_video(subject, camera, t_us, settings, output, progress)
        return len(t_us)
    with whole_folder(output) as folder:
        if settings.format == "png":
            write_pictures(subject, camera, t_us, folder, progress)
        else:
            _write_exr(subject, camera, t_us, folder, progress)
        write_times(folder / "timestamps.txt", t_us)
    return len(t_us)


def span_us(subject: Subject, span: Span) -> tuple[int, int]:
    """Return start and end; raises :class:`ExportError` unless they lie in the span of the refined trajectory."""
    first_us, last_us = subject.trajectory.t_us[[0, -1]].tolist()
    start_us = first_us if span.start_us is None else span.start_us
    end_us = last_us if span.end_us is None else span.end_us
    if not first_us <= start_us <= end_us <= last_us:
        raise ExportError(
            f"the requested span is {start_us} to {end_us} us, expected increasing times within {first_us} to "
            f"{last_us} us, the span of the refined trajectory"
        )
    return start_us, end_us


def picture_times(subject: Subject, settings: RenderSettings) -> Int64[np.ndarray, "pictures"]:
    """Return the times of the pictures; raises :class:`ExportError` for invalid rates."""
    start_us, end_us = span_us(subject, settings)
    for name in ("fps", "slow"):
        if not 0 < getattr(settings, name) < 1e9:
            raise ExportError(f"{name} is {getattr(settings, name)}, expected a number above 0")
    every_us = 1e6 / (settings.fps * settings.slow)
    count = int((end_us - start_us) / every_us + 1e-9) + 1
    if every_us < 1 or count > _MOST_PICTURES:
        raise ExportError(
            f"{settings.fps:g} fps slowed down {settings.slow:g} times give {count:,} pictures {every_us:g} us apart, "
            f"expected at most {_MOST_PICTURES:,}, at least 1 us apart"
        )
    return start_us + (every_us * np.arange(count)).round().astype(np.int64)


def write_times(path: Path, t_us: Int64[np.ndarray, "pictures"]) -> None:
    """Write the times in seconds, one picture per line."""
    path.write_text("".join(f"{format_seconds(one)}\n" for one in t_us.tolist()), encoding="utf-8")


def write_pictures(
    subject: Subject,
    camera: Camera,
    t_us: Int64[np.ndarray, "pictures"],
    folder: Path,
    progress: Callable[[float], None] = lambda fraction: None,
) -> None:
    """Write 8-bit PNGs, grey linear in log brightness, with the same black and white levels for all."""
    tone = _tone(subject, t_us)
    for k, one in enumerate(t_us.tolist()):
        write_picture(folder / f"{FRAME_NAME.format(k)}.png", tone.grey(look(subject, camera, one).brightness))
        progress((k + 1) / len(t_us))


def _write_exr(subject: Subject, camera: Camera, t_us: np.ndarray, folder: Path, progress: Callable) -> None:
    # OpenCV reads this variable when it first handles an image.
    os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")
    import cv2

    for k, one in enumerate(t_us.tolist()):
        view = look(subject, camera, one)
        name = FRAME_NAME.format(k)
        for stem, image in ((name, np.exp(view.brightness)), (name.replace("frame", "depth"), view.depth)):
            try:
                write_picture(folder / f"{stem}.exr", image)
            except cv2.error:
                raise ExportError(f"{stem}.exr cannot be written, expected an OpenCV build with EXR support") from None
        progress((k + 1) / len(t_us))


def _write_video(
    subject: Subject, camera: Camera, t_us: np.ndarray, settings: RenderSettings, output: Path, progress: Callable
) -> None:
    import mediapy

    if output.suffix.lower() != ".mp4":
        raise ExportError(
            f"{output}: a video needs another name, expected the name of an .mp4 file, or --format png or exr"
        )
    if shutil.which("ffmpeg") is None:
        raise ExportError("ffmpeg is not on the path, expected it for videos; --format png works without it")
    tone = _tone(subject, t_us)
    with whole_file(output) as temporary:
        shape = (camera.height, camera.width)
        with mediapy.VideoWriter(temporary, shape, fps=settings.fps, input_format="gray", crf=12) as video:
            for k, one in enumerate(t_us.tolist()):
                video.add_image(tone.grey(look(subject, camera, one).brightness))
                progress((k + 1) / len(t_us))
    with whole_file(output.with_name(f"{output.stem}_timestamps.txt")) as temporary:
        write_times(temporary, t_us)


def _tone(subject: Subject, t_us: np.ndarray) -> Tone:
    return tone_of(subject, int(t_us[0]), int(t_us[-1]))
