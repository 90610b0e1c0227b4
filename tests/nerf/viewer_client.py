"""What a browser says to the viewer and is told by it, without a browser."""

import threading
import time
from collections.abc import Callable
from typing import Any

import msgspec
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

PATIENCE_S = 90.0


class ViewerClient:
    """Stands at the origin, hears everything, and moves what it is told to."""

    def __init__(self, port: int):
        self.heard: list[dict[str, Any]] = []
        self._socket = connect(f"ws://127.0.0.1:{port}", max_size=None, compression=None)
        self._say(
            "ViewerCameraMessage", wxyz=[1.0, 0, 0, 0], position=[0.0, 0, 0], fov=1.0, aspect=1.5,
            look_at=[0.0, 0, 1], up_direction=[0.0, -1, 0],
        )  # fmt: skip
        threading.Thread(target=self._listen, daemon=True).start()

    def __enter__(self) -> "ViewerClient":
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def _say(self, kind: str, **content: Any) -> None:
        self._socket.send(msgspec.msgpack.encode({"type": kind, **content}))

    def _listen(self) -> None:
        try:
            for message in self._socket:
                assert isinstance(message, bytes)
                heard = msgspec.msgpack.decode(message)
                self.heard.extend(heard if isinstance(heard, list) else [heard])
        except ConnectionClosed:
            pass

    def all(self, kind: str, where: Callable[[dict[str, Any]], bool] = lambda _: True) -> list[dict[str, Any]]:
        """What was heard of that kind so far."""
        return [one for one in list(self.heard) if one["type"] == kind and where(one)]

    def wait_for(self, kind: str, where: Callable[[dict[str, Any]], bool] = lambda _: True, more_than: int = 0) -> dict:
        """The last of a kind of message, once there are more than so many."""
        end = time.monotonic() + PATIENCE_S
        while len(found := self.all(kind, where)) <= more_than:
            assert time.monotonic() < end, f"no {kind} among {sorted({one['type'] for one in self.heard})}"
            time.sleep(0.05)
        return found[-1]

    def set(self, label: str, value: Any) -> None:
        """Move a slider, tick a box, press a button."""
        added = [one for one in self.heard if one["type"].startswith("GuiAdd") and one.get("label") == label]
        assert added, label
        self._say("GuiUpdateMessage", id=added[-1]["id"], updates={"value": value})

    def pictures(self) -> list[str]:
        """The pictures shown in the panel so far, as data of their addresses."""
        shown = [one["updates"].get("markdown", "") for one in self.all("GuiUpdateMessage")]
        return [text for text in shown if "data:image/png;base64," in text]
