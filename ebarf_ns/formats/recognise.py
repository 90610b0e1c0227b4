"""Recognise a recording's format from the first bytes of its file."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal, get_args

from ebarf_ns.errors import RecordingError, did_you_mean
from ebarf_ns.files import is_special
from ebarf_ns.formats.columns import parsed_order
from ebarf_ns.formats.readers.text import read_text
from ebarf_ns.formats.source import Source, TimeUnit

RecordingFormat = Literal["hdf5", "aedat4", "bag", "raw", "dat", "npz", "npy", "mat", "text"]
_MAGIC: dict[bytes, RecordingFormat] = {
    b"\x89HDF\r\n\x1a\n": "hdf5", b"#!AER-DAT4.0": "aedat4", b"#ROSBAG V2.0": "bag", b"SQLite format 3": "bag",
    b"\x89MCAP0\r\n": "bag", b"PK\x03\x04": "npz", b"\x93NUMPY": "npy",
    b"MATLAB 5.0 MAT-file": "mat", b"MATLAB 7.3 MAT-file": "hdf5",
}  # fmt: skip
_OTHER = {
    b"\x1f\x8b": "compressed by gzip, expected the file within, as gunzip unpacks it",
    b"BZh": "compressed by bzip2, expected the file within, as bunzip2 unpacks it",
    b"\xfd7zXZ": "compressed by xz, expected the file within, as unxz unpacks it",
    b"\xff\xfe": "text in UTF-16, expected it in UTF-8", b"\xfe\xff": "text in UTF-16, expected it in UTF-8",
    b"#!AER-DAT1": "AEDAT 1, expected AEDAT 4, or text of t x y p",
    b"#!AER-DAT2": "AEDAT 2, as jAER writes it, expected AEDAT 4, or text of t x y p",
    b"#!AER-DAT3": "AEDAT 3, as cAER writes it, expected AEDAT 4, or text of t x y p",
}  # fmt: skip
_ROWS_BELOW_COMMENTS = re.compile(rb"(?:%[^\n]*\n)+[ \t]*[-+\d][-+\d.eE \t,;]+\r?\n")
_BEGINNING = 4096


def open_recording(
    path: Path,
    known: RecordingFormat | None = None,
    part: str | None = None,
    time_unit: TimeUnit | None = None,
    columns: str | None = None,
) -> Source:
    """Open a recording of any format; ``part`` selects the group of an HDF5 file, the topic of a bag or the array of an
    array file, if there are several; ``columns`` is the order of unnamed columns, as in ``x y p t``.

    Raises :class:`RecordingError` if it cannot be opened or is not a recording.
    """
    order = parsed_order(columns) if columns is not None else None
    source = _opened(path, known or recognised(path), part, time_unit, order)
    if order and not source.columns:
        raise RecordingError(f"{path}: {source.format}, whose columns have names; expected no --event-columns")
    return source


def _opened(
    path: Path, found: RecordingFormat, part: str | None, time_unit: TimeUnit | None, order: str | None
) -> Source:
    # Some libraries are slow to import, and each file needs only one.
    if found == "hdf5":
        from ebarf_ns.formats.readers.hdf5 import read_hdf5

        return read_hdf5(path, part, time_unit, order)
    if found == "aedat4":
        from ebarf_ns.formats.readers.aedat4 import read_aedat4

        return read_aedat4(path)
    if found == "bag":
        from ebarf_ns.formats.readers.bags import read_bag

        return read_bag(path, part)
    if found in ("raw", "dat"):
        from ebarf_ns.formats.readers.prophesee import read_dat, read_raw

        return read_raw(path) if found == "raw" else read_dat(path)
    if found in ("npz", "npy", "mat"):
        from ebarf_ns.formats.readers.arrays import read_mat, read_npy, read_npz

        if found == "npy":
            return read_npy(path, time_unit, order)
        return (read_npz if found == "npz" else read_mat)(path, time_unit, order, part)
    return read_text(path, time_unit, order)


def recognised_folder(path: Path) -> RecordingFormat | None:
    """The format of a folder, if it is a recording."""
    if (path / "metadata.yaml").is_file():
        return "bag"
    kinds: tuple[RecordingFormat, ...] = ("npy", "npz")
    return next((kind for kind in kinds if any(path.glob(f"*.{kind}"))), None)


def recognised(path: Path) -> RecordingFormat:
    """The format of a file or folder; raises :class:`RecordingError` for unknown formats."""
    if path.is_dir():
        if found := recognised_folder(path):
            return found
        raise RecordingError(
            f"{path}: a folder without metadata.yaml (ROS 2), .npy or .npz files, expected a recording"
        )
    if is_special(path):
        raise RecordingError(f"{path}: a pipe or a device, expected a file")
    try:
        with path.open("rb") as file:
            beginning = file.read(_BEGINNING)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}{did_you_mean(path)}") from None
    for magic, found in _MAGIC.items():
        if beginning.startswith(magic):
            return found
    for magic, kind in _OTHER.items():
        if beginning.startswith(magic):
            raise RecordingError(f"{path}: {kind}")
    if beginning.startswith(b"%") and not _ROWS_BELOW_COMMENTS.match(beginning):
        header = beginning.split(b"\n% end")[0].lower()
        return "raw" if b"\n% evt " in b"\n" + header or b"% format evt" in header else "dat"
    if beginning and b"\0" not in beginning:
        return "text"
    formats = ", ".join(get_args(RecordingFormat))
    what = "is empty" if not beginning else f"begins with {beginning[:12]!r}"
    raise RecordingError(f"{path}: {what}, expected a recording of one of these formats: {formats}")
