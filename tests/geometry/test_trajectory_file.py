from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ebarf_ns.errors import TrajectoryError
from ebarf_ns.geometry.trajectory import Poses, Trajectory
from ebarf_ns.geometry.trajectory_file import format_seconds, read_tum, write_tum

IDENTITY = "0 0 0 0 0 0 1"


def read(tmp_path: Path, content: str | bytes) -> Trajectory:
    path = tmp_path / "poses.txt"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_tum(path)


def test_times_are_exact_and_quaternions_scalar_last(tmp_path: Path):
    content = f"# comment\n\n1700000000.0000015 1 2 3 0.6 0 0 0.8 # note\n1700000000.25,{IDENTITY.replace(' ', ',')}\n"
    trajectory = read(tmp_path, content)
    assert trajectory.t_us.tolist() == [1_700_000_000_000_002, 1_700_000_000_250_000]
    assert trajectory.poses.quat_wxyz[0].tolist() == pytest.approx([0.8, 0.6, 0, 0])
    assert trajectory.poses.position[0].tolist() == [1, 2, 3]


@given(st.lists(st.integers(-(10**15), 10**15), min_size=2, max_size=20, unique=True))
def test_written_poses_read_back(tmp_path_factory: pytest.TempPathFactory, times: list[int]):
    times.sort()
    quat = torch.from_numpy(Rotation.random(len(times), np.random.default_rng(0)).as_quat())[:, [3, 0, 1, 2]]
    poses = Poses(torch.randn(len(times), 3, dtype=torch.float64), quat)
    path = tmp_path_factory.mktemp("tum") / "poses.txt"
    write_tum(path, Trajectory(torch.tensor(times), poses))
    back = read_tum(path)
    assert back.t_us.tolist() == times
    assert torch.allclose(back.poses.position, poses.position, atol=1e-8)
    assert torch.allclose(back.poses.quat_wxyz, poses.quat_wxyz, atol=1e-8)


def test_negative_times_are_written_correctly():
    assert format_seconds(-1_500_000) == "-1.500000" and format_seconds(-5) == "-0.000005"


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("0.2 0 0 0 0 0 0", ":2: 7 columns, expected the 8 of TUM format"),
        (f"0.2 {IDENTITY} 5", ":2: 9 columns"),
        ("0.2 0 0 zero 0 0 0 1", ":2: tz is 'zero', expected a number"),
        ("0.2 nan 0 0 0 0 0 1", ":2: tx is nan, expected a finite number"),
        ("0.2 0 0 0 0 0 inf 1", ":2: qz is inf, expected a finite number"),
        ("0.2 0 0 0 0 0 0 0", "has length 0, expected 1"),
        ("0.2 0 0 0 0 0 0 1.1", "has length 1.1, expected 1"),
        (f"0.1 {IDENTITY}", ":2: timestamp 0.1 is not after the one before it (100000 us)"),
        (f"0.05 {IDENTITY}", ":2: timestamp 0.05 is not after"),
        (f"1e20 {IDENTITY}", "does not fit 64-bit microseconds"),
        (f"1e999999 {IDENTITY}", "timestamp is 1e999999, expected a"),
        ("0.2 1e400 0 0 0 0 0 1", "tx is 1e400, expected a finite number"),
    ],
)
def test_bad_line_is_named(tmp_path: Path, line: str, words: str):
    with pytest.raises(TrajectoryError) as caught:
        read(tmp_path, f"0.1 {IDENTITY}\n{line}\n")
    assert words in str(caught.value) and str(tmp_path / "poses.txt") in str(caught.value)


@pytest.mark.parametrize("content", ["", f"0.1 {IDENTITY}\n", b"\xff\xfe\x00"])
def test_too_little_or_no_text(tmp_path: Path, content: str | bytes):
    with pytest.raises(TrajectoryError, match=r"poses\.txt: (a trajectory needs at least 2|cannot be read)"):
        read(tmp_path, content)


def test_missing_file(tmp_path: Path):
    with pytest.raises(TrajectoryError, match="No such file"):
        read_tum(tmp_path / "gone.txt")
