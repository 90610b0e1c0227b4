"""Each numbered case fails when its guard is removed: the guards, and a script that removes them one at a time.

``python -m tests.stability.mutations [CASE ...]`` copies the project, spoils it, and runs the case's test.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

REPOSITORY = Path(__file__).parents[2]


class Mutation(NamedTuple):
    """Replace ``guard`` in ``file``, where it occurs once, and ``test`` must fail."""

    case: int
    file: str
    guard: str
    spoiled: str
    test: str


SO3, TRAJECTORY = "ebarf_ns/geometry/so3.py", "ebarf_ns/geometry/trajectory.py"
BRIGHTNESS, LOSS = "ebarf_ns/photometry/brightness.py", "ebarf_ns/photometry/event_loss.py"
RECORDING, PAIRS = "ebarf_ns/events/recording.py", "ebarf_ns/events/pairs.py"
GUARD, MODEL = "ebarf_ns/nerf/guard.py", "ebarf_ns/nerf/model.py"
FRACTION = "(t_us - keyframe_t_us[left]).double() / interval_us.double()"
SAFE = "torch.where(small, torch.ones_like(angle_squared), angle_squared)"
SINC = """    angle = torch.where(small, torch.ones_like(angle_squared), angle_squared).sqrt()
    series = 1 - angle_squared / 6"""
TURN = "    turn = turn_between(quat_wxyz[:-1], quat_wxyz[1:])\n"
SHORTER = "    quat_wxyz = torch.where(quat_wxyz[..., :1] < 0, -quat_wxyz, quat_wxyz)\n"
SLERP = "quat_wxyz_multiply(frame, quat_wxyz_exp(moved[..., :3])))"
NLERP = "torch.nn.functional.normalize(torch.lerp(frame, quat_wxyz[left + 1], u), dim=-1))"
FLOATS = (
    "(t_us.float() - keyframe_t_us[left].float()) / (keyframe_t_us[left + 1].float() - keyframe_t_us[left].float())"
)
NO_INFORMATION = "if len(change) < 2 or not bool(reported.any()):"

MUTATIONS = (
    Mutation(1, SO3, SINC, SINC.replace(SAFE, "angle_squared"),
             "test_rotation.py::test_case_01_exp_is_exact_from_zero_on"),
    Mutation(2, SO3, "series = 1 - angle_squared / 6 * (1 - angle_squared / 20)",
             "series = 1 - angle_squared / 6",
             "test_rotation.py::test_case_02_series_and_formula_meet_without_a_step"),
    Mutation(3, SO3, SHORTER, "",
             "test_rotation.py::test_case_03_log_comes_back_from_half_a_turn_and_from_a_whole_one"),
    Mutation(4, SO3, "2 * torch.atan2(sine, w) / sine", "2 * torch.acos(w.clamp(-1, 1)) / sine",
             "test_rotation.py::test_case_04_small_relative_angles_do_not_vanish"),
    Mutation(5, TRAJECTORY, TURN,
             TURN.rstrip() + " * torch.sign((quat_wxyz[:-1] * quat_wxyz[1:]).sum(-1, keepdim=True))\n",
             "test_rotation.py::test_case_05_either_sign_of_a_quaternion_is_the_same_pose_with_the_same_gradient"),
    Mutation(6, TRAJECTORY, SLERP, NLERP,
             "test_rotation.py::test_case_06_slerp_meets_its_ends_at_unit_length_and_constant_velocity"),
    Mutation(7, SO3, SINC, SINC.replace(SAFE, "angle_squared"),
             "test_rotation.py::test_case_07_gradients_are_those_of_finite_differences"),
    Mutation(8, SO3, "half * sinc], dim=-1)", "half * (sinc - 2e-5)], dim=-1)",
             "test_rotation.py::test_case_08_ten_thousand_steps_keep_unit_length_and_need_no_noise"),
    Mutation(9, SO3, SINC, SINC.replace(SAFE, "angle_squared"),
             "test_rotation.py::test_case_09_poses_converge_from_any_rotation_error"),
    Mutation(10, TRAJECTORY, FRACTION, FLOATS,
             "test_trajectory.py::test_case_10_time_is_exact_at_any_epoch_and_over_any_span"),
    Mutation(11, TRAJECTORY, FRACTION, FRACTION.replace("(t_us - keyframe_t_us[left]).double()",
                                                         "(t_us.double() - keyframe_t_us[left].double())"),
             "test_trajectory.py::test_case_11_shifting_all_times_changes_no_bit"),
    Mutation(12, TRAJECTORY, "    t_us = t_us.clamp(keyframe_t_us[0], keyframe_t_us[-1])\n", "",
             "test_trajectory.py::test_case_12_outside_the_span_is_the_nearer_end_and_says_so"),
    Mutation(13, TRAJECTORY, "t_us[1:] <= t_us[:-1]", "t_us[1:] < t_us[:-1]",
             "test_trajectory.py::test_case_13_keyframe_times_that_do_not_increase_are_refused"),
    Mutation(13, "ebarf_ns/geometry/trajectory_file.py", "if abs(length - 1) > _QUATERNION_TOLERANCE:", "if False:",
             "test_trajectory.py::test_case_13_poses_that_are_none_are_refused_with_their_line"),
    Mutation(13, TRAJECTORY, FRACTION, FLOATS,
             "test_trajectory.py::test_case_13_keyframes_a_microsecond_apart_have_finite_gradients"),
    Mutation(14, TRAJECTORY, 'kind: Interpolation = "linear"', 'kind: Interpolation = "cubic"',
             "test_trajectory.py::test_case_14_an_event_moves_the_keyframes_around_it_and_no_other"),
    Mutation(15, TRAJECTORY, "u = exact_fraction.to(keyframes.position)",
             "u = ((exact_fraction + exact_fraction.mean()) - exact_fraction.mean()).to(keyframes.position)",
             "test_trajectory.py::test_case_15_order_and_batch_size_change_no_bit"),
    Mutation(16, BRIGHTNESS, "safe = torch.where(linear, torch.full_like(value, LIN_LOG_KNEE), value)", "safe = value",
             "test_photometry.py::test_case_16_brightness_is_finite_rising_and_of_bounded_slope"),
    Mutation(17, LOSS, "delta = 1e-3 * len(change) ** 0.5 * threshold", "delta = 0.0",
             "test_photometry.py::test_case_17_the_normalised_loss_is_smooth_at_any_size"),
    Mutation(17, LOSS, "unit = change / (change.square().sum() + delta**2).sqrt()", "unit = change / delta",
             "test_photometry.py::test_case_17_the_normalised_loss_does_not_know_the_scale"),
    Mutation(18, LOSS, "+ polarity_sum.clamp(max=0)", "- polarity_sum.clamp(max=0)",
             "test_photometry.py::test_case_18_which_end_comes_first_does_not_matter"),
    Mutation(19, LOSS, NO_INFORMATION, "if False:",
             "test_photometry.py::test_case_19_batches_without_information_change_nothing"),
    Mutation(20, "ebarf_ns/events/indexing.py", "np.where(hot, 0, counts)", "counts",
             "test_photometry.py::test_case_20_a_hot_pixel_with_a_million_events_has_no_more_than_its_share_of_a_batch"),
    Mutation(21, PAIRS, "        steps = np.minimum(steps, self.max_steps)\n", "",
             "test_photometry.py::test_case_21_pairs_of_any_length_have_finite_losses"),
    Mutation(22, RECORDING, "        except OSError as error:\n", "        except ZeroDivisionError as error:\n",
             "test_input.py::test_case_22_a_recording_cut_anywhere_is_refused_or_whole"),
    Mutation(23, RECORDING, "            if wrong.any():\n", "            if False:\n",
             "test_input.py::test_case_23_wrong_columns_are_named"),
    Mutation(23, RECORDING, "        for begin in range(first, last, size):\n",
             "        for begin in range(first, last - 1, size):\n",
             "test_input.py::test_case_23_pieces_of_any_size_are_bitwise_the_whole"),
    Mutation(25, "ebarf_ns/files.py", "        yield temporary\n        with temporary.open",
             "        yield path\n        with temporary.open",
             "test_training.py::test_case_25_a_full_disk_leaves_the_older_checkpoint"),
    Mutation(26, MODEL, "self.random.manual_seed(seed * 1_000_003 + step)", "pass",
             "test_training.py::test_case_26_a_run_resumed_in_another_process_ends_bitwise_where_an_uninterrupted_one_does"),
    Mutation(27, GUARD, "bool(norms.isfinite().all())", "True",
             "test_training.py::test_case_27_a_step_with_a_broken_gradient_changes_nothing"),
    Mutation(28, GUARD, "zero if one.grad is None else ", "",
             "test_training.py::test_case_28_poses_without_gradients_under_mixed_precision_do_not_end_the_run"),
    Mutation(29, MODEL, "            config.near,\n", "            0.05,\n",
             "test_training.py::test_case_29_every_field_of_the_configuration_changes_the_run[near]"),
    Mutation(30, "ebarf_ns/evaluation/trajectory_error.py", "if extent[1] <= _THINNEST * extent[0]:", "if False:",
             "test_gauge.py::test_case_30_where_alignment_is_not_defined_there_is_no_number"),
    Mutation(31, "ebarf_ns/evaluation/frames.py", "gain, offset = np.polyfit(x, y, 1)",
             "gain, offset = 1.0, 0.0",
             "test_gauge.py::test_case_31_gain_and_offset_of_log_brightness_change_no_decibel"),
)  # fmt: skip


def survives(mutation: Mutation) -> bool:
    """Whether the test passes all the same."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in ("ebarf_ns", "tests"):
            shutil.copytree(REPOSITORY / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(REPOSITORY / "pyproject.toml", folder)
        spoiled = folder / mutation.file
        spoiled.write_text(
            spoiled.read_text(encoding="utf-8").replace(mutation.guard, mutation.spoiled), encoding="utf-8"
        )
        command = [sys.executable, "-m", "pytest", "-x", "-q", f"tests/stability/{mutation.test}"]
        finished = subprocess.run(
            command, cwd=folder, env={**os.environ, "PYTHONPATH": str(folder)}, capture_output=True, check=False
        )
    # 1: tests failed; anything else is not what removing a guard should do.
    assert finished.returncode in (0, 1), finished.stdout.decode()[-3000:]
    return finished.returncode == 0


def main(cases: list[str]) -> int:
    """How many guards can be removed without any test noticing."""
    survivors = 0
    for mutation in MUTATIONS:
        if not cases or str(mutation.case) in cases:
            alive = survives(mutation)
            survivors += alive
            print(f"case {mutation.case:2}: {'NOT NOTICED' if alive else 'noticed'}  {mutation.test}", flush=True)
    return survivors


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
