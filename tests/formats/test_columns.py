"""Files with unnamed columns or time units: inferred from the values, or asked for by a flag."""

from itertools import permutations
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from ebarf_ns.errors import RecordingError
from ebarf_ns.formats.columns import guessed_unit, named, unit_of
from ebarf_ns.formats.intake import Intake, checked, take_in
from ebarf_ns.formats.recognise import open_recording
from ebarf_ns.formats.source import Source

SIZE = (64, 48)
ORDERS = ["".join(order) for order in permutations("txyp") if order.index("x") < order.index("y")]
FIELDS = ["t x y p", "x y timestamp polarity", "X Y TS POL", "t_us x_pos y_pos on", "p t y x"]


def events(count: int = 400) -> dict[str, np.ndarray]:
    random = np.random.default_rng(1)
    t = np.cumsum(random.integers(0, 400, count)) + 7
    return {
        "t": t,
        "x": random.integers(0, SIZE[0], count),
        "y": random.integers(0, SIZE[1], count),
        "p": random.integers(0, 2, count),
    }


def table(order: str, dtype: Any = np.int64, **changed: np.ndarray) -> np.ndarray:
    columns = events() | changed
    return np.stack([columns[role] for role in order], 1).astype(dtype)


def structured(fields: str) -> np.ndarray:
    array = np.zeros(400, [(name, "<i8" if name.lower()[0] == "t" else "<i2") for name in fields.split()])
    for name in fields.split():
        array[name] = events()[{"o": "p"}.get(name[0].lower(), name[0].lower())]
    return array


def save(path: Path, array: np.ndarray) -> Path:
    if path.suffix == ".npy":
        np.save(path, array)
    elif path.suffix == ".npz":
        np.savez(path, recording=array, size=np.array(SIZE))
    elif path.suffix == ".mat":
        savemat(path, {"recording": array})
    elif path.suffix == ".txt":
        np.savetxt(path, array, "%d", delimiter="\t")
    else:
        with h5py.File(path, "w") as file:
            file["data/raw"], file["other"] = array, np.zeros((7, 3))
    return path


def same(source: Source, step_us: float = 0.5) -> None:
    back, expected = checked(source, SIZE), events()
    assert np.abs(back.t_us - expected["t"]).max() <= step_us
    assert np.array_equal(back.x, expected["x"]) and np.array_equal(back.y, expected["y"])
    assert np.array_equal(back.polarity, 2 * expected["p"] - 1)


@pytest.mark.parametrize("suffix", [".txt", ".npy", ".npz", ".mat", ".h5"])
@pytest.mark.parametrize("order", ORDERS)
def test_rows_of_four_numbers_in_any_order(tmp_path: Path, suffix: str, order: str):
    source = open_recording(save(tmp_path / f"a{suffix}", table(order)))
    assert source.columns == order and f"columns {' '.join(order)}, " in source.notes[0]
    assert source.guessed_unit == "us"
    same(source)


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".mat", ".h5"])
@pytest.mark.parametrize("dtype", [np.uint32, np.float64])
def test_rows_of_four_numbers_of_any_type_and_across(tmp_path: Path, suffix: str, dtype: Any):
    rows = table("typx"[::-1], dtype) if suffix == ".h5" else table("xypt", dtype)
    with_x_first = table("xypt", dtype)
    same(open_recording(save(tmp_path / f"a{suffix}", with_x_first)))
    same(open_recording(save(tmp_path / f"b{suffix}", np.ascontiguousarray(with_x_first.T))))
    with pytest.raises(RecordingError):
        checked(open_recording(save(tmp_path / f"c{suffix}", rows[:, :3])), SIZE)


def test_orders_are_inferred_with_signed_polarities_and_unsorted_times(tmp_path: Path):
    changed = {"p": 2 * events()["p"] - 1}
    same(open_recording(save(tmp_path / "a.txt", table("xypt", **changed))))
    t = events()["t"] + 10**6
    t[[3, 9]] = t[[9, 3]]
    source = open_recording(save(tmp_path / "b.txt", table("xypt", t=t)))
    assert source.columns == "xypt" and "although times decrease" in source.notes[0]
    with pytest.raises(RecordingError, match="--unsorted sort"):
        checked(source, SIZE)


@pytest.mark.parametrize("suffix", [".txt", ".npy", ".h5"])
def test_an_ambiguous_order_asks_for_a_flag(tmp_path: Path, suffix: str):
    path = save(tmp_path / f"a{suffix}", table("txyp", t=3 * np.arange(400), x=np.arange(400) // 7))
    with pytest.raises(RecordingError, match="read as 't x y p' and as 'x t y p', expected --event-columns") as caught:
        open_recording(path)
    assert str(path) in str(caught.value)
    assert open_recording(path, columns="t x y p").columns == "txyp"


def test_a_stated_order_is_taken_and_checked(tmp_path: Path):
    path = save(tmp_path / "a.txt", table("tyxp"))
    with pytest.raises(RecordingError, match="are they swapped. Then use --event-columns 't y x p'"):
        checked(open_recording(path), SIZE)
    same(open_recording(path, columns="t, y, x, p"))
    with pytest.raises(RecordingError, match="--event-columns is 'xy', expected t, x, y and p once each"):
        open_recording(path, columns="xy")
    np.savez(tmp_path / "a.npz", **events())  # pyright: ignore[reportArgumentType]
    with pytest.raises(RecordingError, match="columns have names; expected no --event-columns"):
        open_recording(tmp_path / "a.npz", columns="xypt")


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".mat", ".h5"])
@pytest.mark.parametrize("fields", FIELDS)
def test_structured_arrays_by_the_names_of_their_fields(tmp_path: Path, suffix: str, fields: str):
    array = structured(fields)
    if suffix == ".mat":
        savemat(tmp_path / "a.mat", {"TD": {name: array[name] for name in array.dtype.names or ()}})
        source = open_recording(tmp_path / "a.mat")
    else:
        source = open_recording(save(tmp_path / f"a{suffix}", array))
    assert source.guessed_unit == (None if "t_us" in fields else "us")
    same(source)


def test_names_of_columns():
    assert named(["polarity", "Y", "x_pos", "timestamp"]) == dict(t="timestamp", x="x_pos", y="Y", p="polarity")
    assert named(["x", "y", "t"]) is None
    assert unit_of("timestamp_ns") == "ns" and unit_of("t [ms]") == "ms" and unit_of("ts") is None
    assert guessed_unit(np.array([0.0, 5.0])) == "us" and guessed_unit(np.array([0.0, 0.5])) == "s"
    assert guessed_unit(np.array([0.0, 0.0])) == "s"


@pytest.mark.parametrize("kind", ["npz", "h5", "structured", "table", "mat", "txt", "double"])
def test_single_precision_times_are_reported_as_coarse(tmp_path: Path, kind: str):
    late_s = 1504
    columns = events() | {"t": (late_s + events()["t"] * 1e-6).astype(np.float32)}
    path = tmp_path / ("a.npy" if kind in ("structured", "table", "double") else f"a.{kind}")
    if kind == "npz":
        np.savez(path, **columns)  # pyright: ignore[reportArgumentType]
    elif kind == "mat":
        savemat(path, columns)
    elif kind == "h5":
        with h5py.File(path, "w") as file:
            for name, column in columns.items():
                file[f"events/{name}"] = column
    elif kind == "txt":
        np.savetxt(path, np.stack(list(columns.values()), 1))
    elif kind in ("table", "double"):
        np.save(path, np.stack(list(columns.values()), 1).astype(np.float32 if kind == "table" else np.float64))
    else:
        array = np.zeros(400, [("t", "<f4"), ("x", "<i2"), ("y", "<i2"), ("p", "i1")])
        for name, column in columns.items():
            array[name] = column
        np.save(path, array)
    source = open_recording(path)
    report = take_in(source, SIZE, Intake(), tmp_path / "out.h5")
    was = "were" if kind in ("txt", "double") else "are"
    assert any(f"times {was} float32, with a resolution of 122 us at 1504." in line for line in report.sentences())


def test_a_folder_of_npz_is_read_by_the_numbers_of_its_files(tmp_path: Path):
    folder = tmp_path / "events"
    folder.mkdir()
    columns = events()
    np.savez(folder / "0.npz", **{name: column[:0] for name, column in columns.items()})  # pyright: ignore[reportArgumentType]
    for k in range(11):
        some = {name: column[40 * k : 40 * k + 40 if k < 10 else 400] for name, column in columns.items()}
        np.savez(folder / f"{k + 1}.npz", **some)  # pyright: ignore[reportArgumentType]
    source = open_recording(folder)
    assert source.format == "12 npz files, times in us"
    same(source)
    np.savez(folder / "13.npz", picture=np.zeros((3, 3)))
    with pytest.raises(RecordingError, match=r"13.npz: arrays picture \(3, 3\), expected x, y"):
        open_recording(folder)


def test_matlab_files_of_either_kind(tmp_path: Path):
    t, x, y, p = (events()[role] for role in "txyp")
    savemat(tmp_path / "a.mat", {"x": x.astype(float), "y": y[:, None], "ts": t.astype(float), "pol": 2 * p - 1})
    same(open_recording(tmp_path / "a.mat"))
    with h5py.File(tmp_path / "b.mat", "w", userblock_size=512) as file:
        for name, column in {"x": x, "y": y, "ts": t, "pol": p}.items():
            file[name] = column[None].astype(float)
    content = (tmp_path / "b.mat").read_bytes()
    (tmp_path / "b.mat").write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512) + content[512:])
    same(open_recording(tmp_path / "b.mat"))


def test_several_arrays_of_events_must_be_chosen_from(tmp_path: Path):
    np.savez(tmp_path / "a.npz", left=table("txyp"), right=table("xytp"))
    with pytest.raises(RecordingError, match="arrays left, right all look like events, expected one, or --part"):
        open_recording(tmp_path / "a.npz")
    same(open_recording(tmp_path / "a.npz", part="right"))
    with pytest.raises(RecordingError, match="has no array up, expected one of left, right"):
        open_recording(tmp_path / "a.npz", part="up")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["left"], file["right"] = table("txyp"), table("xytp")
    with pytest.raises(RecordingError, match="2 places hold events .*--part"):
        open_recording(tmp_path / "a.h5")
    same(open_recording(tmp_path / "a.h5", part="right"))


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".h5"])
def test_fields_with_uninformative_names_are_inferred_from_their_values(tmp_path: Path, suffix: str):
    array = np.zeros(400, [("f0", "<i2"), ("f1", "<i2"), ("f2", "<i8"), ("f3", "i1")])
    for field, role in zip(array.dtype.names or (), "xytp", strict=True):
        array[field] = events()[role]
    source = open_recording(save(tmp_path / f"a{suffix}", array))
    assert source.columns == "xytp"
    same(source)


def test_columns_without_names_and_matrices_of_poses(tmp_path: Path):
    np.savez(tmp_path / "a.npz", *(events()[role] for role in "pxyt"))
    same(open_recording(tmp_path / "a.npz"))
    others = {"K": np.eye(4), "pose": np.random.default_rng(0).normal(size=(30, 4)), "quaternions": np.zeros((4, 4))}
    np.savez(tmp_path / "b.npz", events=table("xypt"), **others)
    same(open_recording(tmp_path / "b.npz"))
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file["raw"] = table("ptxy")
        for name, matrix in others.items():
            file[name] = matrix
    same(open_recording(tmp_path / "c.h5"))
    with h5py.File(tmp_path / "c.h5", "a") as file:
        for role, column in events().items():
            file[f"named/{role}"] = column
    assert "events in /named," in open_recording(tmp_path / "c.h5").format
    same(open_recording(tmp_path / "c.h5", part="raw"))


def folder_of_npz(folder: Path, times: list[np.ndarray]) -> Path:
    folder.mkdir()
    for k, t in enumerate(times):
        part = slice(k * len(t), (k + 1) * len(t))
        rest = {name: column[part] for name, column in events().items() if name != "t"}
        np.savez(folder / f"ev_{k}.npz", t=t, **rest)  # pyright: ignore[reportArgumentType]
    return folder


def test_files_that_count_from_their_own_start_are_not_laid_over_each_other(tmp_path: Path):
    parts = np.split(events()["t"], 4)
    with pytest.raises(RecordingError, match=r"ev_1.npz: times from 3 to .* ev_0.npz, 0 to .*from its own start\?"):
        checked(open_recording(folder_of_npz(tmp_path / "anew", [t - t[0] + 3 * k for k, t in enumerate(parts)])), SIZE)
    # Whole files out of order can be sorted.
    backwards = open_recording(folder_of_npz(tmp_path / "backwards", parts[::-1]))
    report = take_in(backwards, SIZE, Intake(unsorted="sort"), tmp_path / "out.h5")
    assert report.kept == 400


def test_files_in_different_units_are_an_error(tmp_path: Path):
    parts: list[Any] = np.split(events()["t"], 4)
    parts[2] = parts[2] * 1e-6
    folder = folder_of_npz(tmp_path / "mixed", parts)
    for unit in (None, "us"):
        with pytest.raises(RecordingError, match="ev_2.npz: times are fractions, those of ev_1.npz integers"):
            checked(open_recording(folder, time_unit=unit), SIZE)


@pytest.mark.parametrize(
    ("scale", "offset", "place", "added_us", "words"),
    [
        (1, np.int64(70), "t_offset", 70, "/t_offset is added to the times, 70 us"),
        (1, np.int64(70), "events/t_offset", 70, "/events/t_offset is added"),
        (1e-6, np.float64(0.5), "t_offset", 500_000, "/t_offset is added to the times, 0.5 s"),
        (1e-6, np.int64(500_000), "t_offset", 0, "/t_offset is 500000, in an unknown unit, and is not added"),
        (1, np.zeros(2), "t_offset", 0, "/t_offset is not a time, and is not added"),
    ],
)
def test_an_offset_is_in_the_unit_of_the_times(
    tmp_path: Path, scale: float, offset: Any, place: str, added_us: int, words: str
):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, column in events().items():
            file[f"events/{name}"] = column * scale if name == "t" and scale != 1 else column
        file[place] = offset
    source = open_recording(tmp_path / "a.h5")
    assert any(words in note for note in source.notes), source.notes
    assert np.abs(checked(source, SIZE).t_us - events()["t"] - added_us).max() <= 1


def test_an_offset_that_is_not_added_is_said(tmp_path: Path):
    np.savez(tmp_path / "a.npz", t_offset=70, **events())  # pyright: ignore[reportArgumentType]
    source = open_recording(tmp_path / "a.npz")
    assert source.notes == ("t_offset is 70, and is not added to the times; --time-offset-us does",)


@pytest.mark.parametrize(("name", "said"), [("units", "ns"), ("time_unit", "nanoseconds since 1970"), ("unit", b"ns")])
def test_attributes_give_the_unit_of_times(tmp_path: Path, name: str, said: Any):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for role, column in events().items():
            file[f"events/{role}"] = 1000 * column if role == "t" else column
        file["events/t"].attrs[name] = said
    source = open_recording(tmp_path / "a.h5")
    assert source.guessed_unit == "ns" and f"times in ns, as the attribute {name} says" in source.notes
    same(source)


def test_structs_within_structs_and_arrays_of_structs_of_matlab(tmp_path: Path):
    t, x, y, p = (events()[role] for role in "txyp")
    savemat(tmp_path / "a.mat", {"aedat": {"data": {"polarity": {"timeStamp": t, "x": x, "y": y, "polarity": p > 0}}}})
    same(open_recording(tmp_path / "a.mat"))
    rows = np.array(list(zip(t, x, y, p, strict=True)), [(name, object) for name in "txyp"])
    savemat(tmp_path / "b.mat", {"events": rows})
    same(open_recording(tmp_path / "b.mat"))
    savemat(tmp_path / "c.mat", {"aedat": {"data": {"imu": {"timeStamp": t}, "frame": {"samples": x}}}})
    with pytest.raises(RecordingError, match=r"arrays aedat\.data\.imu, aedat\.data\.frame, expected x, y"):
        open_recording(tmp_path / "c.mat")
