import math

import pytest

from ebarf_ns.evaluation.comparison_tables import tables
from ebarf_ns.evaluation.diagrams import error_of, performance_profile, quartiles, seconds_to


def record(method: str, seed: int, errors_m: list[float], seconds: float = 20.0) -> dict:
    evaluations = [
        {"train_seconds": seconds * (k + 1) / len(errors_m), "ate_m": error_m, "psnr": 20.0 + k, "rotation_deg": 1.0}
        for k, error_m in enumerate(errors_m)
    ]
    job = {"method": method, "scene": "room", "trajectory": "white", "seed": seed, "seconds": seconds}
    return {**job, "initial": {"ate_m": 0.05, "rotation_deg": 3.0}, "evaluations": evaluations}


def test_image_error_is_the_root_mean_square_and_unknown_errors_are_infinite():
    assert error_of({"psnr": 20.0}, "image") == pytest.approx(0.1)
    assert error_of({"psnr": None}, "image") == math.inf and error_of({}, "ate_m") == math.inf
    assert error_of({"ate_m": None, "ate_m_orientation": 0.02}, "ate_m") == 0.02


def test_quartiles_of_three_seeds_are_between_them_and_infinite_where_a_training_failed():
    assert quartiles([1.0, 2.0, 4.0]).tolist() == [1.5, 2.0, 3.0] and quartiles([1.0, 2.0]).tolist()[1] == 1.5
    assert quartiles([1.0, math.inf, 2.0]).tolist() == [1.5, 2.0, math.inf]
    assert quartiles([math.inf, math.inf, 2.0]).tolist() == [math.inf] * 3


def test_time_to_target_is_the_first_time_and_infinite_where_never():
    records = [record("ebarf", 0, [0.04, 0.02, 0.01, 0.015]), record("ebarf", 0, [0.009], seconds=60.0)]
    assert seconds_to(records, "ate_m", 0.02) == 10 and seconds_to(records, "ate_m", 0.0095) == 60
    assert seconds_to(records, "ate_m", 0.001) == math.inf


def test_profile_counts_problems_within_a_factor_of_the_fastest():
    seconds = {"fast": [1.0, 2.0, math.inf, math.inf], "slow": [3.0, 2.0, 5.0, math.inf]}
    profile = performance_profile(seconds, [1.0, 2.9, 3.0, 1e9])
    assert profile == {"fast": [0.5, 0.5, 0.5, 0.5], "slow": [0.5, 0.5, 0.75, 0.75]}


def test_tables_show_medians_and_what_was_not_reached():
    result = {
        "machine": "a machine", "date": "today", "roles": {"ebarf": "method"},
        "records": [record("ebarf", seed, [0.04, final]) for seed, final in enumerate((0.011, 0.004, 0.03))],
    }  # fmt: skip
    text = tables(result)
    assert "| room | white | as given |  |  | 0.05 m | 3 deg |  |" in text
    assert "| room | white | ebarf | 20 s | 21 dB | 0.011 m | 1 deg | - |" in text
    row = next(line for line in text.splitlines() if line.startswith("| room | white | ebarf | 10"))
    # 20 dB at once, 22 dB never; 5 cm at once, 2 cm after 20 s, 1 cm by one seed of three only.
    assert row == "| room | white | ebarf | 10 |" + " not reached |" * 4 + " 10 | 20 | not reached | not reached |"


def test_tables_compare_each_seed_with_the_first_method_true_poses_and_the_given_trajectory():
    true = [record("true poses", seed, [0.0, 0.0]) | {"trajectory": "true"} for seed in range(3)]
    ours = [record("ebarf", seed, [0.04, final]) for seed, final in enumerate((0.01, 0.005, 0.03))]
    other = [record("other", seed, [0.04, 0.05]) for seed in range(3)]
    for part, psnr, steps in ((true, 22.0, 400), (ours, 21.0, 200), (other, 20.5, 100)):
        for seed, one in enumerate(part):
            one["evaluations"][0] |= {"psnr": psnr + seed - 3, "step": steps // 4}
            one["evaluations"][1] |= {"psnr": psnr + seed, "step": steps}
    roles = {"ebarf": "method", "true poses": "floor", "other": "method"}
    text = tables({"machine": "a machine", "date": "today", "roles": roles, "records": [*ours, *true, *other]})
    left = "0.33 [0.33, 0.33]"
    gains = "- | -1.00 [-1.00, -1.00] | 0.50 [0.50, 0.50]"
    assert f"| room | white | ebarf | 20 s | {gains} | 0.20 [0.15, 0.40] | {left} | - |" in text
    # True poses gain 3 dB from 100 steps to 400: after 200 they are at 20.5 dB, after 100 at 19.
    gains = "-0.50 [-0.50, -0.50] | -1.50 [-1.50, -1.50] | 1.50 [1.50, 1.50]"
    assert f"| room | white | other | 20 s | {gains} | 1.00 [1.00, 1.00] | {left} | 2.00 [2.00, 2.00] |" in text


def test_a_training_that_failed_is_compared_with_nothing():
    ours, other = record("ebarf", 0, [0.01]), record("other", 0, [])
    perfect = record("ebarf", 0, [0.01]) | {"trajectory": "perfect", "initial": {"ate_m": 1e-16, "rotation_deg": 0.0}}
    roles = {"ebarf": "method", "other": "method"}
    text = tables({"machine": "a machine", "date": "today", "roles": roles, "records": [ours, other, perfect]})
    assert "| room | white | other | 20 s | - | - | - | - | - | - |" in text
    assert "| room | perfect | ebarf | 20 s | - | - | - | - | - | - |" in text
