"""Where spirals begin, and cameras with learned intrinsics."""

import pytest
import torch
from nerfstudio.cameras.camera_paths import get_spiral_path
from nerfstudio.cameras.cameras import Cameras
from torch.nn.functional import normalize

from ebarf_ns.nerf.views import upright_start


def camera_to_world(backward: list[float], up: list[float]) -> torch.Tensor:
    z = normalize(torch.tensor(backward), dim=0)
    x = normalize(torch.linalg.cross(torch.tensor(up), z), dim=0)
    rotation = torch.stack([x, torch.linalg.cross(z, x), z], dim=1)
    return torch.cat([rotation, torch.tensor([[0.1], [0.2], [0.3]])], dim=1)


@pytest.mark.parametrize(
    ("backward", "most_deg"),
    [
        ([1.0, 0.0, 0.0], 0.5),
        ([-0.3, 0.8, 0.2], 0.5),
        ([0.3, -0.3, 0.9], 0.5),
        # Along the world's z, where the first camera of many an odometry looks.
        ([0.0, 0.0, -1.0], 10.0),
        ([0.02, 0.05, 1.0], 10.0),
    ],
)
def test_spirals_stand_upright_and_look_where_the_camera_did(backward: list[float], most_deg: float):
    given = camera_to_world(backward, [0.0, 1.0, 0.3])
    camera = Cameras(upright_start(given)[None], torch.tensor([[100.0]]), torch.tensor([[100.0]]), 24.0, 18.0)
    for view in get_spiral_path(camera, steps=8, radius=0.1).camera_to_worlds:
        seen = given[:, :3].T @ view[:, :3]
        roll_deg = torch.rad2deg(torch.atan2(seen[0, 1], seen[1, 1]))
        aside_deg = torch.rad2deg(torch.atan2(seen[:2, 2].norm(), seen[2, 2]))
        assert abs(float(roll_deg)) < 1.5 and float(aside_deg) < most_deg
        assert float((view[:, 3] - given[:, 3]).norm()) < 0.2
