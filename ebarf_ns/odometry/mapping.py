"""A map of tracks: begun where parallax is large, extended keyframe by keyframe to both sides, adjusted all the way."""

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
"""How far apart the two keyframes are that a map begins with."""
_FEWEST_SHARED, _TRIED, _ENOUGH_PX = 25, 6, 25.0
_FEWEST_SEEN, _LEAST_SHARE, _INLIER_PX = 12, 0.4, 3.0
_LOCAL, _BEHIND, _WHOLE_EVERY, _STRETCH = 8, 30, 12, 120
_ROBUST_PX, _LOOSE_PX, _SPARE = 0.7, 2.0, 3
_DEPTHS = np.array([0.02, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0, 5.0, 8.0])
"""Inverse depths over the usual one that a new point is tried at."""


@dataclass
class Map:
    """Keyframes with a pose, and tracks with a point; numbers are those of the tracks."""

    tracks: Tracks
    focal_px: float
    bundle: Bundle
    posed: Bool[np.ndarray, "images"]
    pointed: Bool[np.ndarray, "tracks"]
    used: Bool[np.ndarray, "tracks"]
    """Whether there is such a track; some numbers are left for those that are split."""

    def residuals_px(self, rows: Any = slice(None)) -> Float64[np.ndarray, "observations"]:
        """Distances between observations, all or some, and their points; infinite without pose or point."""
        image, track, plane = self.tracks.image[rows], self.tracks.track[rows], self.tracks.plane[rows]
        known = self.posed[image] & self.pointed[track]
        residual = np.full(len(known), np.inf)
        there = self.bundle.projected(image[known], track[known])
        residual[known] = self.focal_px * np.linalg.norm(there - plane[known], axis=1)
        return residual


def mapped(tracks: Tracks, focal_px: float, turned: Turned) -> Map | None:
    """The map that reaches furthest from the best beginning; None where nothing has parallax enough to begin."""
    best: Map | None = None
    for first, last in _beginnings(tracks, focal_px, turned):
        begun = _begun(tracks, focal_px, turned, first, last)
        if begun is not None and (best is None or _score(begun) > _score(best)):
            best = begun
    if best is None:
        return None
    images = np.nonzero(best.posed)[0]
    for step in (1, -1):
        at = int(images[-1] if step > 0 else images[0])
        while 0 <= at + step < len(best.posed) and _extended(best, at, step):
            at += step
            if at % _WHOLE_EVERY == 0:
                _adjust_whole(best, rounds=6)
    _adjust_whole(best, rounds=40)
    return best


def _beginnings(tracks: Tracks, focal_px: float, turned: Turned) -> list[tuple[int, int]]:
    """Pairs of keyframes with many shared tracks that rotation alone leaves apart, the most promising first."""
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
            away = focal_px * np.linalg.norm(ray[:, :2] / ray[:, 2:] - tracks.plane[rows[last][two]], axis=1)
            found.append((min(float(np.median(away)), _ENOUGH_PX) * np.sqrt(len(one)), first, last))
    chosen: list[tuple[int, int]] = []
    for _, first, last in sorted(found, reverse=True):
        if all(abs(first - one) + abs(last - two) > 6 for one, two in chosen):
            chosen.append((first, last))
    return chosen[:_TRIED]


def _begun(tracks: Tracks, focal_px: float, turned: Turned, first: int, last: int) -> Map | None:
    """A map of the keyframes between two, from the essential matrix of these."""
    one, two = (np.nonzero(tracks.image == image)[0] for image in (first, last))
    _, a, b = np.intersect1d(tracks.track[one], tracks.track[two], return_indices=True)
    pixels = [focal_px * tracks.plane[rows] for rows in (one[a], two[b])]
    matrix = np.diag([focal_px, focal_px, 1.0])
    essential, inliers = cv2.findEssentialMat(*pixels, matrix, cv2.USAC_MAGSAC, 0.999, 1.5)
    if essential is None or essential.shape != (3, 3):
        return None
    _, rotation, translation, _ = cv2.recoverPose(essential, *pixels, matrix, mask=inliers)
    count, known = len(turned.rotation), int(tracks.track.max()) + 1
    number = _SPARE * known
    tracks = Tracks(tracks.track.copy(), tracks.image, tracks.plane)
    bundle = Bundle(
        turned.rotation.copy(), np.zeros((count, 3)), np.zeros((number, 3)), np.tile(np.eye(3), (number, 1, 1)),
        np.zeros((number, 3)),
    )  # fmt: skip
    images = np.arange(first, last + 1)
    share = (images - first) / (last - first)
    # The turns on the way are known well, and the rest of that of the pair is spread over them.
    start = Rotation.from_matrix(turned.rotation[images])
    rest = (Rotation.from_matrix(rotation @ turned.rotation[first]) * start[-1].inv()).as_rotvec()
    bundle.rotation[images] = (Rotation.from_rotvec(share[:, None] * rest) * start).as_matrix()
    bundle.centre[images] = share[:, None] * -(bundle.rotation[last].T @ translation[:, 0])
    begun = Map(
        tracks, focal_px, bundle, np.isin(np.arange(count), images), np.zeros(number, bool), np.arange(number) < known
    )
    _add_points(begun, usual=0.2)
    for robust_px in (3.0, _ROBUST_PX):
        _adjust(begun, images[1:], images, robust_px, rounds=25)
    return begun


def _score(begun: Map) -> float:
    """Inliers' share, lessened where the whole has little parallax."""
    residual = begun.residuals_px()[begun.posed[begun.tracks.image]]
    images = np.nonzero(begun.posed)[0]
    path = np.linalg.norm(begun.bundle.centre[images[-1]] - begun.bundle.centre[images[0]])
    angle_px = begun.focal_px * path * float(np.median(begun.bundle.point[begun.pointed, 2]))
    return float((residual < _INLIER_PX / 2).mean()) ** 2 * min(angle_px, 2 * _ENOUGH_PX)


def _extended(whole: Map, at: int, step: int) -> bool:
    """Give the keyframe beside the last one a pose, if enough of its tracks agree on one."""
    new, bundle, tracks = at + step, whole.bundle, whole.tracks
    rows = np.nonzero((tracks.image == new) & whole.pointed[tracks.track])[0]
    if len(rows) < _FEWEST_SEEN:
        return False
    before = at - step
    going = whole.posed[before] if 0 <= before < len(whole.posed) else False
    turn = bundle.rotation[at] @ bundle.rotation[before].T if going else np.eye(3)
    bundle.rotation[new] = turn @ bundle.rotation[at]
    bundle.centre[new] = 2 * bundle.centre[at] - bundle.centre[before] if going else bundle.centre[at]
    alone = np.arange(len(whole.posed)) == new
    for robust_px in (4.0, 1.0):
        adjust(
            bundle, tracks.image[rows], tracks.track[rows], tracks.plane[rows], alone, whole.focal_px, robust_px, 15,
            points_too=False,
        )  # fmt: skip
    whole.posed[new] = True
    recent, around = (_posed(whole, new, step, count) for count in (_LOCAL, _BEHIND))
    # Points whose depth nothing told so far learn it from this keyframe: they are no outliers before that.
    _adjust(whole, recent, around, _LOOSE_PX, rounds=5)
    good = whole.residuals_px(rows) < _INLIER_PX
    if good.sum() < _FEWEST_SEEN or good.mean() < _LEAST_SHARE:
        whole.posed[new] = False
        return False
    _split(whole, rows[~good], step)
    _add_points(whole, usual=float(np.median(bundle.point[tracks.track[rows], 2])))
    _adjust(whole, recent, around, _ROBUST_PX, rounds=4)
    return True


def _posed(whole: Map, last: int, step: int, count: int) -> Int64[np.ndarray, "images"]:
    """Some keyframes with poses up to one of them."""
    images = np.arange(last, last - step * count, -step)
    images = images[(images >= 0) & (images < len(whole.posed))]
    return images[whole.posed[images]]


def _split(whole: Map, rows: Int64[np.ndarray, "rows"], step: int) -> None:
    """Let tracks that have left their points be other tracks from these observations on."""
    tracks = whole.tracks
    unused = np.nonzero(~whole.used)[0][: len(rows)]
    for row, fresh in zip(rows[: len(unused)], unused, strict=True):
        onward = (tracks.image - tracks.image[row]) * step >= 0
        tracks.track[onward & (tracks.track == tracks.track[row])] = fresh
    whole.used[unused] = True


def _add_points(whole: Map, usual: float) -> None:
    """Points for tracks that three keyframes with poses see, at the depth that suits them best."""
    tracks, bundle = whole.tracks, whole.bundle
    wanted = whole.posed[tracks.image] & ~whole.pointed[tracks.track]
    often = np.bincount(tracks.track[wanted], minlength=len(whole.pointed)) >= 3
    rows = np.nonzero(wanted & often[tracks.track])[0]
    if not len(rows):
        return
    new, first, own = np.unique(tracks.track[rows], return_index=True, return_inverse=True)
    seen = tracks.image[rows[first]]
    bundle.anchor[new] = bundle.centre[seen]
    bundle.axes[new] = bundle.rotation[seen].transpose(0, 2, 1)
    bundle.point[new, :2] = tracks.plane[rows[first]]
    costs = []
    for inverse in usual * _DEPTHS:
        bundle.point[new, 2] = inverse
        away = bundle.projected(tracks.image[rows], tracks.track[rows]) - tracks.plane[rows]
        squared = np.minimum((whole.focal_px * away) ** 2, 1e4).sum(axis=1)
        costs.append(np.bincount(own, np.log1p(squared)))
    bundle.point[new, 2] = usual * _DEPTHS[np.argmin(costs, axis=0)]
    whole.pointed[new] = True


def _adjust_whole(whole: Map, rounds: int) -> None:
    """All keyframes; of long recordings a stretch at a time, each held by the last third of the one before."""
    images = np.nonzero(whole.posed)[0]
    if len(images) <= _STRETCH:
        _adjust(whole, images[1:], images, _ROBUST_PX, rounds)
        return
    for begin in range(0, len(images) - _STRETCH // 3, _STRETCH * 2 // 3):
        stretch = images[begin : begin + _STRETCH]
        _adjust(whole, stretch[_STRETCH // 3 if begin else 1 :], stretch, _ROBUST_PX, rounds)


def _adjust(
    whole: Map, moved: Int64[np.ndarray, "moved"], seeing: Int64[np.ndarray, "seeing"], robust_px: float, rounds: int
) -> None:
    """Move some keyframes and all points that they see, by what these and others see."""
    tracks = whole.tracks
    free = np.isin(np.arange(len(whole.posed)), moved)
    held = np.isin(np.arange(len(whole.posed)), seeing)
    visible = np.zeros(len(whole.pointed), bool)
    visible[tracks.track[free[tracks.image]]] = True
    rows = np.nonzero(held[tracks.image] & (visible & whole.pointed)[tracks.track])[0]
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
    """Every other track."""
    return tracks.select(tracks.track % 2 == which)
