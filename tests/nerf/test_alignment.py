from pathlib import Path

import pytest
import torch

from ebarf_ns.evaluation.trajectory_error import trajectory_results
from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.nerf.alignment import align
from ebarf_ns.radiance.hash_grid import HashGrid, HashGridShape
from ebarf_ns.simulation.simulate import Simulation, simulate
from ebarf_ns.simulation.trajectory_errors import TrajectoryErrors
from tests.nerf.test_training import config, trainer


def test_a_level_counts_by_its_share():
    grid = HashGrid(HashGridShape(levels=3, features=2, coarsest=4, finest=16, table_size_log2=10))
    torch.nn.init.normal_(grid.table)
    point = torch.rand(5, 3)
    whole = grid(point)
    grid.level_shares = torch.tensor([1.0, 0.5, 0.0])
    assert torch.equal(grid(point), whole * torch.tensor([1, 1, 0.5, 0.5, 0, 0]))


def test_without_the_time_for_it_nothing_moves(tiny_scene: Path, tmp_path: Path):
    ready = trainer(config(tiny_scene, tmp_path / "run"))
    before = ready.pipeline.trajectory()
    assert align(ready.pipeline.model, ready.pipeline.datamanager, 1000, 0, most_seconds=1e-3) is None
    assert torch.equal(ready.pipeline.trajectory().poses.position, before.poses.position)


@pytest.mark.slow
@pytest.mark.parametrize("drift_rad", [0.0, 0.03])
def test_a_large_drift_is_found_and_a_good_trajectory_left_alone(tmp_path: Path, drift_rad: float):
    errors = TrajectoryErrors(0.0, 0.0, position_wander=drift_rad / 6, rotation_wander_rad=drift_rad, wander_s=0.5)
    made = Simulation(width=80, height=60, focal_px=70.0, duration_s=1.5, frames=1, rays_per_pixel=4, errors=errors)
    scene = simulate(made, tmp_path / "scene").folder
    chosen = config(scene, tmp_path / "run")
    model, chosen.pipeline.datamanager.train_num_rays_per_batch = chosen.pipeline.model, 1024  # pyright: ignore[reportAttributeAccessIssue]
    model.grid_table_size_log2, model.grid_levels, model.grid_finest = 13, 6, 128  # pyright: ignore[reportAttributeAccessIssue]
    ready = trainer(chosen)
    truth, given = read_tum(scene / "groundtruth.txt"), ready.pipeline.trajectory()
    alignment = align(ready.pipeline.model, ready.pipeline.datamanager, 400, 0)
    assert alignment and alignment.taken == (drift_rad > 0), alignment
    if drift_rad:
        before, after = (trajectory_results(one, truth) for one in (given, ready.pipeline.trajectory()))
        assert after["rotation_deg"] < 0.4 * before["rotation_deg"], (before["rotation_deg"], after["rotation_deg"])
    else:
        assert torch.equal(ready.pipeline.trajectory().poses.position, given.poses.position)
