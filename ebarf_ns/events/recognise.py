"""A recording's format, by what its file begins with."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

from ebarf_ns.errors import RecordingError
from ebarf_ns.events.readers.text import read_text
from ebarf_ns.events.source import Source, TimeUnit

RecordingFormat = Literal["hdf5", "aedat4", "bag", "raw", "dat", "npz", "npy", "text"]
_MAGIC: dict[bytes, RecordingFormat] = {
    b"\x89HDF\r\n\x1a\n": "hdf5", b"#!AER-DAT4.0": "aedat4", b"#ROSBAG V2.0": "bag", b"SQLite format 3": "bag",
    b"\x89MCAP0\r\n": "bag", b"PK\x03\x04": "npz", b"\x93NUMPY": "npy",
}  # fmt: skip
_BEGINNING = 4096


def open_recording(
    path: Path,
    known: RecordingFormat | None = None,
    part: str | None = None,
    time_unit: TimeUnit | None = None,
) -> Source:
    """A recording of any format; ``part`` is the group of an HDF5 file or the topic of a bag, where there are several.

    Raises :class:`RecordingError` where it cannot be opened or is none.
    """
    found = known or recognised(path)
    # Some of the libraries take long to import, and each file needs one of them.
    if found == "hdf5":
        from ebarf_ns.events.readers.hdf5 import read_hdf5

        return read_hdf5(path, part, time_unit)
    if found == "aedat4":
        from ebarf_ns.events.readers.aedat4 import read_aedat4

        return read_aedat4(path)
    if found == "bag":
        from ebarf_ns.events.readers.bags import read_bag

        return read_bag(path, part)
    if found in ("raw", "dat"):
        from ebarf_ns.events.readers.prophesee import read_dat, read_raw

        return read_raw(path) if found == "raw" else read_dat(path)
    if found in ("npz", "npy"):
        from ebarf_ns.events.readers.arrays import read_npy, read_npz

        return read_npz(path, time_unit) if found == "npz" else read_npy(path)
    return read_text(path, time_unit)


def recognised_folder(path: Path) -> RecordingFormat | None:
    """The recording that a folder is, if it is one."""
    if (path / "metadata.yaml").is_file():
        return "bag"
    return "npy" if any(path.glob("*.npy")) else None


def recognised(path: Path) -> RecordingFormat:
    """What a file or folder is; raises :class:`RecordingError` where it is none of those."""
    if path.is_dir():
        if found := recognised_folder(path):
            return found
        raise RecordingError(f"{path}: a folder without metadata.yaml (ROS 2) or .npy files, expected a recording")
    try:
        with path.open("rb") as file:
            beginning = file.read(_BEGINNING)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from None
    for magic, found in _MAGIC.items():
        if beginning.startswith(magic):
            return found
    if beginning.startswith(b"%"):
        header = beginning.split(b"\n% end")[0].lower()
        return "raw" if b"\n% evt " in b"\n" + header or b"% format evt" in header else "dat"
    if beginning and b"\0" not in beginning:
        return "text"
    formats = ", ".join(get_args(RecordingFormat))
    what = "is empty" if not beginning else f"begins with {beginning[:12]!r}"
    raise RecordingError(f"{path}: {what}, expected a recording of one of these formats: {formats}")
