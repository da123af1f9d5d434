"""The thread that serves the readers of all topics that a process exports."""

from __future__ import annotations

import logging
import os
import select
import socket
import threading
from collections.abc import Callable

__all__ = ["ExportService"]

_log = logging.getLogger(__name__)


class ExportService:
    """The thread that lets readers of all exported topics in, and notices when they go. It sleeps otherwise."""

    def __init__(self, name: str) -> None:
        """Starts the thread.

        Args:
            name: Of the thread.
        """
        self._epoll = select.epoll()
        self._wake = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._handlers: dict[int, Callable[[], None]] = {}
        self._epoll.register(self._wake, select.EPOLLIN)
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def watch(self, one: socket.socket, events: int, handler: Callable[[], None]) -> None:
        """Calls the handler when one of the events is there. Closing the socket ends it."""
        fd = one.fileno()
        known = fd in self._handlers
        self._handlers[fd] = handler
        try:
            self._epoll.modify(fd, events) if known else self._epoll.register(fd, events)
        except FileNotFoundError:  # the number was that of a socket closed since
            self._epoll.register(fd, events)

    def _run(self) -> None:
        while not self._stopping:
            for fd, _ in self._epoll.poll():
                handler = self._handlers.get(fd)
                if handler is None:
                    continue
                try:
                    handler()
                except Exception:  # the other readers are to be served all the same
                    _log.exception("a reader could not be served")

    def stop(self) -> None:
        """Ends the thread."""
        self._stopping = True
        os.eventfd_write(self._wake, 1)
        self._thread.join()
        self._epoll.close()
        os.close(self._wake)
