"""A subject whose scene is known: the simulated room itself, where a trained field would be."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

from ebarf_ns.export.subject import Seen
from ebarf_ns.geometry.cameras import Camera
from ebarf_ns.geometry.trajectory import Poses, Trajectory, interpolate
from ebarf_ns.scene import Scene
from ebarf_ns.simulation.motion import HandheldMotion, sample_trajectory
from ebarf_ns.simulation.room import Room
from ebarf_ns.simulation.sensor import SensorModel

ROOM, MOTION = Room(), HandheldMotion()
PINHOLE = Camera("pinhole", 64, 48, 55.0, 55.0, 31.5, 23.5)
RADTAN = Camera("radtan", 64, 48, 50.0, 51.0, 30.0, 24.5, (-0.2, 0.05, 0.002, -0.001, 0.01))
FISHEYE = Camera("equidistant", 64, 48, 40.0, 40.0, 31.0, 23.0, (0.02, -0.01, 0.002, 0.0))


@dataclass
class KnownRoom:
    """The truth, seen from the true poses."""

    scene: Scene
    camera: Camera = PINHOLE
    start_us: int = 1_000_000
    keyframes: int = 21
    sensor: SensorModel = field(default_factory=SensorModel)

    def __post_init__(self):
        t_us = torch.arange(self.keyframes, dtype=torch.int64) * 50_000
        keyframes = sample_trajectory(MOTION, t_us.numpy())
        self.trajectory = Trajectory(t_us + self.start_us, keyframes.poses)

    def poses_at(self, t_us: torch.Tensor) -> Poses:
        return interpolate(self.trajectory.t_us, self.trajectory.poses, t_us, "cubic")

    def see(self, origin: np.ndarray, direction: np.ndarray) -> Seen:
        radiance, distance = ROOM.cast(np.ascontiguousarray(origin), np.ascontiguousarray(direction))
        spread, accumulation = np.zeros_like(distance), np.ones_like(distance)
        return Seen(*(column.astype(np.float32) for column in (np.log(radiance), distance, spread, accumulation)))


class FoggyRoom(KnownRoom):
    """The truth through a fog, as after a short training: no surface is sharp."""

    def see(self, origin: np.ndarray, direction: np.ndarray) -> Seen:
        return super().see(origin, direction)._replace(spread=np.full(len(origin), 0.5, np.float32))


def distance_to_room(point: np.ndarray, room: Room = ROOM) -> np.ndarray:
    """Of points to the nearest true surface, in metres."""
    lower, upper = np.array(room.lower), np.array(room.upper)
    outside = np.linalg.norm(np.maximum(np.maximum(lower - point, point - upper), 0), axis=1)
    nearest = np.where(outside > 0, outside, np.minimum(point - lower, upper - point).min(axis=1))
    for box in np.array(room.boxes):
        beyond = np.abs(point - (box[:3] + box[3:]) / 2) - (box[3:] - box[:3]) / 2
        signed = np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)
        nearest = np.minimum(nearest, np.abs(signed))
    for *centre, radius in room.balls:
        nearest = np.minimum(nearest, np.abs(np.linalg.norm(point - np.array(centre), axis=1) - radius))
    return nearest


def true_points(subject: KnownRoom, every: int = 7) -> np.ndarray:
    """Some of what the keyframes see, in truth."""
    bearing = subject.camera.bearings(subject.camera.pixel_grid()).reshape(-1, 3).numpy()[::every]
    points = []
    for matrix in subject.trajectory.poses.matrix().numpy():
        direction = bearing @ matrix[:, :3].T
        origin = np.broadcast_to(matrix[:, 3], direction.shape)
        points.append(origin + subject.see(origin, direction).distance[:, None] * direction)
    return np.concatenate(points)


def read_ply(path: Path) -> Any:
    """A mesh or a cloud, as the file has it."""
    return trimesh.load(path, process=False)
