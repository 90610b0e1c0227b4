"""Kernels work where nothing can be written."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CODE = """
import numpy as np
from ebarf_ns.compiled import njit

@njit(cache=True)
def twice(x):
    return 2 * x

assert twice(np.arange(3)).sum() == 6
"""


@pytest.mark.parametrize("writable", [True, False])
def test_a_kernel_is_kept_where_that_can_be_and_runs_where_it_cannot(tmp_path: Path, writable: bool):
    (tmp_path / "kernel.py").write_text(CODE)
    # What is no folder can be written by nobody, not even by root.
    nowhere = Path(os.devnull) / "cache"
    cache = tmp_path / "cache" if writable else nowhere
    (tmp_path / "__pycache__").touch()
    folders = {"NUMBA_CACHE_DIR": str(cache), "HOME": str(nowhere), "XDG_CACHE_HOME": str(nowhere)}
    command, environment = [sys.executable, tmp_path / "kernel.py"], {**os.environ, **folders}
    finished = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stderr
    assert bool(list(tmp_path.rglob("*.nbi"))) == writable
