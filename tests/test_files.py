"""Files appear whole or not at all, and in the place that was named."""

import os
from pathlib import Path

import pytest

from ebarf_ns.errors import EbarfError
from ebarf_ns.files import whole_file


def write(path: Path, text: str = "new") -> None:
    with whole_file(path) as temporary:
        temporary.write_text(text)


def test_a_link_stays_and_what_it_leads_to_is_written(tmp_path: Path):
    (tmp_path / "there").mkdir()
    target, link = tmp_path / "there" / "file.txt", tmp_path / "link.txt"
    target.write_text("old")
    link.symlink_to(target)
    write(link)
    assert link.is_symlink() and target.read_text() == "new"
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file.txt", "link.txt", "there"]


def test_a_link_to_itself_is_replaced(tmp_path: Path):
    (tmp_path / "loop").symlink_to("loop")
    write(tmp_path / "loop")
    assert (tmp_path / "loop").read_text() == "new" and not (tmp_path / "loop").is_symlink()


def test_pipes_and_devices_are_not_replaced(tmp_path: Path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path in (pipe, Path("/dev/null")):
        with pytest.raises(EbarfError, match=f"{path}: a pipe or a device"):
            write(path)
    assert pipe.is_fifo() and not Path("/dev/null").is_file()


def test_errors_name_what_was_to_be_written(tmp_path: Path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("old")
    for path in (tmp_path / "folder", tmp_path / "file" / "below"):
        with pytest.raises(OSError, match=r"directory|exists") as error:
            write(path)
        assert Path(error.value.filename) in (path, path.parent) and error.value.filename2 is None
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]
