"""Columns by name, mistakes in the first lines, equal times and unknown time units."""

from pathlib import Path

import numpy as np
import pytest

from ebarf_ns.errors import TrajectoryError
from ebarf_ns.evaluation.compare import read_beside_reference
from ebarf_ns.formats.trajectory_formats import TrajectoryFormat, read_trajectory
from ebarf_ns.geometry.trajectory_file import read_tum
from tests.formats.test_trajectory_formats import COUNT, POSITION, QUAT, T_US, TURN, check, matrices, rows, seconds, tum

WXYZ = QUAT[:, [3, 0, 1, 2]]
NS = [str(1000 * t) for t in T_US.tolist()]


def table(header: str, *columns: object) -> str:
    """Comma-separated rows below a header line; a scalar is repeated in every row."""
    lines = [header]
    for k in range(COUNT):
        cells = []
        for column in columns:
            value = column if isinstance(column, str) else column[k]  # pyright: ignore[reportIndexIssue]
            cells += [f"{v:.12f}" for v in value] if isinstance(value, np.ndarray) else [str(value)]
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


EUROC = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], "
    "b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]"
)
STAMPED = "field.header.stamp,field.header.frame_id"
POINT = ",".join(f"field.pose.position.{axis}" for axis in "xyz")
ORIENTATION = ",".join(f"field.pose.orientation.{axis}" for axis in "xyzw")
SECS = [str(t // 10**6) for t in T_US.tolist()]
NSECS = [str(t % 10**6 * 1000) for t in T_US.tolist()]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            table(EUROC, NS, POSITION, WXYZ, *["0.5"] * 9),
            "left out: 9 other columns (v_RS_R_x, v_RS_R_y, v_RS_R_z, ...",
        ),
        (
            table(f"%time,{STAMPED},{POINT},{ORIENTATION}", "7", NS, "world", POSITION, QUAT),
            "left out: 2 other columns",
        ),
        (
            table(
                f"Time,header.stamp.secs,header.stamp.nsecs,frame,{POINT},{ORIENTATION}",
                "1",
                SECS,
                NSECS,
                "",
                POSITION,
                QUAT,
            ),
            "left out: 2 other columns (Time, frame)",
        ),
        (table("id,timestamp [us],tx,ty,tz,qw,qx,qy,qz", [*map(str, range(COUNT))], T_US, POSITION, WXYZ), "(id)"),
        (table(",t_us,x,y,z,qx,qy,qz,qw", [*map(str, range(COUNT))], T_US, POSITION, QUAT), "(one without a name)"),
        (table("q_w,q_x,q_y,q_z,p_x,p_y,p_z,time_ns", WXYZ, POSITION, NS), "times in ns, quaternions w x y z"),
        (table("Time [ns],Pos X,Pos Y,Pos Z,Quat X,Quat Y,Quat Z,Quat W", NS, POSITION, QUAT), "TUM text"),
        (table("# made today", [*map(str, range(COUNT))], seconds(T_US), POSITION, QUAT), "which counts the lines"),
    ],
)
def test_column_names_locate_the_pose(tmp_path: Path, text: str, said: str):
    for name, content, encoding in (
        ("t.csv", text, "utf-8"),
        ("crlf.csv", text.replace("\n", "\r\n"), "utf-8-sig"),
        ("semicolons.csv", text.replace(",", ";"), "utf-8"),
    ):
        (tmp_path / name).write_bytes(content.encode(encoding))
        trajectory, notes = read_trajectory(tmp_path / name)
        check(trajectory)
        assert any(said in note for note in notes), notes


def test_two_columns_of_one_name_are_an_error(tmp_path: Path):
    (tmp_path / "t.csv").write_text(table("t,a.p.x,b.p.x,p_y,p_z,qx,qy,qz,qw", seconds(T_US), "0", POSITION, QUAT))
    with pytest.raises(TrajectoryError, match=r"a\.p\.x and b\.p\.x mean the same"):
        read_trajectory(tmp_path / "t.csv")


def test_a_byte_order_mark_costs_no_pose(tmp_path: Path):
    (tmp_path / "bom.txt").write_bytes(tum("s").replace("\n", "\r\n").encode("utf-8-sig"))
    check(read_trajectory(tmp_path / "bom.txt")[0])
    check(read_tum(tmp_path / "bom.txt"))
    np.save(tmp_path / "poses.npy", matrices())
    (tmp_path / "times.txt").write_bytes("\n".join(seconds(T_US)).encode("utf-8-sig"))
    check(read_trajectory(tmp_path / "poses.npy", TrajectoryFormat(pose_times=tmp_path / "times.txt"))[0])


@pytest.mark.parametrize(
    "first", ["0.0OO 0 0 0 0 0 0 1", "nan 0 0 0 0 0 0 1", "O.0 0 0 0 0 0 0 1", "0,0 0 0 0 0 0 0 1", "0"]
)
def test_a_first_line_with_a_mistake_is_not_a_header(tmp_path: Path, first: str):
    (tmp_path / "t.txt").write_text("# a comment\n" + first + "\n" + tum("s"))
    with pytest.raises(TrajectoryError, match=r"t\.txt:2: .*expected"):
        read_trajectory(tmp_path / "t.txt")


@pytest.mark.parametrize(
    ("times", "words"),
    [
        (["1604644894.000000"] * COUNT, "t.txt:2: time 1604644894.000000 again, expected times that increase"),
        ([str(k - (k == 6)) for k in range(COUNT)], "t.txt:7: time 5 again, expected"),
        ([str(k % 6) for k in range(COUNT)], "t.txt:7: time 0 again, as in line 1, expected"),
        (["5"], "t.txt: holds 1 pose, expected 2"),
        ([f"{k * 0.05 + (k == 3) * -0.0499999:.7f}" for k in range(COUNT)], "are in one microsecond"),
    ],
)
def test_equal_times_are_named(tmp_path: Path, times: list[str], words: str):
    (tmp_path / "t.txt").write_text(rows(times, np.hstack([POSITION, QUAT])[: len(times)]))
    with pytest.raises(TrajectoryError) as caught:
        read_trajectory(tmp_path / "t.txt")
    assert words in str(caught.value)


@pytest.mark.parametrize("rate", [500, 200, 100, 60, 30, 20, 10, 5])
@pytest.mark.parametrize("start_ms", [0, 1_604_644_894_000])
def test_milliseconds_are_asked_for_where_another_unit_is_as_plausible(tmp_path: Path, rate: int, start_ms: int):
    times_ms = [start_ms + 1000 * k / rate for k in range(COUNT)]
    (tmp_path / "t.txt").write_text(rows([f"{t:.3f}" for t in times_ms], np.hstack([POSITION, QUAT])))
    t_us = np.array([round(1000 * float(f"{t:.3f}")) for t in times_ms])
    if start_ms == 0 and rate in (500, 200, 100, 10, 5):
        other = "s and in ms" if rate >= 100 else "ms and in us"
        with pytest.raises(TrajectoryError, match=f"plausible spacing in {other}; expected --pose-time-unit"):
            read_trajectory(tmp_path / "t.txt", span_us=(0, int(t_us[-1])))
    else:
        check(read_trajectory(tmp_path / "t.txt")[0], t_us)
    check(read_trajectory(tmp_path / "t.txt", TrajectoryFormat("ms"))[0], t_us)
    (tmp_path / "named.txt").write_text("# time [ms] x y z qx qy qz qw\n" + (tmp_path / "t.txt").read_text())
    check(read_trajectory(tmp_path / "named.txt")[0], t_us)


@pytest.mark.parametrize(("unit_us", "step"), [(10**6, 1), (10**6, 5), (1, 200)])
def test_the_events_distinguish_seconds_and_microseconds_from_milliseconds(tmp_path: Path, unit_us: int, step: int):
    t_us = unit_us * step * np.arange(COUNT)
    (tmp_path / "t.txt").write_text(rows([str(step * k) for k in range(COUNT)], np.hstack([POSITION, QUAT])))
    check(read_trajectory(tmp_path / "t.txt", span_us=(int(t_us[2]), int(t_us[-2])))[0], t_us)


@pytest.mark.parametrize("shape", [(-1, 4, 4), (-1, 3, 4), (-1, 16), (-1, 12)])
def test_matrices_as_npy(tmp_path: Path, shape: tuple[int, ...]):
    square = np.concatenate([matrices(), np.tile([[[0.0, 0, 0, 1]]], (COUNT, 1, 1))], axis=1)
    np.save(
        tmp_path / "poses.npy", (square if shape[-1] in (4, 16) and shape[1] != 3 else square[:, :3]).reshape(shape)
    )
    known = TrajectoryFormat(pose_times=tmp_path / "times.txt")
    (tmp_path / "times.txt").write_text("\n".join(map(str, T_US)))
    trajectory, notes = read_trajectory(tmp_path / "poses.npy", known)
    check(trajectory)
    assert f"matrices, {COUNT} poses, times in us" in notes[0]
    with pytest.raises(TrajectoryError, match="expected --pose-times with a line for each of its 12 poses"):
        read_trajectory(tmp_path / "poses.npy")
    np.save(tmp_path / "timed.npy", np.c_[T_US - T_US[0], square.reshape(COUNT, 16)])
    check(read_trajectory(tmp_path / "timed.npy")[0], T_US - T_US[0])


def test_arrays_other_than_matrices_are_named(tmp_path: Path):
    square = np.concatenate([matrices(), np.tile([[[0.0, 0, 0, 1]]], (COUNT, 1, 1))], axis=1)
    (tmp_path / "times.txt").write_text("\n".join(map(str, T_US)))
    known = TrajectoryFormat(pose_times=tmp_path / "times.txt")
    lost = square.copy()
    lost[4, 0, 3] = np.nan
    for content, words in (
        (square.transpose(0, 2, 1), "the last row of matrix 0 is"),
        (2 * square[:, :3], "the matrix of pose 0 is not a rotation"),
        (lost, "pose 4: a number is not finite"),
        (square[0], r"shape \(4, 4\), expected matrices \(poses, 4, 4\)"),
        (square[:5], "12 times, expected one for each of the 5 poses"),
    ):
        np.save(tmp_path / "poses.npy", content)
        with pytest.raises(TrajectoryError, match=words):
            read_trajectory(tmp_path / "poses.npy", known)


def test_frame_numbers_are_not_times_if_there_are_times(tmp_path: Path):
    lines = "".join(f"{k} {' '.join(map(repr, m.ravel().tolist()))}\n" for k, m in enumerate(matrices()))
    (tmp_path / "poses.txt").write_text(lines)
    (tmp_path / "times.txt").write_text("\n".join(map(str, T_US)))
    check(read_trajectory(tmp_path / "poses.txt", TrajectoryFormat(pose_times=tmp_path / "times.txt"))[0])


@pytest.mark.parametrize(
    ("header", "pose"),
    [
        ("t,x,y,z,rw,rx,ry,rz", (POSITION, WXYZ)),
        ("Time,RW,RX,RY,RZ,TX,TY,TZ", (WXYZ, POSITION)),
        ("timestamp,x,y,z,w,i,j,k", (POSITION, WXYZ)),
        ("time,pos.x,pos.y,pos.z,ori.w,ori.x,ori.y,ori.z", (POSITION, WXYZ)),
        ("time,px,py,pz,q_real,q_i,q_j,q_k", (POSITION, WXYZ)),
        ("time,p[0],p[1],p[2],quat_i,quat_j,quat_k,quat_scalar", (POSITION, QUAT)),
        ("Zeit,X,Y,Z,QW,QX,QY,QZ", (POSITION, WXYZ)),
        ("# format: timestamp position quaternion(w,x,y,z)", (POSITION, WXYZ)),
        ("# t x y z w x y z", (POSITION, WXYZ)),
        ("# t x y z x y z w", (POSITION, QUAT)),
        ("# quaternion is scalar first, Hamilton", (POSITION, WXYZ)),
        ("# the quaternion has w last", (POSITION, QUAT)),
        ("# made by a program of mine that day", (POSITION, QUAT)),
    ],
)
def test_the_order_of_a_quaternion_is_read_in_many_words(tmp_path: Path, header: str, pose: tuple[np.ndarray, ...]):
    (tmp_path / "t.csv").write_text(table(header, seconds(T_US), *pose))
    check(read_trajectory(tmp_path / "t.csv")[0])


@pytest.mark.parametrize(
    ("header", "named"),
    [
        ("time,X,Y,Z,q0,q1,q2,q3", "q0, q1, q2, q3"),
        ("t,x,y,z,q1,q2,q3,q4", "q1, q2, q3, q4"),
        ("# t x y z q1 q2 q3 q4", "q1, q2, q3, q4"),
        ("t,x,y,z,a,b,c,d", "a, b, c, d"),
        ("when,a,b,c,d,e,f,g", "d, e, f, g"),
        ("# w first, formerly x y z w", "'w first' and 'x y z w'"),
    ],
)
def test_an_order_that_names_do_not_tell_is_asked_for(tmp_path: Path, header: str, named: str):
    (tmp_path / "t.csv").write_text(table(header, seconds(T_US), POSITION, WXYZ))
    with pytest.raises(TrajectoryError, match=f"{named}.*expected --quaternion"):
        read_trajectory(tmp_path / "t.csv")
    check(read_trajectory(tmp_path / "t.csv", TrajectoryFormat(quaternion="wxyz"))[0])


def test_a_reference_tells_the_order_that_names_do_not(tmp_path: Path):
    (tmp_path / "t.csv").write_text(table("t,x,y,z,q0,q1,q2,q3", seconds(T_US), POSITION, WXYZ))
    (tmp_path / "reference.txt").write_text(tum("s"))
    reference, _ = read_trajectory(tmp_path / "reference.txt")
    check(read_beside_reference(tmp_path / "t.csv", reference)[0])


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("t,north,east,down,qx,qy,qz,qw", "columns north, east, down are not understood, expected names such as t, x"),
        ("t,x,y,z,roll,pitch,yaw,valid", "columns roll, pitch, yaw, valid are not understood.* angles are not read"),
    ],
)
def test_columns_that_are_no_pose_are_named(tmp_path: Path, header: str, words: str):
    (tmp_path / "t.csv").write_text(table(header, seconds(T_US), POSITION, QUAT))
    with pytest.raises(TrajectoryError, match=words):
        read_trajectory(tmp_path / "t.csv")


@pytest.mark.parametrize(
    ("header", "before"), [("exposure [ms],time [s]", "10"), ("latency [us],timestamp", "10"), ("n [],t [s]", "1")]
)
def test_the_unit_of_time_is_that_in_its_own_brackets(tmp_path: Path, header: str, before: str):
    text = table(f"{header},x [m],y [m],z [m],qx,qy,qz,qw", before, seconds(T_US), POSITION, QUAT)
    (tmp_path / "t.csv").write_text(text)
    trajectory, notes = read_trajectory(tmp_path / "t.csv")
    check(trajectory)
    assert "times in s" in notes[0]


@pytest.mark.parametrize("comment", ["world to camera (T_cw)", "poses are w2c", "camera from world"])
def test_comments_tell_the_direction_of_poses(tmp_path: Path, comment: str):
    inverse = TURN.inv()
    poses = np.hstack([-inverse.apply(POSITION), inverse.as_quat()])
    (tmp_path / "t.txt").write_text(f"# {comment}\n# timestamp tx ty tz qx qy qz qw\n" + rows(seconds(T_US), poses))
    trajectory, notes = read_trajectory(tmp_path / "t.txt")
    check(trajectory)
    assert any("as its comments say" in note for note in notes)
    (tmp_path / "both.txt").write_text(f"# {comment}, not c2w\n" + rows(seconds(T_US), poses))
    with pytest.raises(TrajectoryError, match="say both .* expected --transform"):
        read_trajectory(tmp_path / "both.txt")
    check(read_trajectory(tmp_path / "both.txt", TrajectoryFormat(transform="world-to-camera"))[0])


def test_decimal_commas_between_blanks_are_named(tmp_path: Path):
    (tmp_path / "t.txt").write_text(tum("s").replace(".", ","))
    with pytest.raises(TrajectoryError, match=r"t\.txt:1: .* has a decimal comma"):
        read_trajectory(tmp_path / "t.txt")


def test_a_repeated_time_is_shown_as_it_is_written(tmp_path: Path):
    (tmp_path / "t.txt").write_text(2 * rows([f"{0.05 * k:.9f}" for k in range(COUNT)], np.hstack([POSITION, QUAT])))
    with pytest.raises(TrajectoryError, match=r"time 0\.000000000 again, as in line 1"):
        read_trajectory(tmp_path / "t.txt")
