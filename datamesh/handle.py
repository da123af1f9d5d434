"""Data handles: what a component declares, and all that it sees of the mesh.

    class HdmapManager(DataProcessComponent):
        lidar: Input[Cloud]
        hdmap: Output[HdmapStruct]

The declarations are the component's interface; the runtime binds each to the window of a topic.
"""

from __future__ import annotations

import operator
import time
from types import TracebackType
from typing import Any, Generic, TypeVar, get_args, get_origin, get_type_hints

from .status import Status
from .window import CommitPolicy, Entry, Snapshot, Window

__all__ = ["Accessor", "Change", "Input", "Output", "declared_handles"]

T = TypeVar("T")


class Accessor(Generic[T]):
    """A scoped pin on a window: one snapshot, so that reads repeat.

    with handle.access() as snapshot: …
    """

    def __init__(self, window: Window[T]) -> None:
        self._window = window
        self._snapshot: Snapshot[T] | None = None

    def __enter__(self) -> Snapshot[T]:
        self._snapshot = self._window.snapshot()
        return self._snapshot

    def __exit__(self, *_: object) -> None:
        self._snapshot = None


class Change(Generic[T]):
    """One change of data: set its version, write its value, commit it once; otherwise nothing is published.

    As a context manager it is abandoned, and counted, when it is left without a commit.
    """

    def __init__(self, window: Window[T]) -> None:
        self._window = window
        self._version: int | None = None
        self._value: T | None = None
        self._has_value = False
        self._closed = False
        self._received_ns: int | None = None

    def set_version(self, version: int, received_ns: int | None = None) -> None:
        """Sets the version [ns], and when the sensor's data was received, if that was not just now.

        Raises:
            TypeError: The version is not a whole number.
            ValueError: The version is negative or does not fit in 64 bits.
        """
        version = operator.index(version)
        if not 0 <= version < 1 << 64:
            raise ValueError(f"version must be an unsigned 64-bit number of nanoseconds, not {version}")
        self._version = version
        self._received_ns = received_ns

    @property
    def value(self) -> T:
        """What will be committed."""
        if not self._has_value:
            raise LookupError("the change has no value yet")
        return self._value  # type: ignore[return-value]

    @value.setter
    def value(self, value: T) -> None:
        if self._closed:
            raise RuntimeError(f"this change of {self._window.topic!r} was committed or abandoned; allocate another")
        self._value = value
        self._has_value = True

    def __enter__(self) -> Change[T]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if not self._closed:
            self._closed = True
            self._window.losses.count(self._window.topic, "abandoned", self._version or 0)

    def _commit(self, policy: CommitPolicy) -> Status:
        topic = self._window.topic
        if self._closed:
            raise RuntimeError(
                f"this change of {topic!r} was committed or abandoned already; a change is committed once"
            )
        if self._version is None:
            raise ValueError(f"the change of {topic!r} has no version: call set_version before the commit")
        if not self._has_value:
            raise ValueError(f"the change of {topic!r} has no value: set `.value` before the commit")
        self._closed = True
        now = time.perf_counter_ns()
        received = self._received_ns if self._received_ns is not None else now
        return self._window.commit(policy, Entry(self._version, self._value, received, now))


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
        self._window: Window[T] | None = None

    def bind(self, name: str, window: Window[T]) -> None:
        """Connects the handle to the window of its topic."""
        self.name = name
        self._window = window

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


class Input(_Handle[T]):
    """Reads a topic."""

    def access(self) -> Accessor[T]:
        """A scoped snapshot of the topic's window."""
        return Accessor(self.window)


class Output(_Handle[T]):
    """Writes a topic, of which it is the only producer."""

    def allocate_change(self) -> Change[T]:
        """A new change, to be written and committed."""
        return Change(self.window)

    def commit(self, policy: CommitPolicy, change: Change[T]) -> Status:
        """Publishes a change; its value is read-only from here on.

        Raises:
            RuntimeError: It was committed or abandoned already.
            ValueError: It has no version or no value.
        """
        return change._commit(policy)

    def settle(self, version: int) -> None:
        """Says that there will be nothing at `version`."""
        self.window.settle(version)


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
