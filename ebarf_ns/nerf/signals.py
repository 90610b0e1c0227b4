"""Ctrl-C and SIGTERM."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from nerfstudio.utils.rich_utils import CONSOLE


@contextmanager
def signals_to(handle: Callable[[int], None]) -> Iterator[None]:
    """Call ``handle`` with the number of the first SIGINT or SIGTERM; a second one ends the process at once."""

    def first(number: int, _: Any) -> None:
        for one in before:
            signal.signal(one, signal.SIG_DFL)
        handle(number)

    before: dict[int, Any] = {}
    # Python hands signals to the main thread alone.
    if threading.current_thread() is threading.main_thread():
        before = {one: signal.signal(one, first) for one in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


def end(number: int) -> None:
    """Leave with the exit code that shells know a signal by: 130 or 143."""
    CONSOLE.print(f"{signal.Signals(number).name}: ends")
    raise SystemExit(128 + number)
