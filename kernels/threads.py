"""The threads of a CPU: the parts of a kernel's work, run at once.

Warp runs a kernel for a CPU on the calling thread, and lets go of Python's lock while it does. A kernel whose parts
write nothing that another part reads or writes can thus run on all cores: one launch per part. Warp's atomics for a
CPU are plain reads and writes, so parts must not share what they count in either.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from functools import partial
from queue import SimpleQueue
from typing import Any

import warp as wp

from .device import DEFAULT_DEVICE

__all__ = [
    "CREW",
    "PackedLaunch",
    "forks_taken_by",
    "launch_parts",
    "run_in_turn",
    "run_together",
    "set_thread_count",
    "thread_count",
]

CREW = "warploom-kernels-"
"""What the names of the threads begin with."""

_MOST = 8  # more gain little: memory is the limit by then


def _cores() -> int:
    """Cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _count_from_environment() -> int:
    text = os.environ.get("WARPLOOM_THREADS", "")
    if not text:
        return min(_cores(), _MOST)
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(f"WARPLOOM_THREADS must be a number of threads from 1, not {text!r}")
    return int(text)


class _Job:
    """A call that whoever comes first runs: a thread of the crew, or the one that waits for it."""

    def __init__(self, call: Callable[[], Any]):
        self._call = call
        self._unclaimed = threading.Lock()
        self._running = threading.Lock()
        self._running.acquire()
        self._error: BaseException | None = None

    def run_if_unclaimed(self) -> None:
        if not self._unclaimed.acquire(blocking=False):
            return
        try:
            self._call()
        except BaseException as error:  # handed on to the thread that waits
            self._error = error
        finally:
            self._running.release()

    def wait(self) -> None:
        self.run_if_unclaimed()
        self._running.acquire()
        if self._error is not None:
            raise self._error


class _Crew:
    """Threads that take jobs from one queue; they are started when first needed and end with the process."""

    def __init__(self):
        self._jobs: SimpleQueue[_Job] = SimpleQueue()
        self._threads = 0
        self._growing = threading.Lock()

    def take(self, jobs: Sequence[_Job]) -> None:
        if self._threads < len(jobs):
            with self._growing:
                for number in range(self._threads, len(jobs)):
                    threading.Thread(target=self._work, name=f"{CREW}{number}", daemon=True).start()
                    self._threads = number + 1
        for job in jobs:
            self._jobs.put(job)

    def _work(self) -> None:
        while True:
            self._jobs.get().run_if_unclaimed()


_crew = _Crew()
_thread_count = _count_from_environment()


def _forget_threads_of_parent() -> None:
    """A forked process has none of its parent's threads."""
    global _crew
    _crew = _Crew()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_threads_of_parent)


def thread_count() -> int:
    """How many threads a kernel may use on a CPU: `WARPLOOM_THREADS`, else the cores of this process, at most 8."""
    return _thread_count


def set_thread_count(count: int) -> None:
    """Sets how many threads a kernel may use on a CPU; the results do not depend on it.

    Plans take the number when they are made.

    Raises:
        ValueError: The number is below 1.
    """
    global _thread_count
    if count < 1:
        raise ValueError(f"count must be at least 1 thread, not {count}")
    _thread_count = int(count)


_take_fork: Callable[[Sequence[Callable[[], Any]]], None] | None = None


@contextmanager
def forks_taken_by(take: Callable[[Sequence[Callable[[], Any]]], None]) -> Iterator[None]:
    """While the CPU's launches are captured, gives the calls that would run at once to `take`, which calls them."""
    global _take_fork
    before, _take_fork = _take_fork, take
    try:
        yield
    finally:
        _take_fork = before


def run_together(calls: Sequence[Callable[[], Any]]) -> None:
    """Runs calls at once, the first on this thread, and returns when all have ended.

    While the CPU's launches are being captured, they run one after the other on this thread.
    """
    is_capturing = wp.get_device(DEFAULT_DEVICE).is_capturing
    if is_capturing and _take_fork is not None and len(calls) > 1:
        _take_fork(calls)
        return
    if len(calls) < 2 or is_capturing:
        for call in calls:
            call()
        return
    jobs = [_Job(call) for call in calls]
    _crew.take(jobs[1:])
    failed: BaseException | None = None
    for job in jobs:  # all, even after one has failed: they write to the caller's memory
        try:
            job.wait()
        except BaseException as error:
            failed = failed or error
    if failed is not None:
        raise failed


def run_in_turn(*series: Sequence[Callable[[], Any]]) -> None:
    """Runs the first calls of all series one after the other on one thread, at once the second ones on another thread.

    And so on. For launches in parts of which none reads what another part has written: they wake the threads once.
    """

    def run(calls: Sequence[Callable[[], Any]]) -> None:
        for call in calls:
            call()

    run_together([partial(run, calls) for calls in zip(*series, strict=True)])


class PackedLaunch:
    """A kernel's launch on the CPU, whose parameters are packed once but for some that change.

    To pack them takes longer than the launch. For one thread at a time, as a plan is.
    """

    def __init__(self, kernel: Any, parts: int | None, inputs: Sequence[Any], outputs: Sequence[Any] = ()):
        """Packs nothing yet.

        Args:
            kernel: A Warp kernel. With `parts` its first two parameters are the part, 0 … parts − 1, and `parts`.
            parts: How many times it is launched, all at once, each time with one thread, which does that part's
                whole work; None for a kernel without these two, which is launched once.
            inputs: The parameters that follow.
            outputs: Those that it writes.
        """
        self._kernel, self._parts = kernel, parts
        self._given = [*inputs, *outputs]
        self._own = 0 if parts is None else 2  # parameters before those given
        self._index: dict[str, int] = {}
        self._commands: list[Any] = []
        self._device = wp.get_device(DEFAULT_DEVICE)

    def launch(self, **changed: Any) -> None:
        """Launches it.

        Args:
            **changed: Parameters by name, in place of what was last given.
        """
        run_together(self.calls(**changed))

    def calls(self, **changed: Any) -> Sequence[Callable[[], Any]]:
        """A call for each part, which launches it; good until the parameters change again.

        Args:
            **changed: Parameters by name, in place of what was last given.
        """
        if changed and not self._index:
            self._index = {argument.label: index for index, argument in enumerate(self._kernel.adj.args)}
        places = {self._index[name]: value for name, value in changed.items()}
        if self._device.is_capturing or not self._commands:
            given = list(self._given)
            for index, value in places.items():
                given[index - self._own] = value
            if self._device.is_capturing:
                return [partial(self._launch, part, given) for part in range(self._parts or 1)]
            self._record(given)
        else:
            first, *others = self._commands
            for index, value in places.items():
                first.set_param_at_index(index, value)
                for other in others:  # the launch's bounds come before the parameters
                    other.params[index + 1] = first.params[index + 1]
        return [command.launch for command in self._commands]

    def _launch(self, part: int, given: list[Any], **how: Any) -> Any:
        own = [] if self._parts is None else [part, self._parts]
        return wp.launch(self._kernel, 1, inputs=[*own, *given], device=DEFAULT_DEVICE, **how)

    def _record(self, given: list[Any]) -> None:
        # A module that is not loaded yet is loaded once; the others differ by the part alone.
        first = self._launch(0, given, record_cmd=True)
        first.fwd_args = None  # what changes is not kept alive
        self._commands = [first]
        for part in range(1, self._parts or 1):
            command = copy(first)
            command.params = list(command.params)
            command.set_param_at_index(0, part)
            self._commands.append(command)


def launch_parts(kernel: Any, parts: int, inputs: Sequence[Any], outputs: Sequence[Any] = ()) -> None:
    """Launches a kernel for the CPU once per part, all at once.

    Args:
        kernel: A Warp kernel whose first two parameters are the part, 0 … parts − 1, and `parts`; it is launched with
            one thread for each part, and does that part's whole work.
        parts: How many.
        inputs: The parameters that follow.
        outputs: Those that it writes.
    """
    PackedLaunch(kernel, parts, inputs, outputs).launch()
