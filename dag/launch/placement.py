"""Where a process runs: its CPUs and its priority."""

from __future__ import annotations

import os

from .schema import ProcessSpec

__all__ = ["place"]


def place(pid: int, spec: ProcessSpec) -> list[str]:
    """Gives a process that was just started its CPUs and its priority; the threads that it makes later inherit them.

    Args:
        pid: The process.
        spec: What the launch file says.

    Returns:
        What was not permitted, to be told: the process runs all the same.
    """
    warnings = []
    try:
        if spec.cpus:
            os.sched_setaffinity(pid, spec.cpus)
    except ProcessLookupError:  # it has ended already, which is told elsewhere
        return []
    except OSError as error:
        there = sorted(os.sched_getaffinity(0))
        warnings.append(f"cpus {spec.cpus}: {error.strerror}; it runs on {there}")
    try:
        if spec.nice:
            os.setpriority(os.PRIO_PROCESS, pid, spec.nice)
    except ProcessLookupError:
        return []
    except OSError as error:
        warnings.append(
            f"nice {spec.nice}: {error.strerror}; it stays at {os.getpriority(os.PRIO_PROCESS, 0)}. "
            "A priority above the usual one needs CAP_SYS_NICE"
        )
    return warnings
