"""Mesh and point cloud of a run, from views at its keyframes."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from ebarf_ns.errors import ExportError, NoSurfaceError
from ebarf_ns.export.fusion import Volume
from ebarf_ns.export.views import Tone, View, bearings, evenly, look, tone_of
from ebarf_ns.files import whole_file
from ebarf_ns.geometry.cameras import Camera

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from jaxtyping import Float, UInt8

    from ebarf_ns.export.settings import SurfaceSettings
    from ebarf_ns.export.subject import Subject

_MOST_VIEWS, _MOST_PIXELS = 40, 25_000
_WIDEST_TAN = float(np.tan(np.radians(60)))
_VOXELS, _MOST_VOXELS = 160, 60_000_000
_EDGE_PERCENT, _MARGIN = 1.0, 0.02
_TRY = "train longer, or raise --blur; a camera that hardly translates does not determine distances"


class Points(NamedTuple):
    """Points in the input's world frame."""

    position: Float[np.ndarray, "points 3"]
    grey: UInt8[np.ndarray, "points"]


def write_mesh(
    subject: Subject, settings: SurfaceSettings, path: Path, progress: Callable[[float], None] = lambda fraction: None
) -> tuple[int, int]:
    """Write a PLY mesh with grey vertex colours; returns the numbers of vertices and faces.

    Raises :class:`ExportError` if no surface is sharp enough.
    """
    import trimesh

    views = _views(subject, settings, progress)
    lower, upper, voxel = _box(subject, views, settings)
    volume = Volume(lower, upper, voxel)
    for view in views:
        volume.add(view)
    mesh = volume.surface()
    if not len(mesh.face):
        raise NoSurfaceError(f"too few surfaces are sharp enough for a mesh; {_TRY}")
    grey = _tone(subject).grey(mesh.brightness)
    with whole_file(path) as temporary:
        trimesh.Trimesh(mesh.vertex, mesh.face, vertex_colors=_rgba(grey), process=False).export(temporary)
    return len(mesh.vertex), len(mesh.face)


def write_points(
    subject: Subject, settings: SurfaceSettings, path: Path, progress: Callable[[float], None] = lambda fraction: None
) -> int:
    """Write a grey PLY point cloud; returns the number of points. Raises :class:`ExportError` if there are none."""
    found = points(subject, settings, progress)
    write_cloud(found, path)
    return len(found.position)


def write_cloud(found: Points, path: Path) -> None:
    """Write a point cloud as PLY."""
    import trimesh

    with whole_file(path) as temporary:
        trimesh.PointCloud(found.position, colors=_rgba(found.grey)).export(temporary)


def points(
    subject: Subject, settings: SurfaceSettings, progress: Callable[[float], None] = lambda fraction: None
) -> Points:
    """Return the surface points of full views, averaged per voxel; raises :class:`ExportError` if there are none."""
    views = _views(subject, settings, progress)
    lower, upper, voxel = _box(subject, views, settings)
    position, brightness = (np.concatenate(column) for column in zip(*map(_surface_points, views), strict=True))
    inside = ((position >= lower) & (position <= upper)).all(axis=1)
    position, brightness = position[inside], brightness[inside]
    cell = np.floor((position - lower) / voxel).astype(np.int64)
    _, number, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    number = number.ravel()
    columns = [np.bincount(number, column) / count for column in (*position.T, brightness)]
    return Points(np.stack(columns[:3], axis=1), _tone(subject).grey(columns[3]))


def _views(subject: Subject, settings: SurfaceSettings, progress: Callable[[float], None]) -> list[View]:
    """Render undistorted views of keyframes, with distance 0 where the surface is not sharp."""
    for name, value in vars(settings).items():
        if value is not None and not value > 0:
            raise ExportError(f"{name} is {value}, expected a length above 0")
    camera = without_distortion(subject.camera)
    in_view = _in_view(subject.camera, bearings(camera))
    t_us = evenly(subject.trajectory.t_us.numpy(), _MOST_VIEWS).tolist()
    views, sharpest = [], np.inf
    for k, one in enumerate(t_us):
        view = look(subject, camera, one)
        sharp = in_view & (view.spread < settings.blur * view.distance)
        blur = view.spread[in_view] / np.maximum(view.distance[in_view], 1e-12)
        sharpest = min(sharpest, float(np.quantile(np.nan_to_num(blur, nan=np.inf), 0.25)))
        if settings.farthest:
            sharp &= view.distance <= settings.farthest
        views.append(replace(view, distance=np.where(sharp, view.distance, 0)))
        progress((k + 1) / len(t_us))
    if not any(view.distance.any() for view in views):
        raise NoSurfaceError(
            f"no surface is sharp enough: a quarter of a view is blurred by at most {sharpest:.2g} of its distance, "
            f"expected {settings.blur:g} or less; {_TRY}"
        )
    return views


def without_distortion(camera: Camera) -> Camera:
    """Return a pinhole camera that covers another's view up to 60 degrees off its axis, in few pixels."""
    bearing = bearings(camera)
    ahead = bearing[bearing[..., 2] > 1 / np.hypot(1, _WIDEST_TAN)]
    (left, top), (right, bottom) = (edge((ahead[:, :2] / ahead[:, 2:]), axis=0) for edge in (np.min, np.max))
    pixels = ((right - left) * camera.fx + 1) * ((bottom - top) * camera.fy + 1)
    shrink = min(1.0, np.sqrt(_MOST_PIXELS / pixels))
    fx, fy = camera.fx * shrink, camera.fy * shrink
    width, height = (int(np.ceil(span)) + 1 for span in ((right - left) * fx, (bottom - top) * fy))
    return Camera("pinhole", width, height, fx, fy, float(-left * fx), float(-top * fy))


def _in_view(camera: Camera, bearing: Float[np.ndarray, "height width 3"]) -> np.ndarray:
    """Return which directions are in the view of a camera."""
    x, y = camera.project(torch.from_numpy(bearing)).numpy().transpose(2, 0, 1)
    return (x >= -0.5) & (y >= -0.5) & (x <= camera.width - 0.5) & (y <= camera.height - 0.5)


def _surface_points(view: View) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and brightness of the sharp surface points of a view."""
    sharp = view.distance > 0
    local = view.bearing[sharp] * view.distance[sharp][:, None]
    return local @ view.pose[:, :3].T + view.pose[:, 3], view.brightness[sharp]


def _box(
    subject: Subject, views: list[View], settings: SurfaceSettings
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], float]:
    """Return the corners of a box around the visible surfaces, and the voxel size."""
    position = np.concatenate([_surface_points(view)[0] for view in views])
    lower, upper = np.percentile(position, (_EDGE_PERCENT, 100 - _EDGE_PERCENT), axis=0)
    margin = _MARGIN * (upper - lower).max()
    lower, upper = lower - margin, upper + margin
    if subject.scene.bounds is not None:
        lower, upper = np.maximum(lower, subject.scene.bounds[0]), np.minimum(upper, subject.scene.bounds[1])
    voxel = settings.voxel or float((upper - lower).max()) / _VOXELS
    count = np.prod(np.ceil((upper - lower) / voxel))
    if not count <= _MOST_VOXELS:
        raise ExportError(f"voxel is {voxel:g}, which gives {count:.3g} voxels, expected at most {_MOST_VOXELS:,}")
    return lower, upper, voxel


def _tone(subject: Subject) -> Tone:
    first_us, last_us = subject.trajectory.t_us[[0, -1]].tolist()
    return tone_of(subject, first_us, last_us)


def _rgba(grey: UInt8[np.ndarray, "points"]) -> UInt8[np.ndarray, "points 4"]:
    return np.stack([grey, grey, grey, np.full_like(grey, 255)], axis=1)
