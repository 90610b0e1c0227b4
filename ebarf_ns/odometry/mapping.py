"""Mapping of tracks: a map starts where parallax is large, and grows keyframe by keyframe in both directions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from ebarf_ns.odometry.bundle import Bundle, adjust
from ebarf_ns.odometry.rotation import Turned
from ebarf_ns.odometry.tracks import Tracks

if TYPE_CHECKING:
    from jaxtyping import Bool, Float64, Int64

_GAPS = (5, 8, 12, 18, 27)
"""Distances, in keyframes, between the two keyframes that initialize a map."""
_FEWEST_SHARED, _MOST_PAIRS, _AMPLE_PARALLAX_PX = 25, 6, 25.0
_FEWEST_POINTS, _LEAST_INLIER_SHARE, _INLIER_PX = 12, 0.4, 3.0
_LOCAL_KEYFRAMES, _CONTEXT_KEYFRAMES, _WHOLE_INTERVAL, _STRETCH = 8, 30, 12, 120
_ROBUST_PX, _LOOSE_PX, _NUMBERS_PER_TRACK = 0.7, 2.0, 3
_PNP_PX, _FARTHEST_PX = 2.0, 1e6
_DEPTHS = np.array([0.02, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0, 5.0, 8.0])
"""Inverse depths at which a new point is tried, relative to the usual one."""


@dataclass
class Map:
    """Poses of keyframes and points of tracks, indexed as in the tracks."""

    tracks: Tracks
    focal_px: float
    bundle: Bundle
    posed: Bool[np.ndarray, "images"]
    pointed: Bool[np.ndarray, "tracks"]
    used: Bool[np.ndarray, "tracks"]
    """Whether the track exists; spare numbers are reserved for tracks that are split off."""

    def residuals_px(self, rows: Any = slice(None)) -> Float64[np.ndarray, "observations"]:
        """Return the reprojection errors of all or some observations; infinite without a pose or a point."""
        image, track, plane = self.tracks.image[rows], self.tracks.track[rows], self.tracks.plane[rows]
        known = self.posed[image] & self.pointed[track]
        residual = np.full(len(known), np.inf)
        there = self.bundle.projected(image[known], track[known])
        residual[known] = self.focal_px * np.linalg.norm(there - plane[known], axis=1)
        return residual


def mapped(tracks: Tracks, focal_px: float, turned: Turned) -> Map | None:
    """Return the map grown from the best initial pair of keyframes; None if no pair has enough parallax."""
    best: Map | None = None
    for first, last in _initial_pairs(tracks, focal_px, turned):
        initial = _initial_map(tracks, focal_px, turned, first, last)
        if initial is not None and (best is None or _score(initial) > _score(best)):
            best = initial
    if best is None:
        return None
    images = np.nonzero(best.posed)[0]
    for step in (1, -1):
        current = int(images[-1] if step > 0 else images[0])
        while 0 <= current + step < len(best.posed) and _extend(best, current, step):
            current += step
            if current % _WHOLE_INTERVAL == 0:
                _adjust_newest(best, current, step)
    _adjust_whole(best, rounds=40)
    return best


def _initial_pairs(tracks: Tracks, focal_px: float, turned: Turned) -> list[tuple[int, int]]:
    """Return pairs of keyframes with many common tracks and much parallax, the most promising first."""
    count = len(turned.rotation)
    rows = [np.nonzero(tracks.image == image)[0] for image in range(count)]
    found = []
    for first in range(0, count, 3):
        for gap in _GAPS:
            last = first + gap
            if last >= count:
                break
            _, one, two = np.intersect1d(tracks.track[rows[first]], tracks.track[rows[last]], return_indices=True)
            if len(one) < _FEWEST_SHARED:
                break
            relative = turned.rotation[last] @ turned.rotation[first].T
            ray = np.concatenate([tracks.plane[rows[first][one]], np.ones((len(one), 1))], axis=1) @ relative.T
            error = focal_px * np.linalg.norm(ray[:, :2] / ray[:, 2:] - tracks.plane[rows[last][two]], axis=1)
            found.append((min(float(np.median(error)), _AMPLE_PARALLAX_PX) * np.sqrt(len(one)), first, last))
    chosen: list[tuple[int, int]] = []
    for _, first, last in sorted(found, reverse=True):
        if all(abs(first - one) + abs(last - two) > 6 for one, two in chosen):
            chosen.append((first, last))
    return chosen[:_MOST_PAIRS]


def _initial_map(tracks: Tracks, focal_px: float, turned: Turned, first: int, last: int) -> Map | None:
    """Return a map of the keyframes from first to last, from the essential matrix of these two, or None."""
    one, two = (np.nonzero(tracks.image == image)[0] for image in (first, last))
    _, a, b = np.intersect1d(tracks.track[one], tracks.track[two], return_indices=True)
    at_first, at_last = focal_px * tracks.plane[one[a]], focal_px * tracks.plane[two[b]]
    matrix = np.diag([focal_px, focal_px, 1.0])
    essential, inliers = cv2.findEssentialMat(at_first, at_last, matrix, cv2.USAC_MAGSAC, 0.999, 1.5)
    if essential is None or essential.shape != (3, 3):
        return None
    _, rotation, translation, _ = cv2.recoverPose(essential, at_first, at_last, matrix, mask=inliers)
    count, known = len(turned.rotation), int(tracks.track.max()) + 1
    number = _NUMBERS_PER_TRACK * known
    tracks = Tracks(tracks.track.copy(), tracks.image, tracks.plane)
    bundle = Bundle(
        turned.rotation.copy(), np.zeros((count, 3)), np.zeros((number, 3)), np.tile(np.eye(3), (number, 1, 1)),
        np.zeros((number, 3)),
    )  # fmt: skip
    images = np.arange(first, last + 1)
    share = (images - first) / (last - first)
    # The rotations in between are well known; the remaining rotation of the pair is spread evenly over them.
    start = Rotation.from_matrix(turned.rotation[images])
    remaining = (Rotation.from_matrix(rotation @ turned.rotation[first]) * start[-1].inv()).as_rotvec()
    bundle.rotation[images] = (Rotation.from_rotvec(share[:, None] * remaining) * start).as_matrix()
    bundle.centre[images] = share[:, None] * -(bundle.rotation[last].T @ translation[:, 0])
    initial = Map(
        tracks, focal_px, bundle, np.isin(np.arange(count), images), np.zeros(number, bool), np.arange(number) < known
    )
    _add_points(initial, usual=0.2)
    for robust_px in (3.0, _ROBUST_PX):
        _adjust(initial, images[1:], images, robust_px, rounds=25)
    return initial


def _score(initial: Map) -> float:
    """Return the score of an initial map, which grows with its inlier share and its parallax."""
    residual = initial.residuals_px()[initial.posed[initial.tracks.image]]
    images = np.nonzero(initial.posed)[0]
    path = float(np.linalg.norm(initial.bundle.centre[images[-1]] - initial.bundle.centre[images[0]]))
    angle_px = initial.focal_px * path * float(np.median(initial.bundle.point[initial.pointed, 2]))
    return float((residual < _INLIER_PX / 2).mean()) ** 2 * min(angle_px, 2 * _AMPLE_PARALLAX_PX)


def _extend(whole: Map, current: int, step: int) -> bool:
    """Estimate the pose of the next keyframe; returns False if too few of its tracks agree on one."""
    new, bundle, tracks = current + step, whole.bundle, whole.tracks
    rows = np.nonzero((tracks.image == new) & whole.pointed[tracks.track])[0]
    if len(rows) < _FEWEST_POINTS:
        return False
    _estimate_pose(whole, rows, current, step)
    whole.posed[new] = True
    recent, context = (_posed_before(whole, new, step, count) for count in (_LOCAL_KEYFRAMES, _CONTEXT_KEYFRAMES))
    # This keyframe may be the first to determine the depth of a point, so outliers are rejected only afterwards.
    _adjust(whole, recent, context, _LOOSE_PX, rounds=5)
    good = whole.residuals_px(rows) < _INLIER_PX
    if good.sum() < _FEWEST_POINTS or good.mean() < _LEAST_INLIER_SHARE:
        whole.posed[new] = False
        return False
    _split(whole, rows[~good], step)
    _add_points(whole, usual=float(np.median(bundle.point[tracks.track[rows], 2])))
    _adjust(whole, recent, context, _ROBUST_PX, rounds=4)
    return True


def _estimate_pose(whole: Map, rows: Int64[np.ndarray, "rows"], current: int, step: int) -> None:
    """Set the pose of the next keyframe from these observations: the better of two, from two starting poses.

    Constant velocity alone is a poor start where the motion turns: a planar part of the scene then holds the pose in a
    local minimum, and the map breaks. Perspective-n-point needs no start, but some of the points to be accurate.
    """
    new, bundle, tracks = current + step, whole.bundle, whole.tracks
    image, track, plane = tracks.image[rows], tracks.track[rows], tracks.plane[rows]
    only_new = np.arange(len(whole.posed)) == new
    best = np.inf
    for rotation, centre in _starting_poses(whole, rows, current, step):
        before = bundle.rotation[new].copy(), bundle.centre[new].copy()
        bundle.rotation[new], bundle.centre[new] = rotation, centre
        for robust_px in (4.0, 1.0):
            adjust(bundle, image, track, plane, only_new, whole.focal_px, robust_px, 15, points_too=False)
        error_px = whole.focal_px * np.linalg.norm(bundle.projected(image, track) - plane, axis=1)
        cost = float(np.log1p(np.minimum(error_px, _FARTHEST_PX) ** 2).sum())
        if cost < best:
            best = cost
        else:
            bundle.rotation[new], bundle.centre[new] = before


def _starting_poses(
    whole: Map, rows: Int64[np.ndarray, "rows"], current: int, step: int
) -> list[tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]]:
    """Return rotations and centres to start from: by constant velocity, and by perspective-n-point if it succeeds."""
    bundle, previous = whole.bundle, current - step
    rotation, centre = bundle.rotation[current], bundle.centre[current]
    starts = [(rotation, centre)]
    if 0 <= previous < len(whole.posed) and whole.posed[previous]:
        starts = [(rotation @ bundle.rotation[previous].T @ rotation, 2 * centre - bundle.centre[previous])]
    points = bundle.positions()[whole.tracks.track[rows]] - centre
    found, turn, shift, _ = cv2.solvePnPRansac(
        points, whole.focal_px * whole.tracks.plane[rows], np.diag([whole.focal_px, whole.focal_px, 1.0]), np.zeros(4),
        iterationsCount=200, reprojectionError=_PNP_PX, confidence=0.999, flags=cv2.SOLVEPNP_SQPNP,
    )  # fmt: skip
    if found and np.isfinite([turn, shift]).all():
        rotation = Rotation.from_rotvec(turn[:, 0]).as_matrix()
        starts.append((rotation, centre - rotation.T @ shift[:, 0]))
    return starts


def _posed_before(whole: Map, last: int, step: int, count: int) -> Int64[np.ndarray, "images"]:
    """Return up to ``count`` keyframes with poses, from the last one backwards."""
    images = np.arange(last, last - step * count, -step)
    images = images[(images >= 0) & (images < len(whole.posed))]
    return images[whole.posed[images]]


def _split(whole: Map, rows: Int64[np.ndarray, "rows"], step: int) -> None:
    """Split tracks at these observations, where they no longer follow their points."""
    tracks = whole.tracks
    unused = np.nonzero(~whole.used)[0][: len(rows)]
    for row, fresh in zip(rows[: len(unused)], unused, strict=True):
        onward = (tracks.image - tracks.image[row]) * step >= 0
        tracks.track[onward & (tracks.track == tracks.track[row])] = fresh
    whole.used[unused] = True


def _add_points(whole: Map, usual: float) -> None:
    """Add points for tracks with observations in three posed keyframes, at the depth with the smallest error."""
    tracks, bundle = whole.tracks, whole.bundle
    wanted = whole.posed[tracks.image] & ~whole.pointed[tracks.track]
    long = np.bincount(tracks.track[wanted], minlength=len(whole.pointed)) >= 3
    rows = np.nonzero(wanted & long[tracks.track])[0]
    if not len(rows):
        return
    new, first, row_point = np.unique(tracks.track[rows], return_index=True, return_inverse=True)
    seen = tracks.image[rows[first]]
    bundle.anchor[new] = bundle.centre[seen]
    bundle.axes[new] = bundle.rotation[seen].transpose(0, 2, 1)
    bundle.point[new, :2] = tracks.plane[rows[first]]
    costs = []
    for inverse in usual * _DEPTHS:
        bundle.point[new, 2] = inverse
        error = bundle.projected(tracks.image[rows], tracks.track[rows]) - tracks.plane[rows]
        squared = np.minimum((whole.focal_px * error) ** 2, 1e4).sum(axis=1)
        costs.append(np.bincount(row_point, np.log1p(squared)))
    bundle.point[new, 2] = usual * _DEPTHS[np.argmin(costs, axis=0)]
    whole.pointed[new] = True


def _adjust_newest(whole: Map, current: int, step: int) -> None:
    """Adjust the newest stretch of a growing map, so that time grows linearly; the map before it is fixed."""
    newest = _posed_before(whole, current, step, _STRETCH)
    free = newest[: -_STRETCH // 3] if len(newest) < whole.posed.sum() else np.sort(newest)[1:]
    _adjust(whole, free, newest, _ROBUST_PX, rounds=6)


def _adjust_whole(whole: Map, rounds: int) -> None:
    """Adjust all keyframes; long recordings in stretches, each fixed at the last third of the previous one."""
    images = np.nonzero(whole.posed)[0]
    if len(images) <= _STRETCH:
        _adjust(whole, images[1:], images, _ROBUST_PX, rounds)
        return
    for start_at in range(0, len(images) - _STRETCH // 3, _STRETCH * 2 // 3):
        stretch = images[start_at : start_at + _STRETCH]
        _adjust(whole, stretch[_STRETCH // 3 if start_at else 1 :], stretch, _ROBUST_PX, rounds)


def _adjust(
    whole: Map,
    free_images: Int64[np.ndarray, "free"],
    observers: Int64[np.ndarray, "observers"],
    robust_px: float,
    rounds: int,
) -> None:
    """Adjust some keyframes and the points observed in them, using the observations of further keyframes too."""
    tracks = whole.tracks
    free = np.isin(np.arange(len(whole.posed)), free_images)
    used = np.isin(np.arange(len(whole.posed)), observers)
    visible = np.zeros(len(whole.pointed), bool)
    visible[tracks.track[free[tracks.image]]] = True
    rows = np.nonzero(used[tracks.image] & (visible & whole.pointed)[tracks.track])[0]
    adjust(
        whole.bundle,
        tracks.image[rows],
        tracks.track[rows],
        tracks.plane[rows],
        free,
        whole.focal_px,
        robust_px,
        rounds,
    )


def halved(tracks: Tracks, which: int) -> Tracks:
    """Return the tracks with even (0) or odd (1) numbers."""
    return tracks.select(tracks.track % 2 == which)
