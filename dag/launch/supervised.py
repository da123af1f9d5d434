"""One process as its supervisor sees it: started, watched, started again, stopped.

             ┌────────────── back off ◄─────────────┐
             ▼                                      │ died, and its handler is respawn
waiting → building → ready → running ───────────────┤
             │         │        │                   ├─► ended     (ignore: the others go on; exit: the node ends)
             └─────────┴────────┴─► stopping        └─► gave up   (limit reached, or a bad configuration: the node ends)
                                       └─► stopped
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import socket
import subprocess
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from .cgroup import ControlGroups
from .channel import LINE_BYTES, pack_line
from .child import CONFIGURATION
from .placement import place
from .restarts import Restarts
from .run_folder import RotatedLog
from .schema import ProcessSpec

__all__ = ["State", "SupervisedProcess"]

_TERM_GRACE_S = 2.0
"""How long a process that hangs may take to end on SIGTERM before SIGKILL [s]."""
_LAST_LINES = 40
_DRAIN_S = 1.0


class State(Enum):
    """Where a process is in its life."""

    WAITING = "waiting"
    BUILDING = "building"
    """It makes and validates its components."""
    READY = "ready"
    """All is made; it starts when the others of the node are ready too."""
    RUNNING = "running"
    BACKING_OFF = "back off"
    """It died, and waits for its next start."""
    STOPPING = "stopping"
    STOPPED = "stopped"
    """It was asked to end, and did."""
    ENDED = "ended"
    """It ended unasked, and is not started again."""
    GAVE_UP = "gave up"
    """It died too often, or cannot be built."""


FINAL = (State.STOPPED, State.ENDED, State.GAVE_UP)


@dataclass
class _Life:
    """What belongs to one start of the process."""

    process: subprocess.Popen[bytes]
    pidfd: int
    started: float
    writer: asyncio.StreamWriter
    tasks: list[asyncio.Task[None]]
    output: asyncio.ReadTransport
    mail: asyncio.Queue[tuple[str, Any]]
    heard: float
    patience_s: float
    """How long it may take to stop."""
    error: str = ""
    """What it said of its end."""
    hung: str = ""
    """Why it was killed."""
    restarting: bool = False
    answers: dict[int, asyncio.Future[dict[str, Any]]] = field(default_factory=dict)


class SupervisedProcess:
    """Runs one process of a node through all its lives."""

    def __init__(
        self,
        spec: ProcessSpec,
        command: Sequence[str],
        log: RotatedLog,
        *,
        groups: ControlGroups,
        on_event: Callable[[dict[str, Any]], None],
        may_start: Callable[[], bool] = lambda: True,
        before_start: Callable[[], None] = lambda: None,
    ) -> None:
        """Makes it; nothing is started.

        Args:
            spec: The process, as the launch file says.
            command: What is executed; `--channel FD --parent PID` is added to it.
            log: Where its output goes.
            groups: For its cgroup.
            on_event: Is told of everything that happens to it.
            may_start: Whether its components may start as soon as they are ready.
            before_start: Is called before it is started again after a death.
        """
        self.spec = spec
        self.name = spec.name
        self.state = State.WAITING
        self.restarts = Restarts(spec.back_off, spec.restarts)
        self.deaths: Counter[str] = Counter()
        """How often it died, by cause."""
        self.last_death = ""
        self.gave_up_because = ""
        """Why it is not started any more."""
        self.exit_code: int | None = None
        self.refused = ""
        """Why it cannot be built, as it said in its latest life."""
        self.components: Mapping[str, Any] = {}
        """What it consists of, as it said when it was ready."""
        self.beat: Mapping[str, Any] = {}
        """Its last sign of life."""
        self.warnings: list[str] = []
        self.last_lines: deque[str] = deque(maxlen=_LAST_LINES)
        self._command = list(command)
        self._log = log
        self._groups = groups
        self._on_event = on_event
        self._may_start = may_start
        self._before_start = before_start
        self._life: _Life | None = None
        self._partial = b""
        self._ran = False
        self._asked_to_stop = False
        self._stop_wish = asyncio.Event()
        self._hurry_s: float | None = None
        self._numbers = 0
        self.changed = asyncio.Condition()

    @property
    def pid(self) -> int | None:
        """Its process id, while it lives."""
        return None if self._life is None else self._life.process.pid

    @property
    def may_be_missing(self) -> bool:
        """Whether the others go on without it now that it has ended."""
        return self.state is State.ENDED and self.spec.exception_handler == "ignore"

    @property
    def uptime_s(self) -> float | None:
        """Since its latest start [s]."""
        return None if self._life is None else time.monotonic() - self._life.started

    @property
    def silent_s(self) -> float | None:
        """Since its last sign of life [s]."""
        return None if self._life is None else time.monotonic() - self._life.heard

    @property
    def log_path(self) -> str:
        """The file of its output."""
        return str(self._log.path)

    def _tell(self, event: str, **details: Any) -> None:
        self._on_event({"event": event, "process": self.name, **details})

    async def _enter(self, state: State, **details: Any) -> None:
        self.state = state
        self._tell("state", state=state.value, **details)
        async with self.changed:
            self.changed.notify_all()

    async def give_up(self, reason: str) -> None:
        """Leaves it in a final state; for when its supervision itself failed."""
        life, self._life = self._life, None
        if life is not None:
            self._signal(life, signal.SIGKILL)
            while (await life.mail.get())[0] != "exit":
                pass
            self._close(life)
        self.gave_up_because = reason
        await self._enter(State.GAVE_UP, reason=reason)

    async def wait_for(self, *states: State) -> None:
        """Waits until it is in one of these states, or in one that is final."""
        async with self.changed:
            await self.changed.wait_for(lambda: self.state in states or self.state in FINAL)

    async def live(self) -> None:
        """Lives, until it was asked to stop, or ended in another way that is final."""
        self._log.write(b"")  # opens it: what a supervisor holds does not depend on what its processes print
        try:
            while not self._asked_to_stop:
                code = await self._one_life()
                if self._asked_to_stop:
                    break
                wait = await self._after_death(code)
                if wait is None:
                    return
                await self._enter(State.BACKING_OFF, seconds=round(wait, 3))
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._stop_wish.wait(), wait)
                if not self._asked_to_stop:
                    self._before_start()
            await self._enter(State.STOPPED, code=self.exit_code)
        finally:
            self._log.close()

    async def _after_death(self, code: int) -> float | None:
        """What follows a death that nobody asked for: how long to wait for the next start [s]; None: there is none."""
        if self.refused and not self._ran:
            self.gave_up_because = self.refused
            await self._enter(State.GAVE_UP, reason=self.refused)
            return None
        if self.spec.exception_handler != "respawn":
            await self._enter(State.ENDED, reason=self.last_death, code=code)
            return None
        wait = self.restarts.died(time.monotonic())
        if wait is None:
            self.gave_up_because = f"{self.restarts.said()} did not help; the last time it {self.last_death}"
            await self._enter(State.GAVE_UP, reason=self.gave_up_because)
        return wait

    async def _one_life(self) -> int:
        """From a start to the end of the process; gives its exit code, negative for a signal."""
        self.refused = ""
        await self._enter(State.BUILDING)
        try:
            life = self._life = await self._spawn()
        except OSError as error:
            self.last_death = f"could not be started: {error.strerror or error}"
            self.deaths["not started"] += 1
            self._tell("died", cause="not started", reason=self.last_death, last_lines=[])
            return 1
        due: float | None = time.monotonic() + self.spec.start_timeout_s
        killing = False
        while True:
            kind, what = await self._next_mail(life, due)
            now = time.monotonic()
            if kind == "exit":
                return await self._bury(life, what)
            if kind == "overdue":
                if killing:
                    self._signal(life, signal.SIGKILL)
                    due = None
                elif self.state is State.STOPPING:
                    life.hung = f"did not stop within {life.patience_s:g} s"
                    self._kill_hanging(life)
                    killing, due = True, now + 0.2
                elif self.state is State.RUNNING and (rest := self._still_patient(life, now, due or now)) > 0:
                    due = now + rest
                else:
                    limit = self.spec.health_timeout_s if self.state is State.RUNNING else self.spec.start_timeout_s
                    what = "gave no sign of life" if self.state is State.RUNNING else "was not ready"
                    life.hung = f"{what} for {limit:g} s"
                    self._kill_hanging(life)
                    killing, due = True, now + _TERM_GRACE_S
            elif kind == "stop" and not killing and self.state is not State.STOPPING:
                building = self.state is State.BUILDING
                await self._enter(State.STOPPING)
                due = now + self.spec.stop_timeout_s
                if not self._send(life, {"do": "stop"}) or building:
                    self._signal(life, signal.SIGTERM)
            elif kind == "hurry" and not killing:
                due = now + what if due is None else min(due, now + what)
                life.patience_s = min(life.patience_s, what)
            elif kind == "kill":
                killing, due = True, now
            elif kind == "start":
                self._send(life, {"do": "start"})
            elif kind == "report":
                if await self._take_report(life, what):
                    due = None if self.spec.health_timeout_s is None else now + self.spec.health_timeout_s
                if self.state is State.READY:
                    due = None
                hanging = what.get("hanging")
                if hanging and self.state is State.RUNNING and not killing:
                    life.hung = f"hangs: {', '.join(hanging)}"
                    self._kill_hanging(life)
                    killing, due = True, now + _TERM_GRACE_S

    def _still_patient(self, life: _Life, now: float, due: float) -> float:
        """How long to wait on for a sign of life [s]; 0: no more."""
        timeout = self.spec.health_timeout_s or 0.0
        silent = now - life.heard
        if silent < timeout:
            return timeout - silent
        # Where this process did not come to run itself, the machine is busy: nobody can be said to hang.
        return timeout / 4 if now - due > timeout / 10 else 0.0

    @staticmethod
    async def _next_mail(life: _Life, due: float | None) -> tuple[str, Any]:
        if due is None or not life.mail.empty():
            return await life.mail.get()
        try:
            async with asyncio.timeout(max(0.0, due - time.monotonic())):
                return await life.mail.get()
        except TimeoutError:
            return "overdue", None

    async def _take_report(self, life: _Life, report: dict[str, Any]) -> bool:
        """Takes what the process said; True where it began to run with it."""
        kind = report.get("report")
        if kind in ("running", "beat", "stopped"):
            self.beat = report
        if kind == "ready" and self.state is State.BUILDING:
            self.components = report.get("components", {})
            await self._enter(State.READY, seconds=round(time.monotonic() - life.started, 3))
            if self._may_start():
                self._send(life, {"do": "start"})
        elif kind == "running" and self.state is State.READY:
            self._ran = True
            await self._enter(State.RUNNING, pid=life.process.pid)
            return True
        elif kind in ("failed", "broke"):
            life.error = str(report.get("error", ""))
            self.refused = life.error if kind == "failed" else ""
        elif kind == "warning":
            self.warn(str(report.get("message", "")))
        elif kind == "answer":
            answer = life.answers.pop(report.get("id", -1), None)
            if answer is not None and not answer.done():
                answer.set_result(report)
        return False

    def warn(self, message: str) -> None:
        """Notes that something is not as the launch file says."""
        if message not in self.warnings:
            self.warnings.append(message)
            self._tell("warning", message=message)

    def go(self) -> None:
        """Lets its components start; it is ready."""
        if self._life is not None:
            self._life.mail.put_nowait(("start", None))

    def ask_to_stop(self) -> None:
        """Lets it end: cleanly, and if that takes too long all the same."""
        self._asked_to_stop = True
        self._stop_wish.set()
        if self._life is not None:
            self._life.mail.put_nowait(("stop", None))

    def hurry(self, seconds: float) -> None:
        """Lets it end, and kills it if it has not by then; it may have been asked to stop already."""
        self.ask_to_stop()
        self._hurry_s = seconds
        if self._life is not None:
            self._life.mail.put_nowait(("hurry", seconds))

    def kill(self) -> None:
        """Ends it at once."""
        self._asked_to_stop = True
        self._stop_wish.set()
        if self._life is not None:
            self._life.mail.put_nowait(("kill", None))

    def restart(self) -> None:
        """Stops it and lets it start again; that counts as a death of the cause `restarted`."""
        if self._life is not None and self.state is State.RUNNING:
            self._life.restarting = True
            self._life.mail.put_nowait(("stop", None))

    async def ask(self, order: dict[str, Any], timeout_s: float = 5.0) -> dict[str, Any]:
        """Sends it an order and waits for the answer.

        Raises:
            TimeoutError: There is none in time.
            ConnectionError: It does not run.
        """
        life = self._life
        if life is None or self.state is not State.RUNNING:
            raise ConnectionError(f"process {self.name!r} is not running: it is {self.state.value}")
        self._numbers += 1
        answer: asyncio.Future[dict[str, Any]] = asyncio.get_running_loop().create_future()
        life.answers[self._numbers] = answer
        if not self._send(life, {**order, "id": self._numbers}):
            raise ConnectionError(f"process {self.name!r} does not listen")
        return await asyncio.wait_for(answer, timeout_s)

    async def _spawn(self) -> _Life:
        """Starts the process, with its channel, its output and the news of its end.

        Raises:
            OSError: It cannot be started.
        """
        loop = asyncio.get_running_loop()
        ours, theirs = socket.socketpair()
        try:
            with theirs:
                process = subprocess.Popen(
                    [*self._command, "--channel", str(theirs.fileno()), "--parent", str(os.getpid())],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    pass_fds=[theirs.fileno()],
                    env={**os.environ, "PYTHONUNBUFFERED": "1", "PYTHONFAULTHANDLER": "1", **self.spec.environment},
                    # A session of its own: an interrupt on the terminal does not reach it, and what it starts is
                    # found as its process group.
                    start_new_session=True,
                )
        except OSError:
            ours.close()
            raise
        if self.spec.group is not None:
            for warning in self._groups.join(self.spec.group, process.pid, self.spec.limits):
                self.warn(warning)
        for warning in place(process.pid, self.spec):
            self.warn(warning)
        mail: asyncio.Queue[tuple[str, Any]] = asyncio.Queue()
        pidfd = os.pidfd_open(process.pid)
        loop.add_reader(pidfd, self._ended, loop, pidfd, process, mail)
        ours.setblocking(False)
        reader, writer = await asyncio.open_unix_connection(sock=ours, limit=LINE_BYTES)
        assert process.stdout is not None
        output, _ = await loop.connect_read_pipe(lambda: _Output(self._take_output), process.stdout)
        now = time.monotonic()
        if self._asked_to_stop:
            mail.put_nowait(("stop", None))
        if self._hurry_s is not None:
            mail.put_nowait(("hurry", self._hurry_s))
        life = _Life(process, pidfd, now, writer, [], output, mail, now, self.spec.stop_timeout_s)
        life.tasks.append(asyncio.create_task(self._read_reports(reader, life)))
        return life

    @staticmethod
    def _ended(
        loop: asyncio.AbstractEventLoop,
        pidfd: int,
        process: subprocess.Popen[bytes],
        mail: asyncio.Queue[tuple[str, Any]],
    ) -> None:
        loop.remove_reader(pidfd)
        # While it is not reaped its number is its own: what it has left of its group is killed without mistake.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        mail.put_nowait(("exit", process.wait()))

    async def _read_reports(self, reader: asyncio.StreamReader, life: _Life) -> None:
        with contextlib.suppress(OSError, ValueError, asyncio.LimitOverrunError):
            while line := await reader.readline():
                report = json.loads(line)
                if not isinstance(report, dict):
                    continue
                life.heard = time.monotonic()
                if report.get("report") == "beat" and not report.get("hanging"):
                    self.beat = report  # all that there is to do in most of the seconds of a life
                else:
                    life.mail.put_nowait(("report", report))

    def _take_output(self, data: bytes) -> None:
        self._log.write(data)
        *lines, self._partial = (self._partial + data).split(b"\n")
        self._partial = self._partial[-4096:]
        self.last_lines.extend(line[-2000:].decode(errors="replace") for line in lines[-_LAST_LINES:])

    @staticmethod
    def _send(life: _Life, message: Mapping[str, Any]) -> bool:
        if life.writer.is_closing():
            return False
        life.writer.write(pack_line(message))
        return True

    def _kill_hanging(self, life: _Life) -> None:
        """Has its threads printed into its log, then asks it to end; SIGKILL comes later."""
        self._tell("hangs", reason=life.hung, pid=life.process.pid)
        self._signal(life, signal.SIGUSR1)
        self._signal(life, signal.SIGTERM)

    @staticmethod
    def _signal(life: _Life, number: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(life.pidfd, number)

    async def _bury(self, life: _Life, code: int) -> int:
        """Takes the last that a process said, lets go of all that belonged to it, and tells of its death."""
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(asyncio.gather(*life.tasks), _DRAIN_S)
        while not life.mail.empty():
            kind, what = life.mail.get_nowait()
            if kind == "report":
                await self._take_report(life, what)
        output = life.output.get_extra_info("pipe")
        with contextlib.suppress(OSError, ValueError):  # what it printed last may not have been read yet
            while data := os.read(output.fileno(), 1 << 16):
                self._take_output(data)
        self._close(life)
        if self._partial:
            self.last_lines.append(self._partial.decode(errors="replace"))
            self._partial = b""
        self._life = None
        self.exit_code = code
        asked = self._asked_to_stop and not life.hung
        cause = "restarted" if life.restarting else "hung" if life.hung else _cause(code)
        said = [life.hung] if life.hung else []
        said += [_exit_text(code), *([life.error] if life.error else [])]
        reason = "; ".join(said)
        if asked and code == 0:
            self._tell("exited", code=0)
        else:
            self.deaths[cause] += 1
            self.last_death = reason if not asked else self.last_death
            self._tell("died", cause=cause, reason=reason, code=code, last_lines=list(self.last_lines)[-10:])
        return code

    def _close(self, life: _Life) -> None:
        life.output.close()
        life.writer.close()
        os.close(life.pidfd)
        for task in life.tasks:
            task.cancel()
        for answer in life.answers.values():
            if not answer.done():
                answer.set_exception(ConnectionError(f"process {self.name!r} ended"))
                answer.exception()  # nobody may be waiting any more


def _cause(code: int) -> str:
    if code < 0:
        return f"signal {-code}"
    return "configuration" if code == CONFIGURATION else f"exit {code}"


def _exit_text(code: int) -> str:
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
