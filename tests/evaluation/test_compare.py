from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ebarf_ns.errors import TrajectoryError
from ebarf_ns.evaluation.compare import compare_files, read_beside_reference, read_by_reference
from ebarf_ns.formats.trajectory_formats import TrajectoryFormat
from ebarf_ns.geometry.trajectory_file import read_tum
from tests.conftest import DATA


@pytest.mark.parametrize("name", ["mocap-6dof", "mocap-desk2"])
def test_a_reference_tells_the_order_of_real_quaternions(name: str):
    folder = DATA / "trajectories"
    if not folder.is_dir():
        pytest.skip(f"no trajectories at {DATA}; set EBARF_TEST_DATA to their folder")
    reference = read_tum(folder / f"TUM-VIE_{name}_gt_esptam.txt")
    for spelling, order in (("deio", "xyzw"), ("deio_original", "yzwx")):
        _, notes = read_by_reference(folder / f"TUM-VIE_{name}_{spelling}.txt", reference)
        assert any(f"{order}, camera-to-world fits" in note for note in notes), notes


def test_where_the_motion_cannot_tell_it_says_so(tmp_path: Path):
    line = "".join(f"{k}.0 {k} 0 0 0.5 0.5 0.5 0.5\n" for k in range(10))
    (tmp_path / "t.txt").write_text(line)
    with pytest.raises(TrajectoryError, match="which cannot be told"):
        read_by_reference(tmp_path / "t.txt", read_tum(tmp_path / "t.txt"))
    still = "".join(f"{k}.0 {k} {k * k} 0 0.5 0.5 0.5 0.5\n" for k in range(10))
    (tmp_path / "t.txt").write_text(still)
    with pytest.raises(TrajectoryError, match="which this motion cannot tell"):
        read_by_reference(tmp_path / "t.txt", read_tum(tmp_path / "t.txt"))


COLUMNS = {"xyzw": [0, 1, 2, 3], "wxyz": [3, 0, 1, 2], "yzwx": [1, 2, 3, 0]}
TIMES = {"s": lambda t: f"{t:.6f}", "ms": lambda t: f"{1e3 * t:.3f}", "us": lambda t: f"{1e6 * t:.0f}",
         "us with a point": lambda t: f"{1e6 * t:.1f}", "ns": lambda t: f"{1e9 * t:.0f}"}  # fmt: skip


def motion(path: Path, unit: str, order: str, noise_deg: float = 0.0, straight: bool = False) -> Path:
    """Two seconds of a curve and turns about all axes."""
    t = np.arange(0, 2, 0.05)
    position = np.stack([t, 0 * t if straight else np.sin(3 * t), 0 * t if straight else np.cos(2 * t)], axis=1)
    turn = Rotation.from_rotvec(np.stack([0.3 * np.sin(2 * t), 0.2 * t, 0.4 * np.cos(t)], axis=1))
    noise = np.random.default_rng(0).normal(0, np.radians(noise_deg), (len(t), 3))
    quat = (turn * Rotation.from_rotvec([1.0, 0.5, 0.2]) * Rotation.from_rotvec(noise)).as_quat()[:, COLUMNS[order]]
    lines = [
        f"{TIMES[unit](a)} {' '.join(f'{v:.9f}' for v in (*b, *c))}\n"
        for a, b, c in zip(t, position, quat, strict=True)
    ]
    path.write_text("".join(lines))
    return path


@pytest.mark.parametrize("unit", list(TIMES))
@pytest.mark.parametrize("order", list(COLUMNS))
def test_a_reference_tells_the_order_in_any_unit_of_time(tmp_path: Path, unit: str, order: str):
    reference = motion(tmp_path / "reference.txt", "s", "xyzw")
    estimate = motion(tmp_path / "estimate.txt", unit, order, noise_deg=1)
    trajectory, notes = read_beside_reference(estimate, read_tum(reference))
    assert float((trajectory.poses.quat_wxyz * read_tum(reference).poses.quat_wxyz).sum(-1).abs().min()) > 0.999
    taken = [note for note in notes if "fits the reference to" in note]
    assert bool(taken) == (order != "xyzw" or "point" in unit) and all(order in note for note in taken), notes
    compared = compare_files(estimate, reference)
    assert compared["se3"]["rotation_deg"] < 3 and set(taken) <= set(compared["notes"])


def test_what_is_told_goes_before_what_the_reference_says(tmp_path: Path):
    reference = motion(tmp_path / "reference.txt", "s", "xyzw")
    estimate = motion(tmp_path / "estimate.txt", "s", "wxyz")
    _, notes = read_beside_reference(estimate, read_tum(reference), TrajectoryFormat(quaternion="xyzw"))
    assert "quaternions x y z w" in notes[0] and not any("fits" in note for note in notes)


def test_on_a_line_the_rotations_ask_for_another_order(tmp_path: Path):
    reference = motion(tmp_path / "reference.txt", "s", "xyzw", straight=True)
    estimate = motion(tmp_path / "estimate.txt", "s", "yzwx", straight=True)
    _, notes = read_beside_reference(estimate, read_tum(reference))
    assert "quaternions x y z w" in notes[0] and notes[-1].endswith("--quaternion yzwx?")


def test_a_reference_in_whole_seconds_is_told_by_the_estimate(tmp_path: Path):
    lines = [line.split() for line in motion(tmp_path / "estimate.txt", "s", "xyzw").read_text().splitlines()]
    for name, spell in (("reference.txt", "{}"), ("estimate.txt", "{}.5")):
        text = "".join(" ".join([spell.format(k), *line[1:]]) + "\n" for k, line in enumerate(lines))
        (tmp_path / name).write_text(text)
    known = TrajectoryFormat(pose_time_unit="s")
    assert compare_files(tmp_path / "estimate.txt", tmp_path / "reference.txt", known)["matched"] == len(lines) - 1
    with pytest.raises(TrajectoryError, match=r"reference\.txt: .* plausible spacing in s and in ms"):
        compare_files(tmp_path / "estimate.txt", tmp_path / "reference.txt")
