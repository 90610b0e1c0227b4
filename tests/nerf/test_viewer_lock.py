"""viser's lock around grouped messages, without which a viewer stops."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from viser.infra._infra import WebsockMessageHandler

from ebarf_ns.nerf.viewer_lock import mend_viser


class Handler(WebsockMessageHandler):
    def unsafe_send_message(self, message: object) -> None:
        pass


@pytest.fixture
def handler() -> Handler:
    mend_viser()
    return Handler(ThreadPoolExecutor(1))


def free(handler: Handler) -> bool:
    """Whether another thread gets the lock."""
    found = []

    def look() -> None:
        found.append(handler._atomic_lock.acquire(timeout=1))
        if found[0]:
            handler._atomic_lock.release()

    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    return found[0]


def test_a_block_that_raises_gives_the_lock_back(handler: Handler):
    with pytest.raises(KeyError), handler.atomic():
        raise KeyError("a client that has left")
    assert free(handler)


def test_a_nested_block_leaves_the_lock_to_the_outer_one(handler: Handler):
    with handler.atomic():
        with handler.atomic():
            pass
        assert not free(handler)
    assert free(handler)


def test_many_threads_with_nested_blocks_all_come_to_an_end(handler: Handler):
    def often() -> None:
        for _ in range(500):
            with handler.atomic(), handler.atomic():
                pass

    threads = [threading.Thread(target=often, daemon=True) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=30)
    assert not any(thread.is_alive() for thread in threads)
