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
import signal
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from typing import Any

from .cgroup import ControlGroups
from .child import CONFIGURATION
from .life import Life, Printed, exit_text
from .placement import place
from .restarts import Restarts
from .run_folder import RotatedLog
from .schema import ProcessSpec

__all__ = ["State", "SupervisedProcess"]

_TERM_GRACE_S = 2.0
"""How long a process that hangs may take to end on SIGTERM before SIGKILL [s]."""
_TOLD_LINES = 10
"""How many of the last lines that it printed are told with its death."""
_LAST_GRACE_S = 0.2
"""The same of one that did not stop in its time [s]."""


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
_NOT_DONE = {
    State.BUILDING: "was not ready for",
    State.READY: "did not start its components within",
    State.RUNNING: "gave no sign of life for",
}
"""What a process did not do that is killed for it, by its state."""


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
        self._command = list(command)
        self._printed = Printed(log)
        self._groups = groups
        self._on_event = on_event
        self._may_start = may_start
        self._before_start = before_start
        self._life: Life | None = None
        self._ran = False
        self._asked_to_stop = False
        self._stop_wish = asyncio.Event()
        self._restarting = False
        self._hurry_s: float | None = None
        self._numbers = 0
        self._serving = False
        self._exports: set[str] = set()
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
        return self._printed.path

    @property
    def log_lost(self) -> int:
        """Bytes of its output that this file could not take, as on a full disk."""
        return self._printed.lost

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
            life.signal(signal.SIGKILL)
            while life.process.returncode is None:  # its end is mail, too
                await life.mail.get()
            life.close(self.name)
        self.gave_up_because = reason
        await self._enter(State.GAVE_UP, reason=reason)

    async def wait_for(self, *states: State) -> None:
        """Waits until it is in one of these states, or in one that is final."""
        async with self.changed:
            await self.changed.wait_for(lambda: self.state in states or self.state in FINAL)

    async def live(self) -> None:
        """Lives, until it was asked to stop, or ended in another way that is final."""
        self._printed.open()
        try:
            while not self._asked_to_stop:
                code = await self._one_life()
                if self._asked_to_stop:
                    break
                self._forget_life()
                if self._restarting:
                    self._restarting = False
                    self._before_start()
                    continue
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
            self._printed.close()

    def _forget_life(self) -> None:
        """What a dead one said holds no more; what is read of it will be read of the next."""
        links = self.beat.get("links", {})
        self._exports = {topic for topic in self._exports if links.get(topic, {}).get("readers")}
        self.beat = {}
        self._serving = False

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
            life = self._life = await self._begin()
        except OSError as error:
            self.last_death = f"could not be started: {error.strerror or error}"
            self.deaths["not started"] += 1
            self._tell("died", cause="not started", reason=self.last_death, last_lines=[])
            return 1
        due: float | None = time.monotonic() + self.spec.start_timeout_s
        killing = False
        while True:
            kind, what = await life.next_mail(due)
            now = time.monotonic()
            if kind == "exit":
                return await self._bury(life, what)
            if kind == "overdue":
                if killing:
                    life.signal(signal.SIGKILL)
                    due = None
                elif self.state is State.STOPPING:
                    life.hung = f"did not stop within {life.patience_s:g} s"
                    self._kill_hanging(life)
                    killing, due = True, now + _LAST_GRACE_S
                elif self.state is State.RUNNING and (rest := self._still_patient(life, now, due or now)) > 0:
                    due = now + rest
                else:
                    limit = self.spec.health_timeout_s if self.state is State.RUNNING else self.spec.start_timeout_s
                    life.hung = f"{_NOT_DONE[self.state]} {limit:g} s"
                    self._kill_hanging(life)
                    killing, due = True, now + _TERM_GRACE_S
            elif kind == "stop" and not killing and self.state is not State.STOPPING:
                building = self.state is State.BUILDING
                await self._enter(State.STOPPING)
                due = now + self.spec.stop_timeout_s
                if not life.send({"do": "stop"}) or building:
                    life.signal(signal.SIGTERM)
            elif kind == "hurry" and not killing:
                due = now + what if due is None else min(due, now + what)
                life.patience_s = min(life.patience_s, what)
            elif kind == "kill":
                killing, due = True, now
            elif kind == "start" and not killing and self.state is State.READY:
                life.send({"do": "start"})
                due = now + self.spec.start_timeout_s
            elif kind == "report":
                if await self._take_report(life, what):
                    due = None if self.spec.health_timeout_s is None else now + self.spec.health_timeout_s
                elif what.get("report") == "ready" and self.state is State.READY and not killing:
                    due = None  # it waits for the others, however long they take
                    if self._may_start():
                        life.mail.put_nowait(("start", None))
                hanging = what.get("hanging")
                if hanging and self.state is State.RUNNING and not killing:
                    life.hung = f"hangs: {', '.join(hanging)}"
                    self._kill_hanging(life)
                    killing, due = True, now + _TERM_GRACE_S

    def _still_patient(self, life: Life, now: float, due: float) -> float:
        """How long to wait on for a sign of life [s]; 0: no more."""
        timeout = self.spec.health_timeout_s or 0.0
        silent = now - life.heard
        if silent < timeout:
            return timeout - silent
        # Where this process did not come to run itself, the machine is busy: nobody can be said to hang.
        return timeout / 4 if now - due > timeout / 10 else 0.0

    async def _take_report(self, life: Life, report: dict[str, Any]) -> bool:
        """Takes what the process said; True where it began to run with it."""
        kind = report.get("report")
        if kind in ("beat", "stopped"):
            self._take_beat(report)
        if kind == "ready" and self.state is State.BUILDING:
            self.components = report.get("components", {})
            await self._enter(State.READY, seconds=round(time.monotonic() - life.started, 3))
        elif kind == "running" and self.state is State.READY:
            self._ran = True
            await self._enter(State.RUNNING, pid=life.process.pid)
            self._take_beat(self.beat or report)  # beats do not queue behind what is to be acted on
            for topic in self._exports:  # who listens goes on listening
                life.send({"do": "export", "topic": topic})
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
        """Stops it and starts it again, whatever is said of its deaths; it is counted under the cause `restarted`.

        Raises:
            ConnectionError: It does not run.
        """
        if self._life is None or self.state is not State.RUNNING:
            raise ConnectionError(f"process {self.name!r} is not running: it is {self.state.value}")
        self._restarting = True
        self.restarts.count += 1
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
        if not life.send({**order, "id": self._numbers}):
            raise ConnectionError(f"process {self.name!r} does not listen")
        return await asyncio.wait_for(answer, timeout_s)

    async def export(self, topic: str) -> str:
        """Lets it send a topic to whoever asks, in its later lives too while somebody reads; gives why not, or "".

        Raises:
            TimeoutError: It does not answer in time.
            ConnectionError: It does not run.
        """
        answer = await self.ask({"do": "export", "topic": topic})
        if "error" not in answer:
            self._exports.add(topic)
        return str(answer.get("error", ""))

    async def _begin(self) -> Life:
        """Starts the process where and as the launch file says.

        Raises:
            OSError: It cannot be started.
        """
        life = await Life.begin(
            self._command,
            self.spec.environment,
            patience_s=self.spec.stop_timeout_s,
            place=self._place,
            printed=self._printed,
            on_beat=self._take_beat,
        )
        if self._asked_to_stop:
            life.mail.put_nowait(("stop", None))
        if self._hurry_s is not None:
            life.mail.put_nowait(("hurry", self._hurry_s))
        return life

    def _place(self, pid: int) -> None:
        warnings = [] if self.spec.group is None else self._groups.join(self.spec.group, pid, self.spec.limits)
        for warning in (*warnings, *place(pid, self.spec)):
            self.warn(warning)

    def _take_beat(self, beat: Mapping[str, Any]) -> None:
        self.beat = beat
        life = self._life
        if life is not None and not self._serving and self.state is State.RUNNING and not beat.get("starting"):
            self._serving = True
            self._tell("serving", seconds=round(time.monotonic() - life.started, 3))

    def _kill_hanging(self, life: Life) -> None:
        """Has its threads printed into its log, then asks it to end; SIGKILL comes later."""
        self._tell("hangs", reason=life.hung, pid=life.process.pid)
        life.signal(signal.SIGUSR1)
        life.signal(signal.SIGTERM)

    async def _bury(self, life: Life, code: int) -> int:
        """Takes the last that a process said, lets go of all that belonged to it, and tells of its death."""
        for report in await life.last_reports(self._printed):
            await self._take_report(life, report)
        life.close(self.name)
        self._printed.end_line()
        self._life = None
        self.exit_code = code
        asked = self._asked_to_stop and not life.hung
        cause = "restarted" if self._restarting else "hung" if life.hung else _cause(code)
        said = [life.hung] if life.hung else []
        said += [exit_text(code), *([life.error] if life.error else [])]
        reason = "; ".join(said)
        if asked and code == 0:
            self._tell("exited", code=0)
        else:
            self.deaths[cause] += 1
            self.last_death = reason if not asked else self.last_death
            self._tell(
                "died", cause=cause, reason=reason, code=code, last_lines=list(self._printed.last_lines)[-_TOLD_LINES:]
            )
        return code


def _cause(code: int) -> str:
    if code < 0:
        return f"signal {-code}"
    return "configuration" if code == CONFIGURATION else f"exit {code}"
