"""Event images without delay, clocks that follow the motion, and features followed to a fraction of a pixel."""

from pathlib import Path

import cv2
import numpy as np

from ebarf_ns.odometry.event_images import event_images
from ebarf_ns.odometry.pace import paced
from ebarf_ns.odometry.tracks import followed
from tests.odometry.worlds import CAMERA, FOCAL_PX, moving_squares, noise, recorded


def test_images_show_a_moving_square_where_it_is_from_the_first_moment_on(tmp_path: Path):
    file = recorded(tmp_path / "events.h5", moving_squares([(40, 60, 100, 0, 20)]))
    pace, hot = paced(file)
    t_us = np.linspace(*file.span()[1:], 9).astype(np.int64)
    images = np.stack(list(event_images(file, pace, t_us, 0.05, 1.0, hot))).astype(float)
    busy = np.abs(images - 127.5)
    for t, picture in zip(t_us, busy, strict=True):
        columns = np.nonzero(picture[45:75].max(axis=0) > 60)[0]
        assert abs(columns.mean() - (40 + 100e-6 * t)) < 4, t


def test_the_clock_runs_with_the_events(tmp_path: Path):
    quick = noise(40_000, 500_000)
    slow = noise(8_000, 500_000)
    both = type(quick)(*(np.concatenate([getattr(quick, n), getattr(slow, n)]) for n in ("x", "y")),
                       np.r_[quick.t_us, slow.t_us + 500_000], np.r_[quick.polarity, slow.polarity])  # fmt: skip
    pace, hot = paced(recorded(tmp_path / "events.h5", both))
    assert not hot.any()
    at = pace.at(np.array([0, 250_000, 500_000, 750_000, 1_000_000]))
    assert at[1] - at[0] > 2 * (at[3] - at[2])
    assert abs(at[-1] - 1.0) < 1e-3
    back_us = pace.when_us(pace.at(np.array([123_456, 654_321])))
    assert np.abs(back_us - [123_456, 654_321]).max() <= 2


def test_features_follow_a_picture_that_shifts():
    random = np.random.default_rng(0)
    large = cv2.GaussianBlur(random.uniform(0, 255, (200, 260)).astype(np.float32), (0, 0), 2.0)
    large = cv2.normalize(large, None, 0, 255, cv2.NORM_MINMAX)
    speed = np.array([1.3, -0.7])
    pictures = [
        cv2.warpAffine(large, np.array([[1, 0, -40 + k * speed[0]], [0, 1, -40 + k * speed[1]]]), (160, 120)).astype(
            np.uint8
        )
        for k in range(17)
    ]
    tracks = followed(pictures, CAMERA, 4)
    whole = np.nonzero(tracks.lengths() == 5)[0]
    assert len(whole) > 60
    first, last = (
        tracks.plane[(tracks.image == k) & np.isin(tracks.track, whole)][
            np.argsort(tracks.track[(tracks.image == k) & np.isin(tracks.track, whole)])
        ]
        for k in (0, 4)
    )
    away_px = FOCAL_PX * (last - first) - 16 * speed
    assert np.median(np.abs(away_px)) < 0.1
    assert np.quantile(np.abs(away_px), 0.95) < 0.5


def test_pictures_of_nothing_have_no_tracks():
    tracks = followed([np.full((120, 160), 127, np.uint8)] * 9, CAMERA, 4)
    assert not len(tracks.track)
