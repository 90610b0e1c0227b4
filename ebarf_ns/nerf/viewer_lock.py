"""A fixed lock for grouped messages in viser 0.2.7, whose own can deadlock the viewer and a training with one."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from viser.infra._infra import WebsockMessageHandler


@contextmanager
def atomic(self: WebsockMessageHandler) -> Iterator[None]:
    """Group the messages sent in this block; nested calls of a thread are ignored.

    Unlike viser's own, it releases the lock if the block raises (as nerfstudio's does for a client that has left), and
    clears the owner before releasing the lock, not after, when another thread may hold it.
    """
    if self._locked_thread_id == threading.get_ident():
        yield
        return
    with self._atomic_lock:
        self._locked_thread_id = threading.get_ident()
        try:
            yield
        finally:
            self._locked_thread_id = -1


def mend_viser() -> None:
    """Use this lock in all servers and clients of viser."""
    WebsockMessageHandler.atomic = atomic
