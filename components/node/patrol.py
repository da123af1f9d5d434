"""The patrol: looks at the processes of the node through the supervisor's control plane, and says what is not well."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import Field

from ...dag import DataProcessComponent, ProcessorConfig, Trigger
from ...dag.launch.control import ControlClient, connect
from ...dag.launch.run_folder import RunFolder, running_nodes
from ...datamesh import CommitPolicy, Output, Status
from ...datamesh.messages import message
from ...errors import WarploomError

__all__ = ["PatrolReport", "ProcessPatrol", "ProcessPatrolConfig", "ProcessSeen", "alarms_of", "node_of"]

_log = logging.getLogger(__name__)


@message("warploom.ProcessSeen")
@dataclass(frozen=True, kw_only=True)
class ProcessSeen:
    """One process of the node at one time."""

    name: str
    state: str
    """As `warploom ps` says it."""
    pid: int
    """−1 where it has none."""
    restarts: int
    silent_s: float
    """Since its latest sign of life [s]; NaN where it never gave one."""
    resident_mib: float
    """Memory that is in RAM [MiB]; NaN where it is not known."""


@message("warploom.PatrolReport")
@dataclass(frozen=True, kw_only=True)
class PatrolReport:
    """All processes of the node at one time, and what is not well."""

    node: str
    processes: tuple[ProcessSeen, ...]
    alarms: tuple[str, ...]


class ProcessPatrolConfig(ProcessorConfig):
    """What is not well."""

    silent_s: float = Field(5.0, gt=0.0, le=86_400.0)
    """Without a sign of life for so long [s]."""
    resident_mib: float | None = Field(None, gt=0.0)
    """More memory than this [MiB]; null: any is well."""


def seen_in(status: Mapping[str, Any]) -> tuple[ProcessSeen, ...]:
    """The processes in the supervisor's answer to `ps`."""
    nan = float("nan")
    return tuple(
        ProcessSeen(
            name=one["name"],
            state=one["state"],
            pid=-1 if one.get("pid") is None else one["pid"],
            restarts=int(one.get("restarts", 0)),
            silent_s=nan if one.get("silent_s") is None else float(one["silent_s"]),
            resident_mib=one["rss"] / 2**20 if "rss" in one else nan,
        )
        for one in status.get("processes", ())
    )


def alarms_of(
    processes: Sequence[ProcessSeen], before: Sequence[ProcessSeen], config: ProcessPatrolConfig
) -> tuple[str, ...]:
    """What is not well, compared with what was seen before.

    Args:
        processes: Those of now.
        before: Those of the look before; none at the first.
        config: What is not well.
    """
    earlier = {one.name: one for one in before}
    alarms = []
    for one in processes:
        was = earlier.get(one.name)
        if one.pid < 0:
            alarms.append(f"{one.name} does not run: {one.state}")
        if was is not None and one.restarts > was.restarts:
            alarms.append(f"{one.name} was started again, {one.restarts} times so far")
        if one.pid >= 0 and one.silent_s > config.silent_s:
            alarms.append(f"{one.name} gave no sign of life for {one.silent_s:.1f} s")
        if config.resident_mib is not None and one.resident_mib > config.resident_mib:
            alarms.append(f"{one.name} has {one.resident_mib:.0f} MiB, more than {config.resident_mib:.0f}")
    return tuple(alarms)


def node_of(pid: int) -> str | None:
    """The name of the node whose supervisor started this process; None: no supervisor that runs did."""
    for name in running_nodes():
        try:
            with ControlClient(RunFolder(name).control) as client:
                status = client.ask("ps")
        except WarploomError:
            continue
        if pid in [one.get("pid") for one in status.get("processes", ())]:
            return name
    return None


class ProcessPatrol(DataProcessComponent):
    """Commits what it sees in each period; an alarm is logged when it comes up, not as long as it stands."""

    Config = ProcessPatrolConfig

    report: Output[PatrolReport]

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._config = ProcessPatrolConfig()
        self._node: str | None = None
        self._client: ControlClient | None = None
        self._failure: str | None = "it has not looked yet"
        self._latest: PatrolReport | None = None

    def init(self, config: ProcessPatrolConfig) -> None:
        """Keeps what is not well."""
        self._config = config

    def process(self, trigger: Trigger) -> Status:
        """Asks, compares and commits."""
        try:
            status = self._ask()
        except WarploomError as error:
            self._close()
            self._failure = str(error)
            return Status.MISS
        if status is None:
            self._failure = "no supervisor started this process, so there are no others to watch"
            return Status.MISS
        self._failure = None
        before = self._latest
        processes = seen_in(status)
        alarms = alarms_of(processes, before.processes if before is not None else (), self._config)
        self._latest = PatrolReport(node=self._node or "", processes=processes, alarms=alarms)
        for alarm in alarms:
            if before is None or alarm not in before.alarms:
                _log.warning("%s: %s", self._node, alarm)
        with self.report.allocate_change() as change:
            change.set_version(trigger.version)
            change.value = self._latest
            return self.report.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)

    def _ask(self) -> dict[str, Any] | None:
        if self._node is None:
            self._node = node_of(os.getpid())
        if self._node is None:
            return None
        if self._client is None:
            self._client = connect(self._node)[1]
        return self._client.ask("ps")

    def _close(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            client.close()

    def stop(self) -> None:
        """Ends the connection too."""
        super().stop()
        self._close()

    @property
    def idle_because(self) -> str | None:
        """Nobody answers."""
        return self._failure

    def state(self) -> Mapping[str, str | float | int]:
        """How many processes there are, and the alarms."""
        latest = self._latest
        if latest is None:
            return {}
        return {"processes": len(latest.processes), "alarms": "; ".join(latest.alarms) or "none"}
