from typing import Any

import numpy as np
import pytest
import torch

from ebarf_ns.errors import SimulationError
from ebarf_ns.evaluation.trajectory_error import trajectory_error
from ebarf_ns.geometry.so3 import quat_wxyz_conjugate, quat_wxyz_log, quat_wxyz_multiply
from ebarf_ns.geometry.trajectory import Trajectory
from ebarf_ns.simulation.motion import HandheldMotion, sample_trajectory
from ebarf_ns.simulation.trajectory_errors import TrajectoryErrors, perturb

TRUE = sample_trajectory(HandheldMotion(), np.arange(0, 10_000_000, 20_000))
NONE: dict[str, Any] = {"position_noise": 0.0, "rotation_noise_rad": 0.0}


def deviations(noisy: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    shift = (noisy.poses.position - TRUE.poses.position).norm(dim=1)
    turn = quat_wxyz_multiply(quat_wxyz_conjugate(TRUE.poses.quat_wxyz), noisy.poses.quat_wxyz)
    return shift.numpy(), quat_wxyz_log(turn).norm(dim=1).numpy()


def test_white_noise_has_the_given_size():
    noisy = perturb(TRUE, TrajectoryErrors(0.03, 0.02), seed=1)
    error = trajectory_error(noisy, TRUE, "se3")
    assert error.ate_m == pytest.approx(0.03 * np.sqrt(3), rel=0.1)
    assert error.rotation_deg == pytest.approx(np.degrees(0.02 * np.sqrt(3)), rel=0.1)
    again, other = (perturb(TRUE, TrajectoryErrors(0.03, 0.02), seed=seed) for seed in (1, 2))
    assert torch.equal(again.poses.position, noisy.poses.position)
    assert not torch.equal(other.poses.position, noisy.poses.position)


def test_drift_starts_at_zero_and_reaches_its_size():
    shift, turn = deviations(perturb(TRUE, TrajectoryErrors(**NONE, position_drift=0.05, rotation_drift_rad=0.04), 0))
    assert shift[0] < 1e-12 and shift.max() == pytest.approx(0.05) and turn.max() == pytest.approx(0.04)
    # It hardly changes between neighbouring keyframes.
    assert np.abs(np.diff(shift)).max() < 0.01


def test_wander_is_smooth_and_of_its_size():
    noisy = perturb(TRUE, TrajectoryErrors(**NONE, position_wander=0.03, wander_s=0.2), seed=0)
    shift, turn = deviations(noisy)
    assert np.sqrt((shift**2).mean()) == pytest.approx(0.03 * np.sqrt(3), rel=0.05) and turn.max() < 1e-7
    offset = noisy.poses.position - TRUE.poses.position
    assert torch.diff(offset, dim=0).std() < 0.3 * offset.std()


def test_scale_clock_and_gaps():
    errors = TrajectoryErrors(**NONE, scale=2.0, clock_offset_us=-700, dropped=0.3)
    noisy = perturb(TRUE, errors, seed=0)
    assert 0.6 < len(noisy.t_us) / len(TRUE.t_us) < 0.8
    assert noisy.t_us[0] == TRUE.t_us[0] - 700 and noisy.t_us[-1] == TRUE.t_us[-1] - 700
    kept = torch.isin(TRUE.t_us, noisy.t_us + 700)
    assert torch.allclose(noisy.poses.position, 2 * TRUE.poses.position[kept])


@pytest.mark.parametrize(
    "wrong",
    [{"dropped": 1.0}, {"dropped": -0.1}, {"scale": 0.0}, {"scale": float("nan")}, {"position_noise": float("nan")}],
)
def test_errors_that_leave_no_trajectory_are_refused(wrong: dict):
    with pytest.raises(SimulationError, match=next(iter(wrong))):
        perturb(TRUE, TrajectoryErrors(**wrong), seed=0)


def test_negative_seeds_and_single_keyframes_are_refused():
    with pytest.raises(SimulationError, match="seed -1"):
        perturb(TRUE, TrajectoryErrors(), seed=-1)
    with pytest.raises(SimulationError, match="1 keyframes"):
        perturb(sample_trajectory(HandheldMotion(), np.zeros(1, np.int64)), TrajectoryErrors(), seed=0)
