import matplotlib.pyplot as plt
import numpy as np

from ebarf_ns.evaluation.basin import basin_figure, worse_lines, worse_than_given


def record(before_deg: float, after_deg: float | None, seed: int = 0, said: str | None = None) -> dict:
    last = {"rotation_deg": after_deg, "ate_m": 0.001, **({"support": {"verdict": said}} if said else {})}
    return {
        "scene": "room", "trajectory": f"drift {before_deg}", "method": "ebarf", "seed": seed,
        "initial": {"rotation_deg": before_deg, "ate_m": 0.01}, "evaluations": [last],
    }  # fmt: skip


def test_trainings_that_left_a_trajectory_worse_are_named_with_what_they_said():
    records = [record(2.0, 0.1), record(1.0, 1.04, seed=1), record(1.0, 1.2, seed=2, said="worse"), record(0.0, 0.03)]
    assert [one["seed"] for one in worse_than_given(records)] == [2]
    lines = worse_lines(records)
    assert lines[0] == "1 training of 4 left a trajectory worse."
    assert "seed 2" in lines[1] and "1 to 1.2 rotation error [deg]" in lines[1] and lines[1].endswith("says: worse")
    assert worse_lines(records[:1]) == ["No trainings of 1 left a trajectory worse."]


def test_the_figure_has_a_point_for_each_training_whose_errors_are_known():
    failed = {**record(3.0, 1.0), "evaluations": []}
    figure = basin_figure([record(2.0, 0.1), record(5.0, 4.0), record(1.0, None), failed])
    points = figure.axes[0].lines[0]
    assert np.asarray(points.get_xdata()).tolist() == [2.0, 5.0]
    assert np.asarray(points.get_ydata()).tolist() == [0.1, 4.0]
    plt.close(figure)
