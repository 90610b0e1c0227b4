import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from scipy.spatial.transform import Rotation

from ebarf_ns.geometry.trajectory import Poses, Trajectory, corrected, interpolate
from ebarf_ns.nerf.dataparser import opengl_from_opencv
from ebarf_ns.nerf.trajectory_optimizer import TrajectoryOptimizer, TrajectoryOptimizerConfig

COUNT = 6


def keyframes() -> Trajectory:
    quat = torch.from_numpy(Rotation.random(COUNT, np.random.default_rng(0)).as_quat()).float()[:, [3, 0, 1, 2]]
    position = torch.randn(COUNT, 3, generator=torch.Generator().manual_seed(0))
    return Trajectory(torch.arange(COUNT) * 50_000, Poses(position, quat))


def optimizer(moved: bool = True, **options: object) -> TrajectoryOptimizer:
    config = TrajectoryOptimizerConfig(smooth=False, **options)  # pyright: ignore[reportArgumentType]
    made: TrajectoryOptimizer = config.setup(num_cameras=COUNT, device="cpu", keyframes=keyframes(), focal_px=1.0)
    if moved and config.mode == "refine":
        torch.nn.init.normal_(made.correction, std=0.1)
    return made


def full(matrix: torch.Tensor) -> torch.Tensor:
    return torch.cat([matrix, torch.tensor([0.0, 0, 0, 1]).expand(*matrix.shape[:-2], 1, 4)], dim=-2)


def cameras(t_us: torch.Tensor, camera_to_world: torch.Tensor) -> Cameras:
    return Cameras(camera_to_world, 50.0, 50.0, 20.0, 15.0, 40, 30, metadata={"camera_t_us": t_us[:, None]})


def test_untouched_corrections_are_plain_zeros_and_change_nothing():
    fresh = optimizer(moved=False)
    assert torch.equal(fresh.correction, torch.zeros(COUNT, 6))
    identity = torch.eye(4)[:3].expand(COUNT, 3, 4)
    assert torch.allclose(fresh(torch.arange(COUNT)), identity, atol=1e-6)
    assert type(fresh(torch.arange(COUNT))) is torch.Tensor


def pull(made: TrajectoryOptimizer, size_px: float) -> float:
    """How hard corrections of a size are drawn back to none."""
    with torch.no_grad():
        made.correction.fill_(size_px / 6**0.5)
    losses = {"event_loss": torch.tensor(0.2, requires_grad=True)}
    made.get_loss_dict(losses)
    slope, of_events = torch.autograd.grad(
        losses["trajectory_prior"], [made.correction, losses["event_loss"]], allow_unused=True
    )
    assert of_events is None
    return float(slope.norm())


def test_small_corrections_cost_and_large_ones_hardly_cost_more():
    slopes = [pull(optimizer(), size_px) for size_px in (0.0, 0.05, 5.0, 50.0)]
    assert slopes[0] == 0 and slopes[1] > 20 * slopes[2] > 150 * slopes[3] > 0


def test_nothing_holds_keyframes_that_smoothing_has_moved_by_pixels():
    line = torch.arange(40)[:, None] * torch.tensor([0.01, 0.0, 0.0])
    upright = torch.tensor([1.0, 0, 0, 0]).expand(40, 4)
    noise = torch.randn(40, 3, generator=torch.Generator().manual_seed(0))
    pulls = []
    for noise_px in (0.0, 3.0):
        path = Trajectory(torch.arange(40) * 50_000, Poses(line + noise_px / 100 * noise, upright))
        made = TrajectoryOptimizerConfig().setup(num_cameras=40, device="cpu", keyframes=path, focal_px=100.0)
        pulls.append(pull(made, 0.2))
    assert pulls[0] > 500 * pulls[1] > 0


@pytest.mark.parametrize("every, early, late", [(1, [0, 1, 2, 3], [1000, 1001, 1002]), (3, [0, 3, 6], [1008, 1017])])
def test_keyframes_learn_in_every_so_many_th_step_and_less_often_later(every: int, early: list[int], late: list[int]):
    made, learn = optimizer(every=every), []
    for step in [*range(early[-1] + 1), *range(1000, late[-1] + 1)]:
        made.begin_step(step)
        if made.poses_at(keyframes().t_us).position.requires_grad:
            learn.append(step)
    assert learn == early + late
    optimizer(mode="off").begin_step(0)


@pytest.mark.parametrize("options", [{"prior": 0.0}, {"mode": "off"}])
def test_no_prior_is_no_loss(options: dict):
    losses = {"event_loss": torch.tensor(0.2)}
    optimizer(**options).get_loss_dict(losses)
    assert float(sum(losses.values())) == pytest.approx(0.2)


def test_what_is_held_costs_by_the_square_of_its_distance_to_the_keyframes_given():
    held = optimizer(moved=False, prior=0.0)
    held.begin_from(corrected(keyframes().poses, torch.tensor([3.0, 0, 0, 0, 0, 4.0]).expand(COUNT, 6)))
    held.hold_to_given(1e-3, 0.5)
    losses: dict = {}
    held.get_loss_dict(losses)
    assert float(losses["trajectory_prior"]) == pytest.approx(1e-3 * (3**2 + (4 / 0.5) ** 2), rel=1e-4)


def test_a_clock_that_is_off_moves_times_and_leaves_the_motion():
    late = optimizer(interpolation="linear")
    t_us = keyframes().t_us[1:] + 10_000
    before = late.poses_at(t_us[:-1])
    late.explain_by_clock(10_000)
    assert torch.equal(late.trajectory().t_us, keyframes().t_us + 10_000)
    assert torch.equal(late.given_trajectory().t_us, keyframes().t_us)
    assert torch.equal(late.given_trajectory().poses.position, keyframes().poses.position)
    assert torch.allclose(late.poses_at(t_us[:-1]).position, before.position, atol=1e-5)


def test_the_clock_is_learned_once_it_may_be():
    late, t_us = optimizer(moved=False), keyframes().t_us[1:3] + 20_000
    goal = interpolate(keyframes().t_us, keyframes().poses, t_us - 8_000).position
    late.learn_clock()
    rate = torch.optim.LBFGS([late.clock_px], max_iter=50, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        rate.zero_grad()
        error = (late.poses_at(t_us).position - goal).square().sum()
        error.backward()
        return error

    rate.step(loss)  # pyright: ignore[reportArgumentType]
    assert abs(int(late.trajectory().t_us[0]) - 8_000) < 50


def test_viewer_and_exporter_see_the_same_refined_keyframes():
    """The viewer multiplies by forward() on the right, ns-export cameras calls apply_to_camera()."""
    refined = optimizer()
    initial = opengl_from_opencv(keyframes().poses.matrix())
    by_viewer = full(initial) @ full(refined(torch.arange(COUNT)).detach())
    by_exporter = refined.apply_to_camera(cameras(keyframes().t_us, initial)).detach()
    truth = opengl_from_opencv(corrected(keyframes().poses, refined.correction).matrix()).detach()
    assert torch.allclose(by_viewer[:, :3], truth, atol=1e-5) and torch.allclose(by_exporter, truth, atol=1e-5)


def test_a_frame_camera_moves_with_the_event_camera_it_is_mounted_on():
    refined = optimizer()
    mount = full(torch.from_numpy(Rotation.from_euler("x", 20, degrees=True).as_matrix()).float() @ torch.eye(3, 4))
    mount[0, 3] = 0.2
    t_us = torch.tensor([70_000])
    before = full(interpolate(keyframes().t_us, keyframes().poses, t_us).matrix()) @ mount
    after = full(refined.poses_at(t_us).matrix().detach()) @ mount
    moved = refined.apply_to_camera(cameras(t_us, opengl_from_opencv(before[:, :3])))
    assert torch.allclose(opengl_from_opencv(moved), after[:, :3], atol=1e-5)


def test_cameras_of_anyone_else_stay():
    camera = cameras(torch.tensor([70_000]), torch.eye(4)[None, :3])
    camera.metadata = {"cam_idx": 0}
    assert torch.equal(optimizer().apply_to_camera(camera), torch.eye(4)[None, :3])


@pytest.mark.parametrize("count", [1, 2, 8])
def test_event_rays_become_world_rays_once(count: int):
    refined = optimizer()
    t_us = torch.linspace(0, 250_000, count).long()
    bundle = RayBundle(
        origins=torch.zeros(count, 3),
        directions=torch.tensor([[0.0, 0, 1]]).repeat(count, 1),
        pixel_area=torch.ones(count, 1),
        metadata={"event_t_us": t_us[:, None]},
    )
    refined.apply_to_raybundle(bundle)
    poses = refined.poses_at(t_us)
    assert torch.equal(bundle.origins, poses.position)
    assert torch.allclose(bundle.directions, poses.matrix()[:, :, 2], atol=1e-6)
    before = bundle.origins.clone()
    refined.apply_to_raybundle(bundle)
    assert torch.equal(bundle.origins, before)


def test_frozen_trajectory_has_nothing_to_learn():
    frozen = optimizer(mode="off")
    groups: dict = {}
    frozen.get_param_groups(groups)
    assert not groups and not list(frozen.parameters())
    assert torch.equal(frozen.trajectory().poses.position, keyframes().poses.position)


def test_interpolation_changes_positions_between_keyframes_alone():
    linear, cubic = optimizer(moved=False), optimizer(moved=False, interpolation="cubic")
    assert torch.allclose(
        linear.poses_at(keyframes().t_us).position, cubic.poses_at(keyframes().t_us).position, atol=1e-6
    )
    between = keyframes().t_us[:-1] + 25_000
    assert not torch.allclose(linear.poses_at(between).position, cubic.poses_at(between).position, atol=1e-3)


def test_smoothing_moves_the_start_and_keeps_what_came():
    config = TrajectoryOptimizerConfig(smooth=True)
    made: TrajectoryOptimizer = config.setup(num_cameras=COUNT, device="cpu", keyframes=keyframes(), focal_px=1.0)
    assert torch.equal(made.initial().position, keyframes().poses.position)
    assert not torch.equal(made.keyframes().position, keyframes().poses.position)
