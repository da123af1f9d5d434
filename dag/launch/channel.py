"""The channel between the supervisor and a child: JSON lines over a socket pair, as the child sees it."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable, Mapping
from typing import Any

__all__ = ["LINE_BYTES", "Channel", "pack_line"]

LINE_BYTES = 4_000_000
"""The longest line that either side reads."""


def pack_line(message: Mapping[str, Any]) -> bytes:
    """A message as a line; what JSON does not know is written as text."""
    return json.dumps(message, separators=(",", ":"), default=str).encode() + b"\n"


class Channel:
    """The child's end. Any thread may send; one thread of its own receives."""

    def __init__(self, fd: int) -> None:
        """Takes over the descriptor of the socket."""
        self._socket = socket.socket(fileno=fd)
        self._socket.setblocking(True)
        self._lock = threading.Lock()
        self._closed = False

    def send(self, message: Mapping[str, Any]) -> bool:
        """Sends a message; False where nobody listens any more."""
        with self._lock:
            if self._closed:
                return False
            try:
                self._socket.sendall(pack_line(message))
            except OSError:
                self._closed = True
                return False
            return True

    def receive(self, on_message: Callable[[dict[str, Any]], None], on_end: Callable[[], None]) -> None:
        """Starts the thread that calls back for each message, and once when the supervisor is gone."""

        def serve() -> None:
            try:
                with self._socket.makefile("rb") as lines:
                    for line in lines:
                        on_message(json.loads(line))
            except (OSError, ValueError):
                pass
            on_end()

        threading.Thread(target=serve, name="supervisor", daemon=True).start()
