"""What evaluation must not see: cases 30 and 31."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ebarf_ns.errors import EvaluationError
from ebarf_ns.evaluation.frames import image_errors
from ebarf_ns.evaluation.trajectory_error import trajectory_error
from ebarf_ns.geometry.trajectory import Poses, Trajectory

UNCHANGED = 1e-9
PSNR_DB = 1e-4


def wandering(count: int = 30, seed: int = 0) -> Trajectory:
    random = np.random.default_rng(seed)
    position = np.cumsum(random.standard_normal((count, 3)), axis=0)
    quat = Rotation.random(count, random).as_quat()[:, [3, 0, 1, 2]]
    return Trajectory(torch.arange(count) * 10_000, Poses(torch.from_numpy(position), torch.from_numpy(quat)))


def moved(trajectory: Trajectory, scale: float) -> Trajectory:
    turn = Rotation.from_rotvec([0.3, -2.0, 0.7])
    position = scale * turn.apply(trajectory.poses.position.numpy()) + [5.0, -3.0, 100.0]
    turned = turn * Rotation.from_quat(trajectory.poses.quat_wxyz.numpy()[:, [1, 2, 3, 0]])
    quat = torch.from_numpy(turned.as_quat()[:, [3, 0, 1, 2]])
    return Trajectory(trajectory.t_us, Poses(torch.from_numpy(position), quat))


@pytest.mark.parametrize(("alignment", "scale"), [("se3", 1.0), ("sim3", 3.7), ("sim3", 1e-3), ("orientation", 0.2)])
def test_case_30_errors_do_not_depend_on_the_world_of_the_estimate(alignment: str, scale: float):
    truth = wandering()
    noisy = Trajectory(truth.t_us, Poses(truth.poses.position + 0.05 * torch.randn(30, 3), truth.poses.quat_wxyz))
    here, there = (
        trajectory_error(estimate, truth, alignment)  # pyright: ignore[reportArgumentType]
        for estimate in (noisy, moved(noisy, scale))
    )
    assert there.ate_m == pytest.approx(here.ate_m, rel=UNCHANGED)
    assert there.rotation_deg == pytest.approx(here.rotation_deg, abs=1e-5)


@pytest.mark.parametrize("alignment", ["se3", "sim3"])
def test_case_30_where_alignment_is_not_defined_there_is_no_number(alignment: str):
    truth = wandering()
    line = torch.linspace(0, 1, 30, dtype=torch.float64)[:, None] * torch.tensor([[1.0, 2.0, 3.0]]).double()
    still = torch.zeros(30, 3, dtype=torch.float64)
    # What evo would align about the noise across it.
    nearly = line + 1e-3 * torch.randn(30, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for position in (line, still, nearly):
        degenerate = Trajectory(truth.t_us, Poses(position, truth.poses.quat_wxyz))
        with pytest.raises(EvaluationError):
            trajectory_error(degenerate, degenerate, alignment)  # pyright: ignore[reportArgumentType]
    few = Trajectory(truth.t_us[:2], Poses(truth.poses.position[:2], truth.poses.quat_wxyz[:2]))
    with pytest.raises(EvaluationError, match="expected at least 3"):
        trajectory_error(few, truth, alignment)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(("gain", "offset"), [(2.0, 1.0), (0.1, -5.0), (7.0, 30.0)])
def test_case_31_gain_and_offset_of_log_brightness_change_no_decibel(gain: float, offset: float):
    random = np.random.default_rng(0)
    references = [0.1 + 0.8 * random.random((24, 32)) for _ in range(3)]
    renders = [np.log(image) + 0.1 * random.standard_normal(image.shape) for image in references]
    here = image_errors(renders, references)
    there = image_errors([gain * render + offset for render in renders], references)
    assert there["psnr"] == pytest.approx(here["psnr"], abs=PSNR_DB)
