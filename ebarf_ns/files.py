"""Outputs appear whole or not at all: written under a temporary name beside the target, then renamed."""

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

    A link stays, and what it leads to is replaced. Raises :class:`EbarfError` where ``path`` is a pipe or a device.
    """
    target = path.resolve()
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
        # A full disk does not say of itself what found it full, and nobody knows the temporary name.
        if error.filename is None or Path(os.fsdecode(error.filename)).name.startswith(f".{path.stem}."):
            error.filename, error.filename2 = str(path), None
        raise
    finally:
        if temporary:
            temporary.unlink(missing_ok=True)


def synced(folder: Path) -> None:
    """Have the system write down what names a folder holds, where it can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder to fill; it becomes ``path`` (replacing it) when the block ends without an exception."""
    path = path.resolve()
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    try:
        yield temporary
        temporary.chmod(0o777 & ~_umask())
        if path.exists():
            # Put away before it is removed, which takes its time.
            before = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
            path.replace(before)
            temporary.replace(path)
            shutil.rmtree(before, ignore_errors=True)
        else:
            temporary.replace(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def refuse_existing(folder: Path) -> None:
    """Raise :class:`EbarfError` where a folder that is to be made would replace something."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise EbarfError(f"{folder}: exists, expected a new folder; remove it first where it is not needed")
    # The finished folder takes the place of an empty one, which these cannot give up.
    if folder.exists() and (os.path.ismount(folder) or folder.samefile(Path.cwd())):
        raise EbarfError(f"{folder}: the current folder or a mounted one, expected a new folder, which may be in it")


def is_special(path: Path) -> bool:
    """Whether a path names a pipe, a socket or a device: to read one may take for ever."""
    return path.exists() and not path.is_file() and not path.is_dir()


@contextmanager
def opened_npz(path: Path) -> Iterator[Any]:
    """The arrays of an npz file, by name; whatever a damaged one makes the libraries raise is a ValueError."""
    try:
        with np.load(path) as file:
            yield file
    except (EbarfError, OSError):
        raise
    except Exception as error:
        raise ValueError(f"not a whole npz file of plain arrays ({error})") from None


def read_picture(path: Path, flags: int = -1) -> np.ndarray | None:
    """The pixels of an image file by OpenCV's flags, None where it is no image.

    OpenCV opens no file by itself: on Windows it knows only the names of one code page.
    """
    import cv2

    content = np.fromfile(path, np.uint8)
    return cv2.imdecode(content, flags) if len(content) else None


def write_picture(path: Path, pixels: np.ndarray) -> None:
    """An image file of the kind that its name says."""
    import cv2

    cv2.imencode(path.suffix, pixels)[1].tofile(path)


def _umask() -> int:
    current = os.umask(0)
    os.umask(current)
    return current
