from pathlib import Path

import pytest

from ebarf_ns.errors import TrajectoryError
from ebarf_ns.evaluation.compare import read_by_reference
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
