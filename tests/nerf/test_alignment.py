from dataclasses import replace
from pathlib import Path

import pytest
import torch

from ebarf_ns.evaluation.trajectory_error import trajectory_results
from ebarf_ns.geometry.trajectory import corrected
from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.nerf.alignment import align, roughness
from ebarf_ns.nerf.support import support
from ebarf_ns.nerf.trainer import EbarfTrainer
from ebarf_ns.radiance.hash_grid import HashGrid
from ebarf_ns.radiance.lattice import HashGridShape
from ebarf_ns.simulation.simulate import Simulation, simulate
from ebarf_ns.simulation.trajectory_errors import NO_ERRORS, TrajectoryErrors
from tests.nerf.test_training import config, trainer


def test_a_level_counts_by_its_share():
    grid = HashGrid(HashGridShape(levels=3, features=2, coarsest=4, finest=16, table_size_log2=10))
    torch.nn.init.normal_(grid.table)
    point = torch.rand(5, 3)
    whole = grid(point)
    grid.level_shares = torch.tensor([1.0, 0.5, 0.0])
    assert torch.equal(grid(point), whole * torch.tensor([1, 1, 0.5, 0.5, 0, 0]))


def test_without_enough_time_nothing_moves(tiny_scene: Path, tmp_path: Path):
    ready = trainer(config(tiny_scene, tmp_path / "run"))
    before = ready.pipeline.trajectory()
    assert align(ready.pipeline.model, ready.pipeline.datamanager, 1000, 0, most_seconds=1e-3) is None
    assert torch.equal(ready.pipeline.trajectory().poses.position, before.poses.position)


def test_noise_is_rough_and_drift_is_smooth():
    noise = torch.randn(60, 6, generator=torch.Generator().manual_seed(0))
    course = torch.linspace(0, 9, 60)[:, None] * torch.linspace(0.5, 1.5, 6)
    assert roughness(noise) == pytest.approx(1, abs=0.2) and roughness(course.sin()) < 0.05
    assert roughness(torch.zeros(60, 6)) == 0


def ready_trainer(folder: Path, errors: TrajectoryErrors, duration_s: float = 1.5) -> tuple[EbarfTrainer, Path]:
    """A trainer for a small room, before alignment."""
    made = Simulation(
        width=80, height=60, focal_px=70.0, duration_s=duration_s, frames=1, rays_per_pixel=4, errors=errors
    )
    scene = simulate(made, folder / "scene").folder
    chosen = config(scene, folder / "run")
    model, datamanager = chosen.pipeline.model, chosen.pipeline.datamanager
    datamanager.train_num_rays_per_batch, datamanager.eval_num_rays_per_batch = 1024, 8192  # pyright: ignore[reportAttributeAccessIssue]
    model.grid_table_size_log2, model.grid_levels, model.grid_finest = 13, 6, 128  # pyright: ignore[reportAttributeAccessIssue]
    return trainer(chosen), scene


@pytest.mark.slow
@pytest.mark.parametrize("drift_rad", [0.0, 0.03])
def test_a_large_drift_is_found_and_a_good_trajectory_left_alone(tmp_path: Path, drift_rad: float):
    errors = TrajectoryErrors(0.0, 0.0, position_wander=drift_rad / 6, rotation_wander_rad=drift_rad, wander_s=0.5)
    ready, scene = ready_trainer(tmp_path, errors)
    truth, given = read_tum(scene / "groundtruth.txt"), ready.pipeline.trajectory()
    alignment = align(ready.pipeline.model, ready.pipeline.datamanager, 400, 0)
    assert alignment and alignment.taken == (drift_rad > 0), alignment
    if drift_rad:
        before, after = (trajectory_results(one, truth) for one in (given, ready.pipeline.trajectory()))
        assert after["rotation_deg"] < 0.4 * before["rotation_deg"], (before["rotation_deg"], after["rotation_deg"])
    else:
        assert torch.equal(ready.pipeline.trajectory().poses.position, given.poses.position)


@pytest.mark.slow
def test_noise_on_every_keyframe_is_left_to_training(tmp_path: Path):
    ready, _ = ready_trainer(tmp_path, replace(NO_ERRORS, position_noise=0.12, rotation_noise_rad=0.12))
    given = ready.pipeline.trajectory()
    alignment = align(ready.pipeline.model, ready.pipeline.datamanager, 400, 0)
    assert alignment and not alignment.taken and alignment.moved_px > 1.8, alignment
    assert torch.equal(ready.pipeline.trajectory().poses.position, given.poses.position)
    assert "noise" in str(alignment)


@pytest.mark.slow
@pytest.mark.parametrize("offset_us", [0, 60_000])
def test_a_clock_offset_is_corrected(tmp_path: Path, offset_us: int):
    ready, scene = ready_trainer(tmp_path, replace(NO_ERRORS, clock_offset_us=offset_us), duration_s=2.0)
    alignment = align(ready.pipeline.model, ready.pipeline.datamanager, 400, 0)
    assert alignment and abs(alignment.clock_offset_us + offset_us) <= (10_000 if offset_us else 0)
    refined, given = ready.pipeline.trajectory(), read_tum(scene / "trajectory.txt")
    assert int(refined.t_us[0] - given.t_us[0]) == alignment.clock_offset_us
    assert torch.equal(ready.pipeline.trajectory(refined=False).t_us, given.t_us)


@pytest.mark.slow
@pytest.mark.parametrize("spoilt", [False, True])
def test_held_out_events_distinguish_a_spoilt_trajectory_from_a_good_one(tmp_path: Path, spoilt: bool):
    ready, _ = ready_trainer(tmp_path, NO_ERRORS)
    keyframes = ready.pipeline.model.camera_optimizer
    course = torch.linspace(0, 9, len(keyframes.keyframe_t_us)).sin()
    moved = torch.zeros(len(course), 6)
    moved[:, 1] = 0.05 * course if spoilt else 0.0
    keyframes.begin_from(corrected(keyframes.initial(), moved))
    found = support(ready.pipeline.model, ready.pipeline.datamanager, 200, 0)
    assert found and found.verdict == ("worse" if spoilt else "alike")
    assert "trajectory_initial.txt" in str(found) or not spoilt
    assert found.weakest and 0 < found.weakest.turn_deg < 10
