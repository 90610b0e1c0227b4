"""Meshes and clouds of the true room: on its surfaces, whole, and nowhere else."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from ebarf_ns.errors import ExportError
from ebarf_ns.export.settings import SurfaceSettings
from ebarf_ns.export.surface import points, without_distortion, write_mesh, write_points
from ebarf_ns.export.views import tone_of
from ebarf_ns.geometry.cameras import Camera
from ebarf_ns.scene import Scene
from tests.export.subjects import (
    FISHEYE,
    PINHOLE,
    RADTAN,
    ROOM,
    FoggyRoom,
    KnownRoom,
    distance_to_room,
    read_ply,
    true_points,
)

COARSE = SurfaceSettings(voxel=0.05)


@pytest.mark.parametrize("camera", [PINHOLE, RADTAN, FISHEYE], ids=lambda camera: camera.model)
def test_a_mesh_lies_on_what_was_seen_and_covers_it(scene: Scene, camera: Camera, tmp_path: Path):
    subject = KnownRoom(scene, camera)
    vertices, faces = write_mesh(subject, COARSE, tmp_path / "mesh.ply")
    mesh = read_ply(tmp_path / "mesh.ply")
    assert len(mesh.vertices) == vertices and len(mesh.faces) == faces > 1000
    assert np.median(distance_to_room(mesh.vertices)) < 0.006
    # No wall along the cones of sight, nor behind the cameras: nothing lies in the room's empty middle.
    assert np.percentile(distance_to_room(mesh.vertices), 99) < 0.1 and distance_to_room(mesh.vertices).max() < 0.2
    covered, _ = KDTree(mesh.vertices).query(true_points(subject))
    assert np.mean(covered < 0.08) > 0.9


def test_faces_look_at_the_cameras_and_are_as_bright_as_what_is_there(known: KnownRoom, tmp_path: Path):
    write_mesh(known, COARSE, tmp_path / "mesh.ply")
    mesh = read_ply(tmp_path / "mesh.ply")
    towards = known.trajectory.poses.position.mean(dim=0).numpy() - mesh.triangles_center
    assert np.mean((mesh.face_normals * towards).sum(axis=1) > 0) > 0.9
    colour = np.asarray(mesh.visual.vertex_colors)
    assert (colour[:, 0] == colour[:, 1]).all() and (colour[:, 1] == colour[:, 2]).all()
    # The wall opposite, looked at from its own vertices' side.
    wall = np.asarray(mesh.vertices)[np.abs(np.asarray(mesh.vertices)[:, 0] - ROOM.upper[0]) < 0.02]
    grey = colour[np.abs(np.asarray(mesh.vertices)[:, 0] - ROOM.upper[0]) < 0.02, 0]
    eye = np.array([-1.0, 0.0, 0.4])
    seen = known.see(np.broadcast_to(eye, wall.shape), (wall - eye) / np.linalg.norm(wall - eye, axis=1)[:, None])
    visible = np.abs(seen.distance - np.linalg.norm(wall - eye, axis=1)) < 0.05
    first_us, last_us = known.trajectory.t_us[[0, -1]].tolist()
    expected = tone_of(known, first_us, last_us).grey(seen.brightness)[visible]
    assert visible.sum() > 100 and np.median(np.abs(expected.astype(float) - grey[visible])) < 12


def test_points_lie_on_surfaces_one_in_a_cell(known: KnownRoom, tmp_path: Path):
    count = write_points(known, COARSE, tmp_path / "points.ply")
    cloud = read_ply(tmp_path / "points.ply")
    assert len(cloud.vertices) == count > 3000
    assert np.percentile(distance_to_room(np.asarray(cloud.vertices)), 90) < 0.02
    assert len(np.unique(np.asarray(cloud.colors)[:, 0])) > 30


def test_what_is_far_or_blurred_is_left_out(known: KnownRoom):
    near = points(known, replace(COARSE, farthest=2.0))
    reach = np.linalg.norm(near.position - np.array([-1.0, 0.0, 0.4]), axis=1)
    assert reach.max() < 3.2 < np.linalg.norm(points(known, COARSE).position - [-1.0, 0.0, 0.4], axis=1).max()
    with pytest.raises(ExportError, match="sharp enough"):
        points(FoggyRoom(known.scene), COARSE)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (SurfaceSettings(voxel=-1.0), "voxel is -1.0"),
        (SurfaceSettings(voxel=1e-4), "expected at most"),
        (SurfaceSettings(farthest=float("nan")), "farthest is nan"),
        (SurfaceSettings(blur=0.0), "blur is 0.0"),
    ],
)
def test_impossible_settings_are_said_and_nothing_is_written(known: KnownRoom, tmp_path: Path, settings, words: str):
    with pytest.raises(ExportError, match=words):
        write_mesh(known, settings, tmp_path / "mesh.ply")
    assert not list(tmp_path.iterdir())


def test_a_view_without_distortion_sees_as_much():
    for camera in (PINHOLE, RADTAN, FISHEYE):
        ideal = without_distortion(camera)
        corners = camera.bearings(camera.pixel_grid()[[0, 0, -1, -1], [0, -1, 0, -1]])
        ahead = corners[corners[:, 2] > 0.5]
        x, y = ideal.project(ahead).T
        assert len(ahead) and ((x > -0.6) & (x < ideal.width) & (y > -0.6) & (y < ideal.height)).all()
    assert without_distortion(PINHOLE).fx == PINHOLE.fx
