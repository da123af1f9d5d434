"""What a call launches on the CPU, recorded once and replayed without Python's work for each launch.

Warp records for a single thread. Where a call forks, into parts of a kernel's work or into calls of their own, each
branch is recorded as a graph of its own, and the branches are replayed on the threads of the CPU.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import warp as wp

from .device import DEFAULT_DEVICE
from .threads import CREW, forks_taken_by, run_together

__all__ = ["CpuGraph", "is_alone"]

# Warp records what any thread launches on the CPU, and into one graph at a time.
_recording = threading.Lock()


def is_alone() -> bool:
    """Whether no other thread of this process could launch a kernel now: there is none but those that run parts."""
    others = (thread for thread in threading.enumerate() if thread is not threading.current_thread())
    return all(thread.name.startswith(CREW) for thread in others)


class CpuGraph:
    """A recorded call; its kernels must have been launched before, so that they are compiled and loaded.

    While it is recorded, no other thread may launch kernels on the CPU: they would be recorded too, not run.
    """

    def __init__(self, call: Callable[[], Any]):
        with _recording:
            self._steps = _recorded(call)

    def launch(self) -> None:
        """Runs what was recorded, on what the arrays hold now."""
        _replay(self._steps)


def _recorded(call: Callable[[], Any]) -> list:
    """Graphs, to be replayed one after the other; and in their midst lists of such lists, whose members fork."""
    steps: list = []

    def fork(calls: Sequence[Callable[[], Any]]) -> None:
        steps.append(wp.capture_end(DEFAULT_DEVICE))
        try:
            steps.append([_recorded(branch) for branch in calls])
        finally:
            wp.capture_begin(DEFAULT_DEVICE)

    with forks_taken_by(fork):
        wp.capture_begin(DEFAULT_DEVICE)
        try:
            call()
        finally:
            steps.append(wp.capture_end(DEFAULT_DEVICE))
    return steps


def _replay(steps: list) -> None:
    for step in steps:
        if isinstance(step, list):
            run_together([partial(_replay, branch) for branch in step])
        else:
            wp.capture_launch(step)
