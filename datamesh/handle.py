"""Data handles: what a component declares, and all that it sees of the mesh.

    class HdmapManager(DataProcessComponent):
        lidar: Input[Cloud]
        hdmap: Output[HdmapStruct]

The declarations are the component's interface; the runtime binds each to the window of a topic.
"""

from __future__ import annotations

import operator
import threading
from collections.abc import Callable
from functools import partial
from types import TracebackType
from typing import Any, Generic, Protocol, TypeVar, get_args, get_origin, get_type_hints

import numpy as np

from .clock import Timer
from .payload import Arena, Completion
from .policy import CommitPolicy, EqualVersion, Reorder
from .snapshot import CURRENT_EPOCH, Entry, Snapshot
from .status import Outcome, Status
from .waiting import Waiting
from .window import Window

__all__ = ["Accessor", "Change", "Input", "Output", "Reads", "declared_handles"]

T = TypeVar("T")
P = TypeVar("P")
_NOTHING: Any = object()
_REJECTED = Status.REJECTED
_new_entry = partial(tuple.__new__, Entry)  # in half the time that the named tuple's own takes, which is in Python


class Accessor(Generic[T]):
    """A scoped pin on a window: one snapshot, so that reads repeat.

    with handle.access() as snapshot: …
    """

    __slots__ = ("_epoch", "_snapshot", "_stream", "_take", "_window")

    def __init__(
        self,
        window: Window[T],
        epoch: int = CURRENT_EPOCH,
        stream: Any = None,
        take: Callable[[int, Any], Snapshot[T]] | None = None,
    ) -> None:
        self._window = window
        self._epoch = epoch
        self._stream = stream
        self._take = take or window.snapshot
        self._snapshot: Snapshot[T] | None = None

    def __enter__(self) -> Snapshot[T]:
        self._snapshot = self._take(self._epoch, self._stream)
        return self._snapshot

    def __exit__(self, *_: object) -> None:
        if self._window.check and self._snapshot is not None:
            for index in range(len(self._snapshot)):
                self._window.verify(self._snapshot.entry(index))
        self._snapshot = None


class Change(Generic[T]):
    """One change of data: set its version, write its value, commit it once; otherwise nothing is published.

    Left as a context manager without a commit, or dropped, it is abandoned, and counted.
    """

    __slots__ = ("_arena", "_closed", "_completion", "_epoch", "_received_ns", "_value", "_version", "_window")

    def __init__(self, window: Window[T], epoch: int = CURRENT_EPOCH) -> None:
        self._window = window
        self._epoch = epoch
        self._version: int | None = None
        self._value: T = _NOTHING
        self._closed = False
        self._received_ns: int | None = None
        self._completion: Completion | None = None
        self._arena: Arena | None = None

    def set_version(self, version: int, received_ns: int | None = None, *, epoch: int | None = None) -> None:
        """Sets the version.

        Args:
            version: Time of reception of the frame [ns].
            received_ns: The clock's `monotonic_ns` when the sensor's data was received, if that was not just now.
            epoch: Of the version; by default that of the frame the component works on, or else the window's.

        Raises:
            TypeError: The version is not a whole number.
            ValueError: The version is negative or does not fit in 64 bits.
        """
        try:
            version = operator.index(version)
        except TypeError:
            raise TypeError(f"version must be a whole number of nanoseconds, not {version!r}") from None
        if not 0 <= version < 1 << 64:
            raise ValueError(f"version must be an unsigned 64-bit number of nanoseconds, not {version}")
        self._version = version
        self._received_ns = received_ns
        if epoch is not None:
            self._epoch = epoch

    @property
    def value(self) -> T:
        """What will be committed."""
        if self._value is _NOTHING:
            raise LookupError("the change has no value yet")
        return self._value

    @value.setter
    def value(self, value: T) -> None:
        if self._closed:
            raise RuntimeError(f"this change of {self._window.topic!r} was committed or abandoned; allocate another")
        self._value = value

    def array(self, shape: int | tuple[int, ...], dtype: Any = np.float32) -> np.ndarray:
        """An array for the value, not written yet, where its readers see it without a copy.

        That is shared memory where another process reads the topic, else the process's own. What is committed of it
        may be less: `points[:n]` of an array made for the most points there can be.

        Args:
            shape: Of the array.
            dtype: Of its elements.
        """
        if self._window.arena is None:
            return np.empty(shape, dtype)
        if self._arena is None:
            self._arena = self._window.arena()
        return self._arena.array(shape, dtype)

    def allocate(self, payload: type[P], *arguments: Any, **options: Any) -> P:
        """A payload for the value, not written yet, whose arrays are of `array`.

            cloud = change.allocate(PointCloud, capacity)

        Args:
            payload: Its type, with a class method `allocate(array, *arguments, **options)`, as `Allocatable` says.
            arguments: For that method.
            options: The same.

        Raises:
            TypeError: The type has no such method.
        """
        if not callable(getattr(payload, "allocate", None)):
            raise TypeError(f"{payload.__name__} has no class method allocate(array, …): make its arrays by `array`")
        return payload.allocate(self.array, *arguments, **options)  # type: ignore[attr-defined]

    def completes_with(self, completion: Completion) -> None:
        """Says that a device is still writing the value, and which event ends it; readers wait for that."""
        self._completion = completion

    def __enter__(self) -> Change[T]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if not self._closed:
            self._abandon()

    def __del__(self) -> None:
        if not self._closed:
            self._abandon()

    def _abandon(self) -> None:
        self._closed = True
        self._arena = None
        self._window.losses.count(self._window.topic, "abandoned", self._version or 0)


class _Handle(Generic[T]):
    """A declared connection to a topic; unbound until the runtime gives it its window."""

    def __init__(self, *, optional: bool = False) -> None:
        """Declares a handle.

        Args:
            optional: The component also works when the topic has no producer.
        """
        self.optional = optional
        self.name = ""
        self.payload: Any = object
        self.epoch = CURRENT_EPOCH
        """Of the frame that the component works on, which the runtime sets where that is one at a time."""
        self._window: Window[T] | None = None

    def bind(self, name: str, window: Window[T]) -> None:
        """Connects the handle to the window of its topic."""
        self.name = name
        self._window = window

    @property
    def is_bound(self) -> bool:
        """Whether it is connected to a topic."""
        return self._window is not None

    @property
    def window(self) -> Window[T]:
        """The window of the topic.

        Raises:
            RuntimeError: The handle is not bound.
        """
        if self._window is None:
            raise RuntimeError(f"{type(self).__name__} {self.name!r} is not bound to a topic: the runtime does that")
        return self._window

    @property
    def topic(self) -> str:
        """The name of the topic."""
        return self.window.topic


class Reads(Protocol):
    """What stands between an input and its window in a run that is recorded or replayed."""

    def snapshot(self, handle: Input, epoch: int, stream: Any) -> Snapshot:
        """Gives a snapshot that the component asks for."""
        ...

    def wait(self, handle: Input, version: int, epoch: int, wait: Callable[[], Waiting]) -> Waiting:
        """Ends a wait that the component's thread begins; `wait` does it at the window."""
        ...


class Input(_Handle[T]):
    """Reads a topic."""

    def __init__(self, *, optional: bool = False) -> None:
        super().__init__(optional=optional)
        self.reads: Reads | None = None
        """What its reads go through; None: they go to the window."""
        self._waits: set[Waiting[T]] | None = set()
        self._lock = threading.Lock()

    def access(self, epoch: int | None = None, stream: Any = None) -> Accessor[T]:
        """A scoped snapshot of the topic's window.

        Args:
            epoch: Whose data; by default that of the frame the component works on, or else the window's.
            stream: Where the values will be read; None is on the host. Values that a device is still writing are
                waited for accordingly.
        """
        take = None if self.reads is None else partial(self.reads.snapshot, self)
        return Accessor(self.window, self.epoch if epoch is None else epoch, stream, take)

    def wait(
        self, version: int, timeout_ns: int | None = None, *, tolerance_ns: int = 0, epoch: int | None = None
    ) -> Waiting[T]:
        """Waits, with its thread, until a version is there or cannot come: `outcome` and `entry` of what is given.

        Args:
            version: Which one [ns].
            timeout_ns: How long, by the mesh's clock [ns]; None is until the component stops.
            tolerance_ns: How far from it the version may be; the nearest of those there is taken [ns].
            epoch: Of the version; by default as for `access`.
        """
        epoch = self.epoch if epoch is None else epoch

        def wait() -> Waiting[T]:
            ended = threading.Event()
            due = None if timeout_ns is None else self.window.clock.monotonic_ns() + timeout_ns
            waiting = self.when(version, lambda _: ended.set(), due_ns=due, tolerance_ns=tolerance_ns, epoch=epoch)
            ended.wait()
            return waiting

        return wait() if self.reads is None else self.reads.wait(self, version, epoch, wait)

    def when(
        self,
        version: int,
        on_end: Callable[[Waiting[T]], None],
        *,
        due_ns: int | None = None,
        tolerance_ns: int = 0,
        epoch: int | None = None,
    ) -> Waiting[T]:
        """Waits without a thread: calls back once, in the thread that ends the wait, which may be this one.

        Args:
            version: Which one [ns].
            on_end: Takes the wait, with its outcome.
            due_ns: When it ends with TIMEOUT, in the clock's `monotonic_ns`; None is never.
            tolerance_ns: As for `wait`.
            epoch: As for `access`.
        """
        window = self.window
        timer: list[Timer] = []

        def end(waiting: Waiting[T]) -> None:
            window.forget(waiting)
            with self._lock:
                if self._waits is not None:
                    self._waits.discard(waiting)
            for one in timer:
                one.cancel()
            on_end(waiting)

        waiting = window.wait(version, end, self.epoch if epoch is None else epoch, tolerance_ns)
        if waiting.outcome is not None:
            return waiting
        with self._lock:
            stopping = self._waits is None
            if self._waits is not None and waiting.outcome is None:
                self._waits.add(waiting)
        if stopping:
            waiting.end(Outcome.SHUTDOWN)
        elif due_ns is not None and due_ns <= window.clock.monotonic_ns():
            waiting.end(Outcome.TIMEOUT)
        elif due_ns is not None:
            timer.append(window.clock.call_at(due_ns, lambda: waiting.end(Outcome.TIMEOUT) and None))
            if waiting.outcome is not None:  # it ended before there was a timer to cancel
                timer[0].cancel()
        return waiting

    def end_waits(self) -> None:
        """Ends all waits with SHUTDOWN, and those that begin from now on if they are not decided at once."""
        with self._lock:
            waits, self._waits = self._waits or set(), None
        for waiting in waits:
            waiting.end(Outcome.SHUTDOWN)

    def allow_waits(self) -> None:
        """Undoes `end_waits`."""
        with self._lock:
            if self._waits is None:
                self._waits = set()


class Output(_Handle[T]):
    """Writes a topic, of which it is the only producer."""

    def allocate_change(self) -> Change[T]:
        """A new change, to be written and committed."""
        window = self._window or self.window
        if window.on_begin is not None:
            window.on_begin()
        return Change(window, self.epoch)

    def commit(
        self,
        policy: CommitPolicy | Reorder,
        change: Change[T],
        *,
        equal: EqualVersion = EqualVersion.KEEP_FIRST,
        triggers: bool | None = None,
    ) -> Status:
        """Publishes a change; its value is read-only from here on.

        Args:
            policy: What to do where it is older than the newest.
            change: Of this output.
            equal: What to do where there is one of its version.
            triggers: Whether it starts runs; by default if it becomes the newest.

        Returns:
            OK, or why it was not kept, which is counted. After REJECTED the change is still open.

        Raises:
            RuntimeError: It was committed or abandoned already.
            TypeError: There is no such policy, or what is to be committed is no change.
            ValueError: It has no version or no value, or is another output's; or `equal` is ERROR, and there is one of
                its version.
        """
        try:
            window, version, value = change._window, change._version, change._value
        except AttributeError:
            raise TypeError(f"commit takes a policy and a change of `allocate_change`, not {change!r}") from None
        if window is not self._window:
            raise ValueError(f"the change is of {window.topic!r}: it cannot be committed to {self.topic!r}")
        if change._closed:
            raise RuntimeError(
                f"this change of {window.topic!r} was committed or abandoned already; a change is committed once"
            )
        if version is None:
            raise ValueError(f"the change of {window.topic!r} has no version: call set_version before the commit")
        if value is _NOTHING:
            raise ValueError(f"the change of {window.topic!r} has no value: set `.value` before the commit")
        change._closed = True
        change._arena = None
        now = window.clock.monotonic_ns()
        received = now if change._received_ns is None else change._received_ns
        epoch = window.state.epoch if change._epoch == CURRENT_EPOCH else change._epoch
        entry = _new_entry((version, value, received, now, epoch, True, change._completion, None))
        status = window.commit(policy, entry, equal, triggers)
        if status is _REJECTED:
            change._closed = False
        return status

    def settle(self, version: int, epoch: int | None = None) -> None:
        """Says that there will be nothing at `version`."""
        self.window.settle(version, self.epoch if epoch is None else epoch)

    def new_epoch(self) -> int:
        """Starts the topic over: versions may begin anew. Gives the epoch, which those who read it take over."""
        return self.window.new_epoch()

    def flush(self) -> None:
        """Publishes all that `Reorder` holds back."""
        self.window.flush()


def declared_handles(component: type) -> dict[str, Input | Output]:
    """The handles that a class declares, by name, as new unbound handles with their payload types.

    A declaration is an annotation `name: Input[Payload]`, with `= Input(optional=True)` where options are wanted.
    """
    handles: dict[str, Input | Output] = {}
    for name, hint in get_type_hints(component).items():
        kind = get_origin(hint) or hint
        if kind not in (Input, Output):
            continue
        options = getattr(component, name, None)
        handle = kind(optional=options.optional if isinstance(options, _Handle) else False)
        handle.name = name
        arguments = get_args(hint)
        handle.payload = arguments[0] if arguments else object
        handles[name] = handle
    return handles
