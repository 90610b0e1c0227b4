"""Atomic outputs: written under a temporary name beside the target, then renamed."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from ebarf_ns.errors import EbarfError


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write to; it becomes ``path`` when the block ends without an exception.

    The target of a symbolic link is replaced, not the link. Raises :class:`EbarfError` if ``path`` is a pipe or a
    device.
    """
    # Unlike Path.resolve, it accepts a link that leads to itself, which is then replaced.
    target = Path(os.path.realpath(path))
    if is_special(target):
        raise EbarfError(f"{path}: a pipe or a device, expected a file to write")
    temporary = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{path.stem}.", suffix=path.suffix)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        with temporary.open("rb+") as written:
            os.fsync(written.fileno())
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(target)
        synced(target.parent)
    except OSError as error:
        # The error of a full disk has no file name, and the temporary name means nothing to users.
        if error.filename is None or Path(os.fsdecode(error.filename)).name.startswith(f".{path.stem}."):
            error.filename, error.filename2 = str(path), None
        raise
    finally:
        if temporary:
            temporary.unlink(missing_ok=True)


def synced(folder: Path) -> None:
    """Sync a folder's entries to disk, if the system can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder to fill; it becomes ``path`` (replacing it) when the block ends without an exception."""
    path = Path(os.path.realpath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    try:
        yield temporary
        temporary.chmod(0o777 & ~_umask())
        if path.exists():
            # Move it away first, since removing it takes time.
            before = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
            path.replace(before)
            temporary.replace(path)
            shutil.rmtree(before, ignore_errors=True)
        else:
            temporary.replace(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def refuse_existing(folder: Path) -> None:
    """Raise :class:`EbarfError` if an output folder would replace something."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise EbarfError(f"{folder}: exists, expected a new folder; remove it first where it is not needed")
    # The finished folder replaces an empty one, which is impossible for these.
    if folder.exists() and (os.path.ismount(folder) or folder.samefile(Path.cwd())):
        raise EbarfError(f"{folder}: the current folder or a mounted one, expected a new folder, which may be in it")


def is_special(path: Path) -> bool:
    """Whether a path is a pipe, a socket or a device, reading which may block for ever."""
    return path.exists() and not path.is_file() and not path.is_dir()


@contextmanager
def opened_npz(path: Path) -> Iterator[Any]:
    """The arrays of an npz file by name; raises ValueError for damaged files, whatever the libraries raise."""
    try:
        with np.load(path) as file:
            yield file
    except (EbarfError, OSError):
        raise
    except Exception as error:
        raise ValueError(f"not a whole npz file of plain arrays ({error})") from None


def read_picture(path: Path, flags: int = -1) -> np.ndarray | None:
    """The pixels of an image file, read with OpenCV's flags; None if it is no image.

    OpenCV does not open the file itself: on Windows, it only supports file names in one code page.
    """
    import cv2

    content = np.fromfile(path, np.uint8)
    return cv2.imdecode(content, flags) if len(content) else None


def write_picture(path: Path, pixels: np.ndarray) -> None:
    """Write an image file in the format of its suffix."""
    import cv2

    cv2.imencode(path.suffix, pixels)[1].tofile(path)


def _umask() -> int:
    current = os.umask(0)
    os.umask(current)
    return current
