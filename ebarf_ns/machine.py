"""How many threads a training gets: as many as there are cores that nothing else keeps busy."""

from __future__ import annotations

import os

import numba
import psutil
import torch

from ebarf_ns.plan import Line

_LOOK_S = 0.3
_BUSY_CORE = 0.5


def free_threads() -> Line:
    """The plan's number of threads, from how busy the processor is during 0.3 s; OMP_NUM_THREADS takes precedence.

    Threads that wait for each other spin. Where one of them has to share its core, all the others wait for it, and a
    step takes twenty times as long as with one thread less.
    """
    most = min(torch.get_num_threads(), numba.get_num_threads())
    if "OMP_NUM_THREADS" in os.environ:
        return Line("threads", most, "OMP_NUM_THREADS says so")
    before = psutil.Process().cpu_times()
    shares = psutil.cpu_percent(interval=_LOOK_S, percpu=True)
    after = psutil.Process().cpu_times()
    own = (after.user + after.system - before.user - before.system) / _LOOK_S
    busy = max(sum(shares) / 100 - own, 0.0)
    taken = int(busy + 1 - _BUSY_CORE)
    count = max(min(most, len(shares) - taken), 1)
    return Line("threads", count, f"{len(shares)} cores, {busy:.1f} of them busy with other work")


def use_threads(count: int | None) -> None:
    """Let torch and numba run on so many, numba on as many of them as it has; None: as they are."""
    if count is not None:
        torch.set_num_threads(count)
        numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))  # pyright: ignore
