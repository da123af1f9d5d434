"""The run-time variables of a process: what it uses of the machine, second by second."""

from __future__ import annotations

import gc
import os
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ...dag import DataProcessComponent, Trigger
from ...datamesh import CommitPolicy, Output, Status
from ...datamesh.messages import message

__all__ = ["VariableReporter", "Variables"]


@message("warploom.Variables")
@dataclass(frozen=True, kw_only=True)
class Variables:
    """What a process uses at one time."""

    pid: int
    uptime_s: float
    """Since the process was started [s]."""
    cpu_percent: float
    """Of one core, since the report before [%]."""
    resident_mib: float
    """Memory that is in RAM [MiB]."""
    peak_mib: float
    """The most that it ever was [MiB]."""
    threads: int
    descriptors: int
    """Open files, sockets and pipes; −1 where the system does not say."""
    switches: int
    """Times that a thread was taken off a core against its will, since the start."""
    page_faults: int
    """Pages that had to be read from disk, since the start."""
    collections: int
    """Runs of Python's garbage collector over all objects, since the start."""


class VariableReporter(DataProcessComponent):
    """Commits them once in a period."""

    variables: Output[Variables]

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._process: Any = None
        self._latest: Variables | None = None

    def _read(self) -> Variables:
        import psutil

        if self._process is None or self._process.pid != os.getpid():
            self._process = psutil.Process()
            self._process.cpu_percent()  # the first call only remembers the times
        process = self._process
        with process.oneshot():
            memory = process.memory_info()
            return Variables(
                pid=process.pid,
                uptime_s=round(self.clock.now_ns() / 1e9 - process.create_time(), 3),
                cpu_percent=process.cpu_percent(),
                resident_mib=round(memory.rss / 2**20, 1),
                peak_mib=round(_peak_bytes() / 2**20, 1),
                threads=threading.active_count(),
                descriptors=process.num_fds() if hasattr(process, "num_fds") else -1,
                switches=process.num_ctx_switches().involuntary,
                page_faults=_major_faults(),
                collections=gc.get_stats()[-1]["collections"],
            )

    def process(self, trigger: Trigger) -> Status:
        """Reads and commits them."""
        self._latest = self._read()
        with self.variables.allocate_change() as change:
            change.set_version(trigger.version)
            change.value = self._latest
            return self.variables.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)

    def state(self) -> Mapping[str, str | float | int]:
        """The latest ones."""
        latest = self._latest
        if latest is None:
            return {}
        names = ("cpu_percent", "resident_mib", "peak_mib", "threads", "descriptors", "switches")
        return {name: getattr(latest, name) for name in names}


def _peak_bytes() -> int:
    try:
        import resource
    except ImportError:  # Windows
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _major_faults() -> int:
    try:
        import resource
    except ImportError:  # Windows
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_majflt
