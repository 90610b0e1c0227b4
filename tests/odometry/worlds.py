"""Synthetic tracks and recordings whose truth is known."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ebarf_ns.events.recording import Recording, RecordingFile, write_recording
from ebarf_ns.geometry.cameras import Camera
from ebarf_ns.odometry.tracks import Tracks

CAMERA = Camera("pinhole", 160, 120, 140.0, 140.0, 79.5, 59.5)
FOCAL_PX = 140.0


def motion(keyframes: int, sideways: float = 0.6, turn_rad: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Rotations, camera from world, and centres of a camera that sways and turns."""
    share = np.linspace(0, 1, keyframes)[:, None]
    centre = sideways * np.concatenate([share, 0.3 * np.sin(3 * share), 0.2 * share**2], axis=1)
    vector = turn_rad * np.concatenate([0.3 * np.sin(4 * share), -share, 0.2 * share], axis=1)
    return Rotation.from_rotvec(vector).as_matrix(), centre


def tracks_of(
    rotation: np.ndarray,
    centre: np.ndarray,
    noise_px: float = 0.3,
    points: int = 500,
    strays: float = 0.0,
    seed: int = 0,
) -> Tracks:
    """What a camera sees of points between 1 and 3 away; some tracks leave their points halfway."""
    random = np.random.default_rng(seed)
    world = np.stack([random.uniform(-2, 2.5, points), random.uniform(-1.5, 1.5, points), random.uniform(1, 3, points)])
    rows = []
    drift = np.where(random.random(points) < strays, 1.0, 0.0)[:, None] * random.normal(0, 0.08, (points, 2))
    for image in range(len(rotation)):
        seen = (rotation[image] @ (world - centre[image][:, None])).T
        plane = seen[:, :2] / seen[:, 2:] + drift * max(image / len(rotation) - 0.5, 0)
        plane = plane + random.normal(0, noise_px / FOCAL_PX, plane.shape)
        inside = (np.abs(plane) < [79 / FOCAL_PX, 59 / FOCAL_PX]).all(axis=1) & (seen[:, 2] > 0.1)
        rows += [(track, image, *plane[track]) for track in np.nonzero(inside)[0]]
    table = np.array(rows)
    tracks = Tracks(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:])
    return tracks.select(tracks.lengths()[tracks.track] >= 3)


def tracks_along_a_wall(keyframes: int, speed: float, seed: int) -> tuple[Tracks, np.ndarray]:
    """Drifting tracks of points on a wall 3 away, and the centres of a camera that often turns back, unevenly fast."""
    random = np.random.default_rng(seed)
    there_and_back = np.where(np.arange(keyframes) % 20 < 10, 1.0, -0.7)
    along = np.cumsum(there_and_back * speed * random.uniform(0.5, 1.5, keyframes))
    centre = np.stack([along, 0.3 * np.sin(3 * along), 0.2 * np.cos(2 * along)], axis=1)
    turn = np.stack([0.1 * np.sin(along), -0.25 * along, 0.05 * along], axis=1)
    rotation = Rotation.from_rotvec(turn).as_matrix()
    wall = np.stack([random.uniform(-6, 8, 1500), random.uniform(-3, 3, 1500), random.normal(3, 0.02, 1500)], axis=1)
    rows, tracked, count = [], {}, 0
    for image in range(keyframes):
        seen = (wall - centre[image]) @ rotation[image].T
        plane = seen[:, :2] / seen[:, 2:]
        inside = (np.abs(plane) < [79 / FOCAL_PX, 59 / FOCAL_PX]).all(axis=1) & (seen[:, 2] > 0.1)
        before, tracked = tracked, {}
        for point in np.nonzero(inside)[0]:
            track, first = before.get(point, (count, image))
            if image - first >= 12 * random.uniform(0.5, 1.5):
                track, first = count, image
            count += track == count
            tracked[point] = (track, first)
            drift_px = 0.5 * np.array([np.sin(image), np.cos(1.3 * image)]) * (image - first) / 12
            rows.append((track, image, *(plane[point] + (random.normal(0, 0.3, 2) + drift_px) / FOCAL_PX)))
    table = np.array(rows)
    tracks = Tracks(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:])
    return tracks.select(tracks.lengths()[tracks.track] >= 3), centre


def position_error_share(centre: np.ndarray, true: np.ndarray) -> float:
    """Root mean square after a similarity, over the extent of the path."""
    moved, goal = centre - centre.mean(axis=0), true - true.mean(axis=0)
    left, size, right = np.linalg.svd(goal.T @ moved)
    flip = np.diag([1, 1, np.sign(np.linalg.det(left @ right))])
    scale = (size * np.diag(flip)).sum() / (moved**2).sum()
    error = goal - scale * moved @ (left @ flip @ right).T
    return float(np.sqrt((error**2).sum(axis=1).mean()) / np.linalg.norm(np.ptp(true, axis=0)))


def recorded(path: Path, recording: Recording) -> RecordingFile:
    """A recording in a file."""
    write_recording(path, [recording])
    return RecordingFile(path, CAMERA.width, CAMERA.height)


def noise(events: int, length_us: int) -> Recording:
    """Events out of nothing."""
    random = np.random.default_rng(0)
    return Recording(
        random.integers(0, CAMERA.width, events).astype(np.uint16),
        random.integers(0, CAMERA.height, events).astype(np.uint16),
        np.sort(random.integers(0, length_us, events)),
        (2 * random.integers(0, 2, events) - 1).astype(np.int8),
    )


def moving_squares(squares: list[tuple[float, float, float, float, float]], length_us: int = 800_000) -> Recording:
    """Events of textured squares in front of nothing: x, y [px], velocities [px/s] and half side [px] of each."""
    random = np.random.default_rng(0)
    patterns = [np.kron(random.uniform(-1, 1, (32, 32)), np.ones((4, 4))) for _ in squares]
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    level, pieces = np.zeros(x.shape), []
    for t_us in range(0, length_us, 2000):
        brightness = np.zeros(x.shape)
        for (x0, y0, vx, vy, half), pattern in zip(squares, patterns, strict=True):
            across, down = x - x0 - vx * t_us * 1e-6, y - y0 - vy * t_us * 1e-6
            inside = np.maximum(np.abs(across), np.abs(down)) < half
            brightness[inside] = pattern[(down + 64).astype(int) % 128, (across + 64).astype(int) % 128][inside]
        steps = np.trunc((brightness - level) / 0.25).astype(int) if t_us else np.zeros(x.shape, int)
        level = level + 0.25 * steps if t_us else brightness
        for k in range(int(np.abs(steps).max(initial=0))):
            row, column = np.nonzero(np.abs(steps) > k)
            pieces.append((column, row, np.full(len(row), t_us + k), np.sign(steps[row, column])))
    x_, y_, t_, p_ = (np.concatenate(columns) for columns in zip(*pieces, strict=True))
    order = np.argsort(t_, kind="stable")
    return Recording(
        x_[order].astype(np.uint16), y_[order].astype(np.uint16), t_[order].astype(np.int64), p_[order].astype(np.int8)
    )
