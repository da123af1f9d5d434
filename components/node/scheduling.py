"""The scheduling of a process: which cores it may run on, how nice it is, and which of its threads come first."""

from __future__ import annotations

import fnmatch
import logging
import os
import threading
from collections.abc import Mapping
from typing import Any

from pydantic import Field, field_validator

from ...dag import DataProcessComponent, ProcessorConfig, Trigger
from ...datamesh import Status
from ...kernels.threads import thread_count

__all__ = ["ProcessScheduling", "SchedulingConfig"]

_log = logging.getLogger(__name__)


class SchedulingConfig(ProcessorConfig):
    """What is set, once the process has started."""

    cpus: tuple[int, ...] = ()
    """Cores that the process may run on, of those that the launcher left it; none: all of them."""
    nice: int | None = Field(None, ge=-20, le=19)
    """Of the process; null leaves it as it is. Below what it is needs a permission."""
    threads: dict[str, int] = Field(default_factory=dict)
    """Niceness by the name of a thread, `*` and `?` stand for others: `perception-*: -5`; the first one counts."""

    @field_validator("cpus")
    @classmethod
    def _are_cores(cls, cpus: tuple[int, ...]) -> tuple[int, ...]:
        for cpu in cpus:
            if cpu < 0:
                raise ValueError(f"a core has a number from 0, not {cpu}")
        return cpus

    @field_validator("threads")
    @classmethod
    def _are_nice(cls, threads: dict[str, int]) -> dict[str, int]:
        for name, nice in threads.items():
            if not -20 <= nice <= 19:
                raise ValueError(f"{name}: niceness is from -20 to 19, not {nice}")
        return threads


class ProcessScheduling(DataProcessComponent):
    """Sets them at its start, and of threads that come later in each period.

    What the system does not permit is logged once and shown; the process goes on without it.
    """

    Config = SchedulingConfig

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._config = SchedulingConfig()
        self._set: dict[int, str] = {}
        self._refused: dict[str, str] = {}

    def init(self, config: SchedulingConfig) -> None:
        """Keeps what is to be set."""
        self._config = config

    def start(self) -> None:
        """Sets what is of the process, and of the threads there are."""
        config = self._config
        if config.cpus:
            self._try(f"cpus {','.join(map(str, config.cpus))}", self._pin)
        if config.nice is not None:
            self._try(f"nice {config.nice}", lambda: os.setpriority(os.PRIO_PROCESS, 0, config.nice or 0))
        super().start()

    def _pin(self) -> None:
        if not hasattr(os, "sched_setaffinity"):
            raise OSError("this system does not pin processes")
        # Each thread has its own set of cores; those that start later inherit that of their parent.
        for thread in [t.native_id for t in threading.enumerate() if t.native_id is not None]:
            os.sched_setaffinity(thread, self._config.cpus)

    def _try(self, what: str, call: Any) -> None:
        try:
            call()
        except OSError as error:
            if what not in self._refused:
                _log.warning("%s: %s is not permitted here: %s", self.name, what, error.strerror or error)
            self._refused[what] = error.strerror or str(error)

    def process(self, trigger: Trigger) -> Status:
        """Sets the niceness of threads that are new."""
        alive: dict[int, str] = {}
        for thread in threading.enumerate():
            if thread.native_id is None:
                continue
            alive[thread.native_id] = thread.name
            if self._set.get(thread.native_id) == thread.name:
                continue
            nice = next((n for name, n in self._config.threads.items() if fnmatch.fnmatch(thread.name, name)), None)
            if nice is not None:
                number = thread.native_id
                self._try(
                    f"{thread.name} nice {nice}",
                    lambda number=number, nice=nice: os.setpriority(os.PRIO_PROCESS, number, nice),
                )
        self._set = alive
        return Status.OK

    @property
    def idle_because(self) -> str | None:
        """Nothing is to be set."""
        config = self._config
        if config.cpus or config.nice is not None or config.threads:
            return None
        return f"neither cpus nor nice nor threads are given to {self.name}"

    def state(self) -> Mapping[str, str | float | int]:
        """What is in force, and what was refused."""
        cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)
        return {
            "cores": ",".join(map(str, cores)),
            "nice": os.getpriority(os.PRIO_PROCESS, 0) if hasattr(os, "getpriority") else 0,
            "threads": threading.active_count(),
            "kernel threads": thread_count(),
            "refused": ", ".join(self._refused) or "nothing",
        }
