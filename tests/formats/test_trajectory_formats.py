"""One motion, written in the formats of many programs, is read back as the same motion."""

import struct
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ebarf_ns.errors import TrajectoryError
from ebarf_ns.formats.trajectory_formats import TrajectoryFormat, read_trajectory
from ebarf_ns.geometry.trajectory import Trajectory
from tests.conftest import DATA

COUNT = 12
T_US = 1_600_000_000_000_000 + 40_000 * np.arange(COUNT)
POSITION = np.random.default_rng(0).standard_normal((COUNT, 3))
TURN = Rotation.from_rotvec(np.cumsum(0.3 * np.random.default_rng(1).standard_normal((COUNT, 3)), axis=0))
QUAT = TURN.as_quat()


def rows(times: list[str], columns: np.ndarray) -> str:
    return "".join(f"{t} {' '.join(f'{v:.12f}' for v in row)}\n" for t, row in zip(times, columns, strict=True))


def seconds(t_us: np.ndarray) -> list[str]:
    return [f"{t // 10**6}.{t % 10**6:06d}" for t in t_us.tolist()]


def tum(unit: str) -> str:
    times = {"s": seconds(T_US), "us": [str(t) for t in T_US], "ns": [str(1000 * t) for t in T_US]}[unit]
    return rows(times, np.hstack([POSITION, QUAT]))


def matrices(turn: Rotation = TURN, position: np.ndarray = POSITION) -> np.ndarray:
    return np.concatenate([turn.as_matrix(), position[..., None]], axis=-1)


def check(trajectory: Trajectory, t_us: np.ndarray = T_US) -> None:
    assert trajectory.t_us.tolist() == t_us.tolist()
    assert np.allclose(trajectory.poses.position.numpy(), POSITION, atol=1e-9)
    back = Rotation.from_quat(trajectory.poses.quat_wxyz.numpy()[:, [1, 2, 3, 0]])
    assert (back * TURN.inv()).magnitude().max() < 1e-9


@pytest.mark.parametrize("unit", ["s", "us", "ns"])
def test_tum_in_any_unit_of_time(tmp_path: Path, unit: str):
    (tmp_path / "t.txt").write_text("# a comment\n" + tum(unit))
    trajectory, notes = read_trajectory(tmp_path / "t.txt")
    check(trajectory)
    assert f"times in {unit}" in notes[0]


def test_unsorted_poses_are_sorted_and_reported(tmp_path: Path):
    lines = tum("s").splitlines()
    (tmp_path / "t.txt").write_text("\n".join(lines[::-1]))
    trajectory, notes = read_trajectory(tmp_path / "t.txt")
    check(trajectory)
    assert any("sorted" in note for note in notes)


def test_mocap_data_of_tum_vie(tmp_path: Path):
    text = "#timestamp [us] px [m] py [m] pz [m] qx qy qz qw\n" + tum("us")
    (tmp_path / "mocap_data.txt").write_text(text)
    check(read_trajectory(tmp_path / "mocap_data.txt")[0])


def test_devos_quaternion_order_must_be_given(tmp_path: Path):
    text = rows([f"{float(t)}" for t in T_US], np.hstack([POSITION, QUAT[:, [1, 2, 3, 0]]]))
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(TrajectoryError, match="expected --quaternion yzwx"):
        read_trajectory(tmp_path / "t.txt")
    check(read_trajectory(tmp_path / "t.txt", TrajectoryFormat(quaternion="yzwx"))[0])


@pytest.mark.parametrize(
    ("header", "order"),
    [
        (
            "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []",
            [3, 0, 1, 2],
        ),
        ("# made by a program\ntimestamp,tx,ty,tz,qw,qx,qy,qz", [3, 0, 1, 2]),
        ("# timestamp tx ty tz qx qy qz qw", [0, 1, 2, 3]),
    ],
)
def test_a_header_gives_the_quaternion_order(tmp_path: Path, header: str, order: list[int]):
    (tmp_path / "t.txt").write_text(
        header + "\n" + rows([str(1000 * t) for t in T_US], np.hstack([POSITION, QUAT[:, order]]))
    )
    check(read_trajectory(tmp_path / "t.txt")[0])


def test_a_comment_without_names_does_not_give_devos_order(tmp_path: Path):
    text = rows([f"{float(t)}" for t in T_US], np.hstack([POSITION, QUAT[:, [1, 2, 3, 0]]]))
    (tmp_path / "t.txt").write_text("# run 3\n" + text)
    with pytest.raises(TrajectoryError, match="expected --quaternion yzwx"):
        read_trajectory(tmp_path / "t.txt")


def test_a_spacing_that_fits_two_units_is_asked_for(tmp_path: Path):
    since_start_ns = [str(10**6 * k) for k in range(COUNT)]
    (tmp_path / "t.txt").write_text(rows(since_start_ns, np.hstack([POSITION, QUAT])))
    with pytest.raises(TrajectoryError, match="plausible spacing in us and in ns; expected --pose-time-unit"):
        read_trajectory(tmp_path / "t.txt")
    check(read_trajectory(tmp_path / "t.txt", TrajectoryFormat("ns"))[0], 1000 * np.arange(COUNT))


def test_times_by_number_and_name(tmp_path: Path):
    (tmp_path / "kitti.txt").write_text("\n".join(" ".join(map(repr, m.ravel().tolist())) for m in matrices()))
    (tmp_path / "times.txt").write_text("\n".join(f"{k} {t}" for k, t in enumerate(seconds(T_US))))
    known = TrajectoryFormat(pose_times=tmp_path / "times.txt")
    check(read_trajectory(tmp_path / "kitti.txt", known)[0])
    with pytest.raises(TrajectoryError, match=r"gone.txt: cannot be read"):
        read_trajectory(tmp_path / "kitti.txt", TrajectoryFormat(pose_times=tmp_path / "gone.txt"))


def test_quaternions_first_and_world_to_camera(tmp_path: Path):
    inverse = TURN.inv()
    text = rows(seconds(T_US), np.hstack([-inverse.apply(POSITION), inverse.as_quat()[:, [3, 0, 1, 2]]]))
    (tmp_path / "t.txt").write_text(text)
    check(read_trajectory(tmp_path / "t.txt", TrajectoryFormat(quaternion="wxyz", transform="world-to-camera"))[0])


def test_kitti_with_times(tmp_path: Path):
    (tmp_path / "kitti.txt").write_text("\n".join(" ".join(map(repr, m.ravel().tolist())) for m in matrices()))
    (tmp_path / "times.txt").write_text("\n".join(seconds(T_US)))
    check(read_trajectory(tmp_path / "kitti.txt", TrajectoryFormat(pose_times=tmp_path / "times.txt"))[0])
    with pytest.raises(TrajectoryError, match="expected --pose-times"):
        read_trajectory(tmp_path / "kitti.txt")


def test_opengl_axes(tmp_path: Path):
    turned = TURN * Rotation.from_matrix(np.diag([1.0, -1, -1]))
    lines = [
        f"{t} {' '.join(map(repr, np.vstack([m, [0, 0, 0, 1]]).ravel().tolist()))}"
        for t, m in zip(seconds(T_US), matrices(turned), strict=True)
    ]
    (tmp_path / "t.txt").write_text("\n".join(lines))
    check(read_trajectory(tmp_path / "t.txt", TrajectoryFormat(axes="opengl"))[0])


def colmap_images() -> list[tuple[str, np.ndarray]]:
    inverse = TURN.inv()
    poses = np.hstack([inverse.as_quat()[:, [3, 0, 1, 2]], -inverse.apply(POSITION)])
    return [(f"frame_{k:04d}.png", pose) for k, pose in enumerate(poses)]


@pytest.mark.parametrize("binary", [False, True])
def test_colmap_models(tmp_path: Path, binary: bool):
    images = colmap_images()[::-1]
    if binary:
        content = struct.pack("<Q", len(images))
        for k, (name, pose) in enumerate(images):
            content += struct.pack("<I7dI", k, *pose, 1) + name.encode() + b"\0" + struct.pack("<Q", 1) + bytes(24)
        (tmp_path / "images.bin").write_bytes(content)
    else:
        lines = ["# Image list"]
        for k, (name, pose) in enumerate(images):
            lines += [f"{k + 1} {' '.join(map(repr, pose.tolist()))} 1 {name}", "1.0 2.0 -1" if k % 2 else ""]
        (tmp_path / "images.txt").write_text("\n".join(lines) + "\n")
    (tmp_path / "times.txt").write_text("\n".join(f"frame_{k:04d}.png {t}" for k, t in enumerate(T_US)))
    trajectory, notes = read_trajectory(tmp_path, TrajectoryFormat(pose_times=tmp_path / "times.txt"))
    check(trajectory)
    assert "COLMAP" in notes[0] and "world-to-camera" in notes[0]


def test_times_without_names_follow_the_numbers_of_images(tmp_path: Path):
    lines = [
        f"{k + 1} {' '.join(map(repr, pose.tolist()))} 1 frame_{k}.png\n" for k, (_, pose) in enumerate(colmap_images())
    ]
    (tmp_path / "images.txt").write_text("\n".join(sorted(lines)) + "\n")
    (tmp_path / "times.txt").write_text("\n".join(map(str, T_US)))
    trajectory, notes = read_trajectory(tmp_path, TrajectoryFormat(pose_times=tmp_path / "times.txt"))
    check(trajectory)
    assert any(f"images from frame_0.png to frame_{COUNT - 1}.png in order" in note for note in notes)


def test_llff(tmp_path: Path):
    llff = TURN * Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    table = np.concatenate([matrices(llff), np.ones((COUNT, 3, 1))], axis=-1).reshape(COUNT, 15)
    np.save(tmp_path / "poses_bounds.npy", np.hstack([table, np.ones((COUNT, 2))]))
    (tmp_path / "times.txt").write_text("\n".join(map(str, T_US)))
    check(read_trajectory(tmp_path / "poses_bounds.npy", TrajectoryFormat(pose_times=tmp_path / "times.txt"))[0])


def test_m3ed(tmp_path: Path):
    world_to_camera = np.linalg.inv([np.vstack([m, [0, 0, 0, 1]]) for m in matrices()])
    with h5py.File(tmp_path / "pose_gt.h5", "w") as file:
        file["Cn_T_C0"], file["ts"] = world_to_camera, np.array(T_US, float)
    check(read_trajectory(tmp_path / "pose_gt.h5")[0])
    with h5py.File(tmp_path / "short.h5", "w") as file:
        file["Cn_T_C0"], file["ts"] = world_to_camera[:2], np.array(T_US, float)
    with pytest.raises(TrajectoryError, match="Cn_T_C0 is of shape"):
        read_trajectory(tmp_path / "short.h5")
    (tmp_path / "none.h5").write_bytes(b"nothing")
    with pytest.raises(TrajectoryError, match="cannot be read"):
        read_trajectory(tmp_path / "none.h5")


def test_robust_e_nerf(tmp_path: Path):
    np.savez(tmp_path / "camera_poses.npz", T_wc_position=POSITION, T_wc_orientation=QUAT, T_wc_timestamp=T_US * 1000)
    check(read_trajectory(tmp_path / "camera_poses.npz")[0])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "holds no poses"),
        ("1 2 3\n", "3 columns, expected 8"),
        ("0 0 0 0 0 0 0 1\n1e9999999 0 0 0 0 0 0 1\n", ":2: "),
        ("0 0 0 0 0 0 0 2\n1 0 0 0 0 0 0 1\n", "has length 2, expected 1"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 zero 0 0 1\n", ":2: "),
        ("0 0 0 0 0 0 0 1\n1 0 0\n", "3 columns, expected 8 as before"),
        ("0 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n", ":2: time 0 again, expected times that increase"),
        ("0 0 0 0 0 0 0 1\n1e11 0 0 0 0 0 0 1\n", "plausible spacing in no unit"),
        ("2 0 0 0 0 0 0 0 0 0 0 0 0\n" * 3, "is not a rotation"),
    ],
)
def test_files_without_a_trajectory_are_named(tmp_path: Path, content: str, words: str):
    (tmp_path / "t.txt").write_text(content)
    with pytest.raises(TrajectoryError) as caught:
        read_trajectory(tmp_path / "t.txt")
    assert words in str(caught.value) and "t.txt" in str(caught.value)


@pytest.mark.parametrize("name", ["mocap-1d-trans", "mocap-6dof", "mocap-desk2"])
def test_real_estimates_in_both_spellings(name: str):
    folder = DATA / "trajectories"
    if not folder.is_dir():
        pytest.skip(f"no trajectories at {DATA}; set EBARF_TEST_DATA to their folder")
    plain, _ = read_trajectory(folder / f"TUM-VIE_{name}_deio.txt")
    original, _ = read_trajectory(folder / f"TUM-VIE_{name}_deio_original.txt", TrajectoryFormat(quaternion="yzwx"))
    assert plain.t_us.tolist() == original.t_us.tolist()
    assert np.allclose(plain.poses.position, original.poses.position, atol=1e-5)
    products = (plain.poses.quat_wxyz * original.poses.quat_wxyz).sum(-1).abs()
    assert float(products.min()) > 1 - 1e-6


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("t.txt", tum("s").encode("utf-16"), "text in UTF-16, expected poses as text in UTF-8"),
        ("poses.mat", b"MATLAB 5.0 MAT-file\x00\xff", "a MATLAB file, expected"),
        ("events.bag", b"#ROSBAG V2.0\n\xff", "a ROS bag, expected"),
        ("t.txt", b"\xe9\xe8", "not text in UTF-8, expected"),
        ("transforms.json", b'{"fl_x": 42, "frames": []}', "as JSON or XML does, expected"),
        ("poses.h5", b"nothing", "cannot be read .not a whole HDF5 file."),
    ],
)
def test_other_kinds_of_files_are_named(tmp_path: Path, name: str, content: bytes, words: str):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(TrajectoryError, match=words):
        read_trajectory(tmp_path / name)


def test_arrays_of_other_names_are_listed(tmp_path: Path):
    np.savez(tmp_path / "t.npz", poses=matrices(), t=T_US)
    with pytest.raises(TrajectoryError, match=r"holds poses, t, expected T_wc_timestamp"):
        read_trajectory(tmp_path / "t.npz")
    with h5py.File(tmp_path / "t.h5", "w") as file:
        file["davis/poses"] = matrices()
    with pytest.raises(TrajectoryError, match=r"holds davis, expected Cn_T_C0 and ts"):
        read_trajectory(tmp_path / "t.h5")
    np.save(tmp_path / "t.npy", np.zeros(3, [("t", "i8"), ("x", "i2")]))
    with pytest.raises(TrajectoryError, match=r"an array of t, x, expected numbers"):
        read_trajectory(tmp_path / "t.npy")
