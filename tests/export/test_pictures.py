"""Pictures and videos: what is in them, when they were taken, and what is refused."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from ebarf_ns.errors import ExportError
from ebarf_ns.evaluation.frames import read_pixels
from ebarf_ns.export.pictures import picture_times, render
from ebarf_ns.export.settings import RenderSettings
from ebarf_ns.export.views import look, scaled, tone_of
from ebarf_ns.geometry.cameras import Camera
from tests.export.subjects import PINHOLE, RADTAN, KnownRoom

needs_ffmpeg = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="videos need ffmpeg")


def decoded(video: Path) -> list[np.ndarray]:
    capture, frames = cv2.VideoCapture(str(video)), []
    while True:
        there, frame = capture.read()
        if not there:
            return frames
        frames.append(frame[..., 0])


@needs_ffmpeg
def test_a_video_shows_what_is_rendered(known: KnownRoom, tmp_path: Path):
    settings = RenderSettings(fps=10, slow=2, start_us=1_100_000, end_us=1_500_000, height=96)
    count = render(known, settings, tmp_path / "video.mp4")
    frames = decoded(tmp_path / "video.mp4")
    stamps = np.loadtxt(tmp_path / "video_timestamps.txt")
    assert len(frames) == len(stamps) == count == 9
    assert stamps[0] == 1.1 and np.allclose(np.diff(stamps), 0.05)
    tone = tone_of(known, 1_100_000, 1_500_000)
    for frame, stamp in zip(frames, stamps, strict=True):
        expected = tone.grey(look(known, scaled(PINHOLE, 96), round(stamp * 1e6)).brightness).astype(float)
        error = frame.astype(float) - expected
        assert frame.shape == (96, 128) and 10 * np.log10(255**2 / np.mean(error**2)) > 35
    assert cv2.VideoCapture(str(tmp_path / "video.mp4")).get(cv2.CAP_PROP_FPS) == 10


def test_png_pictures_as_event_to_video_tools_write_them(known: KnownRoom, tmp_path: Path):
    render(known, RenderSettings(format="png", fps=1000, end_us=1_003_000), tmp_path / "out")
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == [*(f"frame_{k:010d}.png" for k in range(4)), "timestamps.txt"]
    assert (tmp_path / "out" / "timestamps.txt").read_text() == "1.000000\n1.001000\n1.002000\n1.003000\n"
    picture = cv2.imread(str(tmp_path / "out" / names[0]), cv2.IMREAD_UNCHANGED)
    assert picture.dtype == np.uint8 and picture.shape == (48, 64) and picture.std() > 30


def test_exr_pictures_hold_linear_intensity_and_depth(known: KnownRoom, tmp_path: Path):
    render(known, RenderSettings(format="exr", fps=10, end_us=1_100_000), tmp_path / "out")
    view = look(known, PINHOLE, 1_100_000)
    intensity = read_pixels(tmp_path / "out" / "frame_0000000001.exr")
    depth = read_pixels(tmp_path / "out" / "depth_0000000001.exr")
    assert np.allclose(intensity, np.exp(view.brightness), rtol=1e-5)
    assert np.allclose(depth, view.distance * view.bearing[..., 2], rtol=1e-5) and 0.5 < depth.min() < depth.max() < 5
    # Straight ahead, depth and distance are one; in the corner they are not.
    assert depth[0, 0] < 0.9 * view.distance[0, 0]


@pytest.mark.parametrize("camera", [PINHOLE, RADTAN], ids=lambda camera: camera.model)
def test_another_size_shows_the_same_directions(camera: Camera):
    larger = scaled(camera, 3 * camera.height)
    assert (larger.width, larger.height) == (3 * camera.width, 3 * camera.height)
    # The middle of three pixels is where the one was.
    assert np.allclose(
        larger.bearings(larger.pixel_grid()[1::3, 1::3]), camera.bearings(camera.pixel_grid()), atol=1e-9
    )


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (RenderSettings(format="png", start_us=0), "the requested span is 0 to 2000000 us"),
        (RenderSettings(format="png", start_us=1_500_000, end_us=1_400_000), "increasing times"),
        (RenderSettings(format="png", fps=0), "fps is 0"),
        (RenderSettings(format="png", slow=float("nan")), "slow is nan"),
        (RenderSettings(format="png", fps=1e5, slow=1e3), "at least 1 us apart"),
        (RenderSettings(format="png", height=0), "height is 0"),
        (RenderSettings(), "expected the name of an .mp4 file"),
    ],
)
def test_impossible_wishes_are_said_and_nothing_is_written(
    known: KnownRoom, tmp_path: Path, settings: RenderSettings, words: str
):
    with pytest.raises(ExportError, match=words):
        render(known, settings, tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_times_reach_the_last_moment(known: KnownRoom):
    t_us = picture_times(known, RenderSettings(fps=30))
    assert t_us[0] == 1_000_000 and len(t_us) == 31 and t_us[-1] == 2_000_000 and abs(t_us[1] - 1_033_333) <= 1


def test_one_moment_is_one_picture(known: KnownRoom):
    assert picture_times(known, RenderSettings(start_us=1_500_000, end_us=1_500_000)).tolist() == [1_500_000]
