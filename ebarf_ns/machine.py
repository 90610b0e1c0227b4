"""The number of threads for training: one for each core that is free of other work."""

from __future__ import annotations

import os

import numba
import psutil
import torch

from ebarf_ns.plan import Line

_MEASURED_S = 0.3
_BUSY_SHARE = 0.5


def free_threads() -> Line:
    """Return the number of threads as a line of the plan, from the processor load over 0.3 s or OMP_NUM_THREADS.

    Threads spin while they wait for each other. If one of them has to share its core, all the others wait for it, and
    a step takes twenty times as long as with one thread fewer.
    """
    available = min(torch.get_num_threads(), numba.get_num_threads())
    if "OMP_NUM_THREADS" in os.environ:
        return Line("threads", available, "set by OMP_NUM_THREADS")
    before = psutil.Process().cpu_times()
    shares = psutil.cpu_percent(interval=_MEASURED_S, percpu=True)
    after = psutil.Process().cpu_times()
    own_load = (after.user + after.system - before.user - before.system) / _MEASURED_S
    busy = max(sum(shares) / 100 - own_load, 0.0)
    busy_cores = int(busy + 1 - _BUSY_SHARE)
    count = max(min(available, len(shares) - busy_cores), 1)
    return Line("threads", count, f"{len(shares)} cores, {busy:.1f} of them used by other programs")


def use_threads(count: int | None) -> None:
    """Set the number of threads of torch and numba, up to numba's maximum; None leaves both unchanged."""
    if count is not None:
        torch.set_num_threads(count)
        numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))  # pyright: ignore
