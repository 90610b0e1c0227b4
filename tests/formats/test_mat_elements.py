"""MATLAB files whose elements do not fit into each other are refused; scipy's reader would crash on some of them."""

import random
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from ebarf_ns.formats.readers.mat_elements import check_elements

VALUES = {
    "x": np.arange(50.0),
    "ts": np.arange(50, dtype=np.int64),
    "inner": {"a": 1, "b": {"c": np.eye(3)}, "nothing": np.zeros((0, 0))},
    "rows": np.array([(1, 2.0), (3, 4.0)], dtype=[("q", "i4"), ("w", "f8")]),
    "cells": np.array([1, "text", np.eye(2)], dtype=object),
    "complex": np.array([1 + 2j]),
    "flags": np.array([True, False]),
    "text": "",
}


@pytest.fixture(params=[False, True], ids=["plain", "compressed"])
def content(request: pytest.FixtureRequest, tmp_path: Path) -> bytes:
    savemat(tmp_path / "a.mat", VALUES, do_compression=request.param)
    return (tmp_path / "a.mat").read_bytes()


def test_whole_files_pass(content: bytes):
    check_elements(content)


@pytest.mark.parametrize("left", [100, 128 + 4, -8, -100])
def test_files_that_are_cut_off_do_not(content: bytes, left: int):
    if content[:left][128:]:
        with pytest.raises(Exception, match=r"element|stream|byte"):
            check_elements(content[:left])


def test_an_element_that_promises_more_than_it_holds_is_refused(tmp_path: Path):
    savemat(tmp_path / "a.mat", {"x": np.arange(50.0)})
    content = bytearray((tmp_path / "a.mat").read_bytes())
    at = content.index(np.arange(3.0).tobytes()) - 8
    assert content[at] == 9
    for place, value, said in ((at, 0, "type 0"), (at, 3, "type 3"), (at + 5, 9, "an element of")):
        damaged = bytearray(content)
        damaged[place] = value
        with pytest.raises(ValueError, match=said):
            check_elements(bytes(damaged))


def test_what_passes_does_not_crash_the_reader(content: bytes, tmp_path: Path):
    chance = random.Random(0)
    for _ in range(200):
        damaged = bytearray(content)
        for _ in range(chance.randint(1, 4)):
            damaged[chance.randrange(128, len(damaged))] = chance.choice([0, 1, 255, chance.randrange(256)])
        with suppress(Exception):
            check_elements(bytes(damaged))
            (tmp_path / "b.mat").write_bytes(damaged)
            loadmat(tmp_path / "b.mat")
