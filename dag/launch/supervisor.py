"""The supervisor of a node: all its processes are ready, or none starts; watched until they are to end; then stopped.

It sleeps until something happens: the end of a process (pidfd), a message of one, a request, a signal, a time.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
import logging
import os
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ...errors import ConfigError
from ..configuration import nearest
from .cgroup import ControlGroups
from .control import ControlServer
from .order import consumers_first
from .plan import LaunchPlan, plan_zenoh
from .run_folder import RotatedLog, RunFolder
from .schema import ProcessSpec
from .signals import SignalInbox
from .status import node_status, topic_status
from .supervised import FINAL, State, SupervisedProcess

if TYPE_CHECKING:
    from .linking import LinkPlan

__all__ = ["HURRY_S", "Supervisor"]

HURRY_S = 2.0
"""How long a process may take to stop after a second signal: enough to close what it records [s]."""

_log = logging.getLogger(__name__)

Event = dict[str, Any]


class Supervisor:
    """Starts, watches and stops the processes of one node."""

    def __init__(
        self,
        plan: LaunchPlan,
        links: Mapping[str, LinkPlan],
        command: Callable[[ProcessSpec, RunFolder], Sequence[str]],
        *,
        reap: Callable[..., Sequence[str]] = lambda node, orders: (),
        on_event: Callable[[Event], None] = lambda event: None,
        child_plan: Callable[[ProcessSpec], Mapping[str, Any]] = lambda spec: {},
        refresh: tuple[float, Callable[[], None]] | None = None,
    ) -> None:
        """Makes it; nothing is started.

        Args:
            plan: What is to run, validated.
            links: The topics between the processes, by process.
            command: What is executed for a process.
            reap: Removes what dead processes of the node have left of their transport, gives the names of that; and
                with `orders` false keeps what says to those that come back how far they were.
            on_event: Is told of everything that happens.
            child_plan: What a process is told in its plan file, further to its name.
            refresh: Every how many seconds something is called that shows the state; None: never.
        """
        self.plan = plan
        self.links = links
        self.folder = RunFolder(plan.node)
        self.processes: dict[str, SupervisedProcess] = {}
        self.reaped: list[str] = []
        self._command = command
        self._reap = reap
        self._on_event = on_event
        self._child_plan = child_plan
        self._refresh = refresh
        self._groups = ControlGroups(ledger=self.folder.path / "cgroups")
        self._gate_open = False
        self._ending: asyncio.Event = asyncio.Event()
        self._exit_code = 0
        self._reason = ""
        self._haste = 0
        self._control: ControlServer | None = None
        self._started = time.monotonic()

    def run(self) -> int:
        """Runs the node until it ends.

        Returns:
            0 after a stop that was asked for, 2 where a process could not be built, 1 where one died for good.

        Raises:
            ConfigError: The node runs already, or its folder or socket cannot be made.
        """
        if not hasattr(os, "pidfd_open"):
            raise ConfigError("the launcher runs on Linux alone: it watches processes by pidfd")
        self.folder.open()
        try:
            with SignalInbox((signal.SIGINT, signal.SIGTERM, signal.SIGHUP)) as signals:
                try:
                    return asyncio.run(self._run(signals))
                finally:
                    self._groups.close()
        finally:
            self.folder.close()

    def _tell(self, event: Event) -> None:
        event = {"time": round(time.time(), 3), "node": self.plan.node, **event}
        try:
            self._on_event(event)
        except Exception:  # what only shows must not stop what supervises
            _log.exception("an event cannot be shown")
        if self._control is not None:
            self._control.tell(event)

    async def _run(self, signals: SignalInbox) -> int:
        signals.deliver(asyncio.get_running_loop(), self._interrupted)
        self._control = ControlServer(self.folder.control, self._answers())
        await self._control.open()
        try:
            self._clean(self._groups.reap())
            for spec in self.plan.spec.processes:
                self._add(spec)
            self._tell({"event": "launching", "pid": os.getpid(), "processes": list(self.processes)})
            lives = {name: asyncio.create_task(process.live()) for name, process in self.processes.items()}
            watch = [asyncio.create_task(self._watch(self.processes[name], task)) for name, task in lives.items()]
            beside = [asyncio.create_task(self._open_gate()), asyncio.create_task(self._show())]
            await self._ending.wait()
            beside[0].cancel()
            await self._stop()
            await asyncio.gather(*watch)
            beside[1].cancel()
            self._clean()
            self._tell({"event": "ended", "code": self._exit_code, "reason": self._reason})
            return self._exit_code
        finally:
            await self._control.close()

    def _add(self, spec: ProcessSpec) -> None:
        plan = {
            "node": self.plan.node,
            "process": spec.model_dump(),
            "links": dataclasses.asdict(self.links[spec.name]),
            "shared_memory": self.plan.spec.shared_memory.model_dump(),
            "zenoh": plan_zenoh(self.links, self.plan.spec.zenoh)[spec.name].model_dump(),
            **self._child_plan(spec),
        }
        text = json.dumps(plan, default=str)
        self.folder.write_plan(spec.name, text)

        def before_start() -> None:
            self._clean(orders=False)
            if not self.folder.plan(spec.name).exists():  # what lies in /tmp for days may be tidied away
                with contextlib.suppress(ConfigError):  # then the process says that it finds no plan
                    self.folder.write_plan(spec.name, text)

        self.processes[spec.name] = SupervisedProcess(
            spec,
            self._command(spec, self.folder),
            RotatedLog(self.folder.log(spec.name)),
            groups=self._groups,
            on_event=self._tell,
            may_start=lambda: self._gate_open,
            before_start=before_start,
        )

    def _clean(self, removed: Sequence[str] = (), *, orders: bool = True) -> None:
        """Removes what dead processes have left, and tells of it, and of what was removed just before."""
        removed = list(removed)
        try:
            removed += self._reap(self.plan.node, orders=orders)
        except OSError as error:
            _log.warning("what dead processes left cannot be removed: %s", error)
        if removed:
            self.reaped += removed
            self._tell({"event": "reaped", "removed": removed})

    def start_order(self) -> list[str]:
        """The names of the processes: consumers before producers."""
        exports = {name: set(self.links[name].exports) for name in self.links}
        imports = {name: set(self.links[name].imports) for name in self.links}
        return consumers_first(exports, imports)

    async def _open_gate(self) -> None:
        """When all are ready, lets them start one after the other."""
        processes = self.processes.values()
        while waiting := [one for one in processes if one.state is not State.READY and not one.may_be_missing]:
            if waiting[0].state in FINAL:
                return  # the node ends, and nothing of it has started
            await waiting[0].wait_for(State.READY)
        for name in self.start_order():
            process = self.processes[name]
            while process.state is not State.RUNNING and process.state not in FINAL:
                if process.state is State.READY:
                    process.go()
                    await process.wait_for(State.RUNNING, State.BACKING_OFF, State.BUILDING)
                else:
                    await process.wait_for(State.READY)
            if process.state in FINAL and not process.may_be_missing:
                return
        self._gate_open = True
        for process in self.processes.values():  # one that died meanwhile may be ready again
            if process.state is State.READY:
                process.go()
        self._tell({"event": "up", "seconds": round(time.monotonic() - self._started, 3)})

    async def _show(self) -> None:
        while self._refresh is not None:
            await asyncio.sleep(self._refresh[0])
            try:
                self._refresh[1]()
            except Exception:
                _log.exception("the state cannot be shown")

    async def _watch(self, process: SupervisedProcess, life: asyncio.Task[None]) -> None:
        """Ends the node where the end of a process asks for that."""
        try:
            await life
        except Exception as error:  # a mistake of ours must not leave the others without a supervisor
            _log.exception("the supervision of %s failed", process.name)
            await process.give_up(f"its supervision failed: {type(error).__name__}: {error}")
        if process.state is State.GAVE_UP:
            self._end(2 if process.refused else 1, f"{process.name}: {process.gave_up_because}")
        elif process.state is State.ENDED and process.spec.exception_handler == "exit":
            self._end(0 if process.exit_code == 0 else 1, f"{process.name} {process.last_death}")
        elif all(one.state in FINAL for one in self.processes.values()):
            failed = any(one.exit_code for one in self.processes.values())
            self._end(1 if failed else 0, "no process is left")

    def _end(self, code: int, reason: str) -> None:
        if not self._ending.is_set():
            self._exit_code, self._reason = code, reason
            self._ending.set()
            self._tell({"event": "ending", "code": code, "reason": reason})

    def _interrupted(self, number: int) -> None:
        """The first signal stops the node in order; the second lets all stop at once, and soon; the third kills."""
        if not self._ending.is_set():
            self._end(0, signal.Signals(number).name)
        elif number != signal.SIGHUP:  # a terminal that is closed may send several
            self._haste += 1
            seconds = HURRY_S if self._haste == 1 else 0.0
            self._tell({"event": "hurried", "reason": signal.Signals(number).name, "seconds": seconds})
            for process in self.processes.values():
                process.hurry(seconds) if seconds else process.kill()

    async def _stop(self) -> None:
        """Stops the processes, those that produce first, each after it has ended."""
        for name in reversed(self.start_order()):
            process = self.processes[name]
            process.ask_to_stop()
            await process.wait_for()

    def _answers(self) -> dict[str, Callable[[Mapping[str, Any]], Any]]:
        return {
            "ps": self._ps,
            "topics": self._topics,
            "export": self._export,
            "restart": self._restart,
            "stop": self._stop_asked,
        }

    def status(self) -> dict[str, Any]:
        """What `ps` is answered."""
        return node_status(self.plan.spec, self.processes.values(), self.reaped)

    async def _ps(self, _: Mapping[str, Any]) -> dict[str, Any]:
        return self.status()

    async def _topics(self, _: Mapping[str, Any]) -> dict[str, Any]:
        return topic_status(self.processes.values())

    def producer(self, topic: str) -> SupervisedProcess:
        """The process that commits a topic.

        Raises:
            ConfigError: None does.
        """
        known: dict[str, SupervisedProcess] = {}
        for process in self.processes.values():
            for component in process.components.values():
                known.update(dict.fromkeys(component.get("outputs", ()), process))
        if topic not in known:
            raise ConfigError(f"nobody commits topic {topic!r}; {nearest(topic, known)}")
        return known[topic]

    async def _export(self, request: Mapping[str, Any]) -> dict[str, Any]:
        topic = str(request.get("topic", ""))
        process = self.producer(topic)
        if refused := await process.export(topic):
            raise ConfigError(f"topic {topic!r}: {refused}")
        return {"process": process.name, "topic": topic}

    async def _restart(self, request: Mapping[str, Any]) -> dict[str, Any]:
        name = str(request.get("process", ""))
        if name not in self.processes:
            raise ConfigError(f"no process {name!r}; {nearest(name, self.processes)}")
        self.processes[name].restart()
        return {"process": name}

    async def _stop_asked(self, _: Mapping[str, Any]) -> dict[str, Any]:
        self._end(0, "asked to stop")
        return {}
