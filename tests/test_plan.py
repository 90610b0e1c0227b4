"""Planned configuration values, their reasons, and overrides."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from ebarf_ns.events.sensor_facts import UNKNOWN_SENSOR, Estimate, SensorFacts
from ebarf_ns.geometry.trajectory import Poses, Trajectory
from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.plan import Line, apply_plan, plan_for
from ebarf_ns.scene import ContrastThreshold, Scene, read_scene


@pytest.fixture
def scene(tiny_scene: Path) -> Scene:
    return read_scene(tiny_scene)


def planned(scene: Scene, events: int = 500_000, trajectory: Trajectory | None = None, device: str = "cpu") -> dict:
    lines = plan_for(scene, trajectory or read_tum(scene.trajectory), events, device)
    assert all(line.reason for line in lines)
    return {line.field.rsplit(".", 1)[-1]: line.value for line in lines}


def test_parts_exist_only_where_the_scene_needs_them(scene: Scene):
    assert planned(scene)["contract"] is False
    assert planned(dataclasses.replace(scene, bounds=None))["contract"] is True


def test_silent_pairs_need_thresholds(scene: Scene):
    trajectory = read_tum(scene.trajectory)
    shares = [
        line.value
        for normalized in (False, True)
        for line in plan_for(scene, trajectory, 500_000, "cpu", normalized=normalized)
        if line.field == "pipeline.datamanager.silent_share"
    ]
    assert shares[0] > 0 and shares[1] == 0


def test_sensor_facts_are_those_found_unless_the_scene_states_them(scene: Scene):
    found = SensorFacts(Estimate(480, 400, 600), Estimate(0.6, 0.5, 0.72), 3, 0.01, 1, None, 0.0, 3, 0, 0.5)
    trajectory = read_tum(scene.trajectory)

    def lines(given: Scene, facts: SensorFacts) -> dict[str, Line]:
        return {line.field.rsplit(".", 1)[-1]: line for line in plan_for(given, trajectory, 1000, "cpu", facts=facts)}

    untold = dataclasses.replace(scene, contrast_threshold=None)
    by_recording = lines(untold, found)
    assert by_recording["refractory_us"].value == 480 and "400 to 600 us" in by_recording["refractory_us"].reason
    assert by_recording["threshold_ratio"].value == 0.6 and 0.08 < by_recording["threshold_deviation"].value < 0.1
    assert (
        0
        < by_recording["blank_share"].value
        < lines(untold, dataclasses.replace(found, blank_share=1.0))["blank_share"].value
    )
    thresholds = ContrastThreshold(0.3, 0.2)
    stated = lines(
        dataclasses.replace(scene, contrast_threshold=thresholds, refractory_us=7, time_constant_us=900.0), found
    )
    assert by_recording["time_constant_us"].value is None and stated["time_constant_us"].value == 900
    assert stated["refractory_us"].value == 7 and stated["threshold_ratio"].value == 0.3 / 0.2
    assert stated["threshold_deviation"].value == 0 and "scene.json" in stated["threshold_ratio"].reason
    nothing = lines(untold, UNKNOWN_SENSOR)
    assert nothing["refractory_us"].value == 0 and nothing["blank_share"].value == 0
    assert nothing["threshold_ratio"].value == 1 and nothing["threshold_deviation"].value == pytest.approx(0.5)


def test_resolution_follows_the_pixel_footprint(scene: Scene):
    sharper = dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, fx=3 * scene.camera.fx))
    finest = planned(dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, fx=100.0)))["grid_finest"]
    assert planned(sharper)["grid_finest"] == pytest.approx(1.23 * finest, rel=0.05)
    assert planned(sharper)["grid_levels"] >= planned(scene)["grid_levels"]


def test_scale_of_the_world_changes_nothing(scene: Scene):
    assert scene.bounds
    trajectory = read_tum(scene.trajectory)
    large = Trajectory(trajectory.t_us, Poses(1e4 * trajectory.poses.position, trajectory.poses.quat_wxyz))
    bounds = tuple(tuple(1e4 * side for side in corner) for corner in scene.bounds)
    assert planned(dataclasses.replace(scene, bounds=bounds), trajectory=large) == planned(scene)  # pyright: ignore[reportArgumentType]


def test_a_wall_is_as_near_as_the_bounds_say_in_its_direction(scene: Scene):
    assert scene.bounds
    (_, lower_y, lower_z), (_, upper_y, upper_z) = scene.bounds
    corridor = dataclasses.replace(scene, bounds=((-10.0, lower_y, lower_z), (10.0, upper_y, upper_z)))
    (line,) = (line for line in plan_for(corridor, read_tum(scene.trajectory), 10**9, "cpu") if "finest" in line.field)
    assert "20 wide" in line.reason and "10 away" not in line.reason
    assert line.value > 2 * planned(scene)["grid_finest"]


def test_the_grid_is_no_finer_than_events_support(scene: Scene):
    few = planned(dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, fx=500.0)), events=10_000)
    assert few["grid_finest"] == 100 and few["grid_table_size_log2"] == 13
    assert planned(scene, events=1)["grid_finest"] == 32 and planned(scene, events=1)["grid_table_size_log2"] == 10
    assert planned(dataclasses.replace(scene, bounds=None), events=1_600)["grid_finest"] == 80
    assert planned(scene, events=10**12)["grid_table_size_log2"] <= 19


def test_what_follows_from_the_resolution_follows_the_one_given(scene: Scene):
    trajectory = read_tum(scene.trajectory)
    lines = {line.field: line for line in plan_for(scene, trajectory, 500_000, "cpu", finest_given=1000)}
    assert lines["pipeline.model.grid_levels"].value > planned(scene)["grid_levels"]
    assert "from 8 to 1000" in lines["pipeline.model.grid_levels"].reason
    assert lines["pipeline.model.grid_finest"].value == planned(scene)["grid_finest"]


def test_a_trajectory_that_hardly_enters_the_bounds_is_planned_for(scene: Scene):
    trajectory = smooth_motion(500)
    position = trajectory.poses.position + 1000
    position[5] = 0
    assert planned(scene, trajectory=Trajectory(trajectory.t_us, Poses(position, trajectory.poses.quat_wxyz)))
    two = Trajectory(trajectory.t_us[:2], Poses(position[:2], trajectory.poses.quat_wxyz[:2]))
    assert planned(scene, trajectory=two)["keyframe_stride"] == 1


def test_a_gpu_gets_larger_batches(scene: Scene):
    rays = "train_num_rays_per_batch"
    assert planned(scene, device="cuda")[rays] > planned(scene)[rays]


def smooth_motion(rate_hz: int) -> Trajectory:
    t_s = torch.arange(2 * rate_hz + 1, dtype=torch.float64) / rate_hz
    position = torch.stack([0.3 * torch.sin(3 * t_s), 0.2 * torch.cos(2 * t_s), 0 * t_s], dim=-1)
    quat_wxyz = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand(len(t_s), 4)
    return Trajectory((t_s * 1e6).round().long(), Poses(position, quat_wxyz))


def test_dense_keyframes_share_corrections_and_sparse_ones_do_not(scene: Scene):
    sparse, dense, denser = (
        planned(scene, trajectory=smooth_motion(rate))["keyframe_stride"] for rate in (4, 100, 1000)
    )
    assert sparse == 1 < dense < denser


def test_drift_between_keyframes_is_corrected_at_each(scene: Scene):
    sharp = dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, fx=110.0))
    slow = smooth_motion(40)
    steps_m = torch.randn(slow.poses.position.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    drifting = Trajectory(slow.t_us, Poses(slow.poses.position + 0.005 * steps_m.cumsum(0), slow.poses.quat_wxyz))
    assert planned(sharp, trajectory=slow)["keyframe_stride"] == 2
    assert planned(sharp, trajectory=drifting)["keyframe_stride"] == 1


def test_set_values_stay_and_are_named():
    configuration = SimpleNamespace(model=SimpleNamespace(samples=None, grid_levels=5))
    lines = [Line("model.samples", 24, "enough"), Line("model.grid_levels", 8, "needed")]
    first, second = apply_plan(lines, configuration)
    assert configuration.model.samples == 24 and configuration.model.grid_levels == 5
    assert first == lines[0] and second.value == 5 and "planned: 8, needed" in second.reason
    assert lines[1].flag == "--model.grid-levels"


def test_inspect_prints_the_plan_a_run_keeps_and_flags_overrule(trained_run: Path, tiny_scene: Path):
    from tests.conftest import run_ok

    shown = {line["field"]: line for line in json.loads(run_ok("ebarf", "inspect", tiny_scene, "--json"))["plan"]}
    kept = json.loads((trained_run / "metrics.jsonl").read_text().splitlines()[0])["plan"]
    assert shown.keys() == kept.keys()
    assert kept["pipeline.model.contract"] == {k: shown["pipeline.model.contract"][k] for k in ("value", "reason")}
    assert kept["pipeline.model.samples"]["value"] == 24 and "set by flag" in kept["pipeline.model.samples"]["reason"]
    text = run_ok("ebarf", "inspect", tiny_scene)
    assert "--pipeline.model.grid-finest" in text and "no contraction" in text and "stated: on 0.25, off 0.25" in text
    assert "samples: 24" in (trained_run / "config.yml").read_text()


def swinging(keyframes: int, uneven: bool = False) -> Trajectory:
    """Two seconds of oscillating rotation, at most one radian per second."""
    t_us = torch.linspace(0, 2e6, keyframes).round().long()
    if uneven:
        t_us[1] = t_us[0] + 1000
    angle = torch.sin(t_us.double() * 6e-6) / 12
    quat_wxyz = torch.stack([angle.cos(), 0 * angle, angle.sin(), 0 * angle], dim=-1)
    return Trajectory(t_us, Poses(torch.zeros(keyframes, 3).double(), quat_wxyz))


@pytest.mark.parametrize(
    ("trajectory", "expected"),
    [
        (swinging(41), "cubic"),
        (swinging(2001), "linear"),
        (swinging(41, uneven=True), "linear"),
        (swinging(4), "linear"),
    ],
    ids=["20 Hz", "1000 Hz", "uneven", "few"],
)
def test_a_spline_is_used_only_if_the_motion_needs_and_supports_it(scene: Scene, trajectory: Trajectory, expected: str):
    assert planned(scene, trajectory=trajectory)["interpolation"] == expected


def shaken(hertz: float, every_us: int, count: int) -> Trajectory:
    """A camera that oscillates by a tenth of a radian at the given frequency."""
    t_us = torch.arange(count) * every_us
    angle = 0.1 * torch.sin(2 * torch.pi * hertz * t_us.double() * 1e-6)
    zero = torch.zeros_like(angle)
    return Trajectory(
        t_us,
        Poses(
            torch.stack([0.1 * angle, zero, zero], 1),
            torch.stack([(angle / 2).cos(), zero, (angle / 2).sin(), zero], 1),
        ),
    )


def test_keyframes_are_inserted_if_the_given_ones_undersample_the_motion(scene: Scene):
    swift, slow = shaken(1.5, 200_000, 11), shaken(0.1, 200_000, 11)
    assert 45_000 <= planned(scene, trajectory=swift)["longest_gap_us"] <= 100_000
    assert planned(scene, trajectory=swift)["keyframe_stride"] == 1
    assert planned(scene, trajectory=slow)["longest_gap_us"] == 0
    assert planned(scene, trajectory=shaken(1.5, 50_000, 41))["longest_gap_us"] == 0


def test_keyframes_are_inserted_in_gaps(scene: Scene):
    even = shaken(0.2, 50_000, 61)
    kept = torch.tensor([k for k in range(61) if not 20 < k < 40])
    uneven = Trajectory(even.t_us[kept], Poses(*(column[kept] for column in even.poses)))
    assert planned(scene, trajectory=even)["longest_gap_us"] == 0
    assert planned(scene, trajectory=uneven)["longest_gap_us"] == 50_000
