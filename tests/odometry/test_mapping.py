"""Tracks of a known camera to its motion: by rotation alone, by maps, and by halves that must agree."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ebarf_ns.odometry.bundle import Bundle, adjust
from ebarf_ns.odometry.mapping import Map, halved, mapped
from ebarf_ns.odometry.rotation import turned
from ebarf_ns.odometry.tracks import Tracks
from ebarf_ns.odometry.verdict import agreement, explained
from tests.odometry.worlds import FOCAL_PX, motion, position_error_share, tracks_along_a_wall, tracks_of

KEYFRAMES = 24


def mapped_whole(tracks: Tracks) -> Map:
    rotation = turned(tracks)
    assert rotation is not None
    whole = mapped(tracks, FOCAL_PX, rotation)
    assert whole is not None
    return whole


def test_turns_are_found_and_nothing_strays():
    rotation, _ = motion(KEYFRAMES)
    found = turned(tracks_of(rotation, np.zeros((KEYFRAMES, 3)), noise_px=0.2))
    assert found is not None
    relative = Rotation.from_matrix(found.rotation @ found.rotation[0].T)
    error = (relative * Rotation.from_matrix(rotation @ rotation[0].T).inv()).magnitude()
    assert np.degrees(error).max() < 0.1
    assert np.median(found.stray_rad) * FOCAL_PX < 0.4


def test_neighbours_that_share_nothing_have_no_turn():
    tracks = tracks_of(*motion(KEYFRAMES))
    broken = Tracks(tracks.track + 1000 * (tracks.image >= 12), tracks.image, tracks.plane)
    assert turned(broken) is None


def test_adjustment_takes_poses_and_points_back_to_where_they_were():
    rotation, centre = motion(8)
    tracks = tracks_of(rotation, centre, noise_px=0.0, points=80)
    number = int(tracks.track.max()) + 1
    random = np.random.default_rng(1)
    bundle = Bundle(
        rotation.copy(), centre.copy(), np.zeros((number, 3)), np.tile(np.eye(3), (number, 1, 1)), np.zeros((number, 3))
    )
    for track in range(number):
        rows = np.nonzero(tracks.track == track)[0]
        if len(rows):
            first = tracks.image[rows[0]]
            bundle.anchor[track], bundle.axes[track] = centre[first], rotation[first].T
            bundle.point[track] = *tracks.plane[rows[0]], 0.5
    free = np.arange(8) > 0
    bundle.centre[free] += random.normal(0, 0.01, (7, 3))
    bundle.rotation[free] = Rotation.from_rotvec(random.normal(0, 0.01, (7, 3))).as_matrix() @ bundle.rotation[free]
    adjust(bundle, tracks.image, tracks.track, tracks.plane, free, FOCAL_PX, 5.0, 60)
    assert position_error_share(bundle.centre, centre) < 1e-3
    away = bundle.projected(tracks.image, tracks.track) - tracks.plane
    assert FOCAL_PX * np.abs(away).max() < 0.05


@pytest.mark.parametrize("strays", [0.0, 0.3])
def test_maps_find_the_path_also_where_tracks_leave_their_points(strays: float):
    rotation, centre = motion(KEYFRAMES)
    whole = mapped_whole(tracks_of(rotation, centre, strays=strays))
    assert whole.posed.all()
    assert position_error_share(whole.bundle.centre, centre) < 0.02
    relative = whole.bundle.rotation @ whole.bundle.rotation[0].T
    error = (Rotation.from_matrix(relative) * Rotation.from_matrix(rotation @ rotation[0].T).inv()).magnitude()
    assert np.degrees(error).max() < 1.0


@pytest.mark.parametrize(("speed", "seed"), [(0.08, 1), (0.1, 5)])
def test_a_map_survives_turning_points_in_front_of_a_wall(speed: float, seed: int):
    tracks, centre = tracks_along_a_wall(45, speed, seed)
    whole = mapped_whole(tracks)
    assert whole.posed.all()
    # Started from constant velocity alone, 7 and 5 %.
    assert position_error_share(whole.bundle.centre, centre) < 0.03


def test_a_map_of_two_motions_is_not_taken_for_one():
    """Half of the points are of something that moves by itself."""
    one = tracks_of(*motion(KEYFRAMES), points=250)
    two = tracks_of(*motion(KEYFRAMES, sideways=-0.6, turn_rad=-0.3), points=250, seed=1)
    rows = np.argsort(np.r_[one.image, two.image], kind="stable")
    both = Tracks(
        np.r_[one.track, 1000 + two.track][rows], np.r_[one.image, two.image][rows],
        np.concatenate([one.plane, two.plane])[rows],
    )  # fmt: skip
    rotation = turned(both)
    assert rotation is not None
    whole = mapped(both, FOCAL_PX, rotation)
    assert whole is not None
    inliers = (whole.residuals_px() < 2)[explained(whole, both)[both.image]].mean()
    one_motion = mapped_whole(one)
    assert inliers < 0.72 and (one_motion.residuals_px() < 2).mean() > 0.86


def test_halves_agree_on_a_path_and_say_how_well():
    rotation, centre = motion(KEYFRAMES)
    tracks = tracks_of(rotation, centre, noise_px=0.4)
    whole, one, two = mapped_whole(tracks), mapped_whole(halved(tracks, 0)), mapped_whole(halved(tracks, 1))
    found = agreement(whole, one, two, explained(whole, tracks))
    assert found is not None and len(found.image) == KEYFRAMES
    assert 0 < found.apart < 0.02
    assert (found.position_std >= 0).all() and found.rotation_std_rad.max() < 0.02


def test_halves_that_disagree_are_told_and_the_stretch_where_they_agree_is_kept():
    rotation, centre = motion(KEYFRAMES)
    tracks = tracks_of(rotation, centre)
    whole, one, two = mapped_whole(tracks), mapped_whole(halved(tracks, 0)), mapped_whole(halved(tracks, 1))
    two.bundle.centre[-6:] += 0.5 * np.linalg.norm(np.ptp(two.bundle.centre, axis=0))
    found = agreement(whole, one, two, explained(whole, tracks))
    assert found is not None and found.image.max() < KEYFRAMES - 6
    two.bundle.centre[:] = np.random.default_rng(0).normal(size=two.bundle.centre.shape)
    assert agreement(whole, one, two, explained(whole, tracks)) is None
