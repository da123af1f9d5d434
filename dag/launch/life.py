"""One life of a process, from its start to its end: its channel, its output, and the news of it as mail."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import socket
import subprocess
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from .channel import LINE_BYTES, pack_line
from .run_folder import RotatedLog

__all__ = ["Life", "Printed", "exit_text"]

_LAST_LINES = 40
_LONGEST_LINE = 4096
_DRAIN_S = 1.0


class Printed:
    """What a process prints, through all its lives: all of it goes into a log, the last lines are kept."""

    def __init__(self, log: RotatedLog) -> None:
        """Begins with nothing."""
        self.last_lines: deque[str] = deque(maxlen=_LAST_LINES)
        self._log = log
        self._partial = b""

    @property
    def path(self) -> str:
        """The file of the log."""
        return str(self._log.path)

    @property
    def lost(self) -> int:
        """Bytes that the log could not take, as on a full disk."""
        return self._log.lost

    def open(self) -> None:
        """Opens the log: what a supervisor holds does not depend on what its processes print."""
        self._log.write(b"")

    def take(self, data: bytes) -> None:
        """Takes a chunk."""
        self._log.write(data)
        *lines, self._partial = (self._partial + data).split(b"\n")
        self._partial = self._partial[-_LONGEST_LINE:]
        self.last_lines.extend(line[-2000:].decode(errors="replace") for line in lines[-_LAST_LINES:])

    def end_line(self) -> None:
        """Takes what was printed last as a line, though it has no end."""
        if self._partial:
            self.last_lines.append(self._partial.decode(errors="replace"))
            self._partial = b""

    def close(self) -> None:
        """Closes the log."""
        self._log.close()


@dataclass
class Life:
    """What belongs to one start of a process.

    `mail` holds, as kind and content, all that its supervisor is to act on: `report` (a message of the process),
    `exit` (its code, negative for a signal), and what the supervisor puts into it itself.
    """

    process: subprocess.Popen[bytes]
    pidfd: int
    started: float
    heard: float
    """When its last sign of life came."""
    patience_s: float
    """How long it may take to stop."""
    mail: asyncio.Queue[tuple[str, Any]]
    error: str = ""
    """What it said of its end."""
    hung: str = ""
    """Why it was killed."""
    answers: dict[int, asyncio.Future[dict[str, Any]]] = field(default_factory=dict)
    """Those that are waited for, by the number of the order."""
    _writer: asyncio.StreamWriter | None = None
    _output: asyncio.ReadTransport | None = None
    _reading: asyncio.Task[None] | None = None

    @classmethod
    async def begin(
        cls,
        command: Sequence[str],
        environment: Mapping[str, str],
        *,
        patience_s: float,
        place: Callable[[int], None],
        printed: Printed,
        on_beat: Callable[[dict[str, Any]], None],
    ) -> Life:
        """Starts the process.

        Args:
            command: What is executed; `--channel FD --parent PID` is added to it.
            environment: Added to the supervisor's.
            patience_s: How long it may take to stop.
            place: Is called with its number as soon as it is there: to put it where it is to run.
            printed: Takes what it prints.
            on_beat: Takes its signs of life that say nothing else; all that it has to tell beside them is mail.

        Raises:
            OSError: It cannot be started.
        """
        loop = asyncio.get_running_loop()
        ours, theirs = socket.socketpair()
        try:
            with theirs:
                process = subprocess.Popen(
                    [*command, "--channel", str(theirs.fileno()), "--parent", str(os.getpid())],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    pass_fds=[theirs.fileno()],
                    env={**os.environ, "PYTHONUNBUFFERED": "1", "PYTHONFAULTHANDLER": "1", **environment},
                    # A session of its own: an interrupt on the terminal does not reach it, and what it starts is
                    # found as its process group.
                    start_new_session=True,
                )
        except OSError:
            ours.close()
            raise
        place(process.pid)
        now = time.monotonic()
        life = cls(process, os.pidfd_open(process.pid), now, now, patience_s, asyncio.Queue())
        loop.add_reader(life.pidfd, life._ended, loop)
        ours.setblocking(False)
        reader, life._writer = await asyncio.open_unix_connection(sock=ours, limit=LINE_BYTES)
        assert process.stdout is not None
        life._output, _ = await loop.connect_read_pipe(lambda: _Output(printed.take), process.stdout)
        life._reading = asyncio.create_task(life._read_reports(reader, on_beat))
        return life

    def _ended(self, loop: asyncio.AbstractEventLoop) -> None:
        loop.remove_reader(self.pidfd)
        # While it is not reaped its number is its own: what it has left of its group is killed without mistake.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.mail.put_nowait(("exit", self.process.wait()))

    async def _read_reports(self, reader: asyncio.StreamReader, on_beat: Callable[[dict[str, Any]], None]) -> None:
        with contextlib.suppress(OSError, ValueError, asyncio.LimitOverrunError):
            while line := await reader.readline():
                report = json.loads(line)
                if not isinstance(report, dict):
                    continue
                self.heard = time.monotonic()
                if report.get("report") == "beat" and not report.get("hanging"):
                    on_beat(report)  # all that there is to do in most of the seconds of a life
                else:
                    self.mail.put_nowait(("report", report))

    async def next_mail(self, due: float | None) -> tuple[str, Any]:
        """What is to be acted on next; `overdue` where nothing comes until a time, None: however long it takes."""
        if due is None or not self.mail.empty():
            return await self.mail.get()
        try:
            async with asyncio.timeout(max(0.0, due - time.monotonic())):
                return await self.mail.get()
        except TimeoutError:
            return "overdue", None

    def send(self, message: Mapping[str, Any]) -> bool:
        """Tells the process something; False where it does not listen any more."""
        if self._writer is None or self._writer.is_closing():
            return False
        self._writer.write(pack_line(message))
        return True

    def signal(self, number: int) -> None:
        """Signals the process, if it is still there."""
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self.pidfd, number)

    async def last_reports(self, printed: Printed) -> list[dict[str, Any]]:
        """After its end: takes what it printed last, and gives what it said last."""
        if self._reading is not None:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(asyncio.gather(self._reading), _DRAIN_S)
        reports = []
        while not self.mail.empty():
            kind, what = self.mail.get_nowait()
            if kind == "report":
                reports.append(what)
        if self._output is not None:
            output = self._output.get_extra_info("pipe")
            with contextlib.suppress(OSError, ValueError):  # what it printed last may not have been read yet
                while data := os.read(output.fileno(), 1 << 16):
                    printed.take(data)
        return reports

    def close(self, name: str) -> None:
        """Lets go of all that belonged to it; who waits for an answer is told that the process of this name ended."""
        if self._output is not None:
            self._output.close()
        if self._writer is not None:
            self._writer.close()
        os.close(self.pidfd)
        if self._reading is not None:
            self._reading.cancel()
        for answer in self.answers.values():
            if not answer.done():
                answer.set_exception(ConnectionError(f"process {name!r} ended"))
                answer.exception()  # nobody may be waiting any more


def exit_text(code: int) -> str:
    """An exit code as a text, negative for a signal."""
    if code >= 0:
        return f"ended with exit code {code}"
    try:
        return f"was ended by {signal.Signals(-code).name}"
    except ValueError:
        return f"was ended by signal {-code}"


class _Output(asyncio.Protocol):
    """What a process prints, chunk by chunk."""

    def __init__(self, take: Callable[[bytes], None]) -> None:
        self._take = take

    def data_received(self, data: bytes) -> None:
        """A chunk."""
        self._take(data)
