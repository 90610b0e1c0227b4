from pathlib import Path

import cv2
import numpy as np
import pytest

from ebarf_ns.errors import SimulationError
from ebarf_ns.simulation.mesh import RoomWithMesh
from ebarf_ns.simulation.room import Room

EMPTY = Room(boxes=(), balls=())
COLOURED_SQUARE = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face 2
property list uchar int vertex_indices
end_header
5 -1 -1 255 255 255
5 1 -1 255 255 255
5 1 1 0 0 0
5 -1 1 0 0 0
3 0 1 2
3 0 2 3
"""
TEXTURED_SQUARE = """mtllib square.mtl
v 0 -1 -1
v 0 1 -1
v 0 1 1
v 0 -1 1
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl picture
f 1/1 2/2 3/3
f 1/1 3/3 4/4
"""


def look(mesh: RoomWithMesh, *targets: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Cast rays from x = -1.5 towards points (y, z) at x = 0."""
    origin = np.tile([-1.5, 0.0, 0.0], (len(targets), 1))
    towards = np.array([[0.0, *target] for target in targets]) - origin
    return mesh.cast(origin, towards / np.linalg.norm(towards, axis=1, keepdims=True))


def test_vertex_colours_are_seen_where_the_mesh_stands_and_the_room_around_it(tmp_path: Path):
    (tmp_path / "square.ply").write_text(COLOURED_SQUARE)
    mesh = RoomWithMesh(EMPTY, tmp_path / "square.ply", 1.0, (0.0, 0.0, 0.0))
    radiance, distance = look(mesh, (0.0, -0.45), (0.0, 0.45), (0.0, 0.0), (0.9, 0.0))
    assert radiance[0] > 0.7 and radiance[1] < 0.1 and distance[2] == pytest.approx(1.5, abs=1e-5)
    alone = EMPTY.cast(np.array([[-1.5, 0, 0]]), np.array([[1.5, 0.9, 0.0]]) / np.hypot(1.5, 0.9))
    assert (radiance[3], distance[3]) == (alone[0][0], alone[1][0])


def test_a_texture_is_seen_the_right_way_up(tmp_path: Path):
    (tmp_path / "square.obj").write_text(TEXTURED_SQUARE)
    (tmp_path / "square.mtl").write_text("newmtl picture\nmap_Kd picture.png\n")
    picture = np.zeros((8, 8, 3), np.uint8)
    picture[:4, :4] = 255
    cv2.imwrite(str(tmp_path / "picture.png"), picture)
    mesh = RoomWithMesh(EMPTY, tmp_path / "square.obj", 1.0, (0.0, 0.0, 0.0))
    # The upper left of the image has low u and high v, hence low y and high z.
    radiance, _ = look(mesh, (-0.3, 0.3), (0.3, 0.3), (-0.3, -0.3), (0.3, -0.3))
    assert radiance[0] > 0.9 and (radiance[1:] < 0.1).all()


@pytest.mark.parametrize(
    "content", ["", "not a mesh", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"]
)
def test_files_without_a_textured_mesh_are_named(tmp_path: Path, content: str):
    (tmp_path / "bad.obj").write_text(content)
    with pytest.raises(SimulationError, match="bad.obj"):
        look(RoomWithMesh(EMPTY, tmp_path / "bad.obj", 1.0, (0.0, 0.0, 0.0)), (0.0, 0.0))
