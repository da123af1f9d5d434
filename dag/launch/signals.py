"""Signals as calls in an event loop, without a moment in which they do anything else."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
from collections.abc import Callable, Iterable
from types import TracebackType
from typing import Any, Self

__all__ = ["SignalInbox"]


class SignalInbox:
    """Catches signals from `with` on; what they did before, they do again after it. In the main thread alone.

    The event loop's own handlers end with the loop, and leave the system's behind: a signal that comes while a program
    still tidies up would end it there.
    """

    def __init__(self, numbers: Iterable[int]) -> None:
        """Names them.

        Args:
            numbers: One that is ignored stays so, as nohup has it, and a shell for what runs in the background.
        """
        self._numbers = tuple(numbers)
        self._before: dict[int, Any] = {}
        self._wakeup = -1

    def __enter__(self) -> Self:
        """Catches them."""
        self._ours, self._theirs = socket.socketpair()
        for end in (self._ours, self._theirs):
            end.setblocking(False)
        self._wakeup = signal.set_wakeup_fd(self._theirs.fileno(), warn_on_full_buffer=False)
        for number in self._numbers:
            if signal.getsignal(number) is not signal.SIG_IGN:
                self._before[number] = signal.signal(number, lambda *_: None)
        return self

    def deliver(self, loop: asyncio.AbstractEventLoop, on_signal: Callable[[int], None]) -> None:
        """Calls back in a loop for each that comes, and for those that came since `with`."""

        def read() -> None:
            with contextlib.suppress(BlockingIOError):
                for number in self._ours.recv(4096):
                    if number in self._before:
                        on_signal(number)

        loop.add_reader(self._ours, read)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Lets them do what they did."""
        for number, before in self._before.items():
            signal.signal(number, before)
        signal.set_wakeup_fd(self._wakeup)
        self._ours.close()
        self._theirs.close()
