"""Signal handlers for Ctrl-C, SIGTERM and a closed terminal."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from typing import Any

from ebarf_ns.nerf.terminal import say

# Windows has no SIGHUP.
_ENDING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


@contextmanager
def signals_to(handle: Callable[[int], None]) -> Iterator[None]:
    """Call ``handle`` with the number of the first SIGINT, SIGTERM or SIGHUP; a second one ends the process at once.

    SIGTERM and SIGHUP stay ignored if they already are, as nohup does with SIGHUP.
    """

    def first(number: int, _: Any) -> None:
        for one in before:
            signal.signal(one, signal.SIG_DFL)
        handle(number)

    before: dict[int, Any] = {}
    # Python only allows the main thread to set signal handlers.
    if threading.current_thread() is threading.main_thread():
        ignored = [one for one in _ENDING if one != signal.SIGINT and signal.getsignal(one) == signal.SIG_IGN]
        before = {one: signal.signal(one, first) for one in _ENDING if one not in ignored}
    try:
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


@contextmanager
def output_may_end() -> Iterator[None]:
    """Continue silently if output can no longer be written: a closed terminal, or a pipe whose reader has ended."""
    with ExitStack() as streams:
        streams.enter_context(redirect_stdout(_Unfailing(sys.stdout)))  # pyright: ignore[reportArgumentType]
        streams.enter_context(redirect_stderr(_Unfailing(sys.stderr)))  # pyright: ignore[reportArgumentType]
        yield


class _Unfailing:
    """A text stream that discards output that cannot be written."""

    def __init__(self, stream: Any):
        self._stream = stream

    def write(self, text: str) -> int:
        with self._or_nowhere():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with self._or_nowhere():
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @contextmanager
    def _or_nowhere(self) -> Iterator[None]:
        try:
            yield
        except OSError:
            # The stream's remaining buffer would fail again when it is closed.
            with suppress(OSError), open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), self._stream.fileno())


def end(number: int) -> None:
    """Exit with the shell's exit code for a signal: 130, 143 or 129."""
    say(f"{signal.Signals(number).name}: ends")
    raise SystemExit(128 + number)
