"""Entries, the state that a window is in, and the Snapshot that reads it."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Iterator
from enum import Enum
from typing import Any, Generic, NamedTuple, TypeVar

from .payload import Completion

__all__ = ["CURRENT_EPOCH", "Entry", "Miss", "Snapshot", "State"]

T = TypeVar("T")

_REMEMBERED = 256
"""How many evicted versions are known one by one."""
CURRENT_EPOCH = -1
"""In place of an epoch: the one that the window is in."""


class Miss(Enum):
    """Why a version is not in a snapshot."""

    EVICTED = "evicted"
    """It is older than the window's history reaches back."""
    FUTURE = "future"
    """It is newer than everything committed so far."""
    NEVER = "never"
    """It lies within the history, and nothing was committed at it."""
    SETTLED_EMPTY = "settled empty"
    """The producer said that there will be nothing."""


class Entry(NamedTuple, Generic[T]):
    """One committed datum."""

    version: int
    """Time of reception of the frame it belongs to [ns]."""
    value: T
    received_ns: int
    """The clock's `monotonic_ns` when the sensor's data that it derives from was received."""
    committed_ns: int
    """The clock's `monotonic_ns` of its own commit; of its release where it was held back."""
    epoch: int = CURRENT_EPOCH
    """Order is by epoch, then version."""
    triggers: bool = True
    """False where it was put into the history, and starts no run of those that it could trigger."""
    completion: Completion | None = None
    """When a device has written it; None is at once."""
    checksum: int | None = None
    """Of the payload at its commit, in a mesh that checks."""

    def read(self, stream: Any = None) -> T:
        """The value, once it is written: `stream` waits for that if the reader named one, else the calling thread."""
        completion = self.completion
        if completion is not None:
            if stream is None:
                completion.synchronize()
            elif stream is not completion.stream:
                completion.wait_on(stream)
        return self.value


class State(NamedTuple, Generic[T]):
    """What a window holds at one moment, in one epoch. What snapshots read of it never changes."""

    epoch: int
    versions: tuple[int, ...]
    """Ascending."""
    entries: tuple[Entry[T], ...]
    """One for each version."""
    evicted: int
    """The highest version that was evicted in this epoch; −1 when none was."""
    settled: dict[int, None]
    gone: deque[int]
    """The versions evicted last, one by one. Shared by the states of an epoch, and the window's alone."""
    previous: State[T] | None
    """The last state of the epoch before, for those still at work on it, until this epoch fills the window."""

    @classmethod
    def empty(cls, epoch: int, previous: State[T] | None = None) -> State[T]:
        """Nothing committed, evicted or settled."""
        return cls(epoch, (), (), -1, {}, deque(maxlen=_REMEMBERED), previous)

    def of_epoch(self, epoch: int) -> State[T]:
        """The state of an epoch; where it is not kept, an empty one in which everything is evicted, or to come."""
        if epoch in (self.epoch, CURRENT_EPOCH):
            return self
        if self.previous is not None and self.previous.epoch == epoch:
            return self.previous
        state: State[T] = State.empty(epoch)
        return state._replace(evicted=1 << 64) if epoch < self.epoch else state


class Snapshot(Generic[T]):
    """What a window held at one moment, in one epoch, oldest first; immutable.

    Values that a device is still writing are waited for: by this thread, or by the reader's stream if it named one.
    """

    __slots__ = ("_state", "_stream")

    def __init__(self, state: State[T], stream: Any = None) -> None:
        self._state = state
        self._stream = stream

    @property
    def state(self) -> State[T]:
        """The state of the window that it shows."""
        return self._state

    @property
    def epoch(self) -> int:
        """Rises when the clock steps, a recording loops or seeks, or the producer restarts."""
        return self._state.epoch

    @property
    def versions(self) -> tuple[int, ...]:
        """The versions held, ascending."""
        return self._state.versions

    def __len__(self) -> int:
        return len(self._state.entries)

    def __getitem__(self, index: int) -> T:
        """The datum at an index.

        Raises:
            IndexError: There is none; −1 is what the searches give on a miss, and never the newest.
        """
        return self.entry(index).read(self._stream)

    def __iter__(self) -> Iterator[T]:
        return (entry.read(self._stream) for entry in self._state.entries)

    def entry(self, index: int) -> Entry[T]:
        """The datum at an index, with its version and times; a device may still be writing it.

        Raises:
            IndexError: There is none.
        """
        if index < 0:
            raise IndexError(f"snapshot index {index}: the version looked for is not there; `last()` gives the newest")
        return self._state.entries[index]

    def version_index(self, version: int) -> int:
        """The index of exactly this version, or −1."""
        versions = self._state.versions
        index = bisect_left(versions, version)
        return index if index < len(versions) and versions[index] == version else -1

    def miss(self, version: int) -> Miss | None:
        """Why `version` is not here; None when it is."""
        state = self._state
        if self.version_index(version) >= 0:
            return None
        if version in state.settled:
            return Miss.SETTLED_EMPTY
        if state.versions and version > state.versions[-1]:
            return Miss.FUTURE  # also where higher ones were evicted, before versions were overwritten
        if version <= state.evicted:
            return Miss.EVICTED
        return Miss.NEVER if state.versions else Miss.FUTURE

    def last(self) -> T:
        """The newest datum, which need not be that of the trigger: read frame data by its version.

        Raises:
            LookupError: The window is empty.
        """
        if not self._state.entries:
            raise LookupError("the window is empty: nothing was committed yet")
        return self._state.entries[-1].read(self._stream)

    def before(self, version: int) -> int:
        """The index of the newest version < `version`, or −1."""
        return bisect_left(self._state.versions, version) - 1

    def until(self, version: int) -> int:
        """The index of the newest version ≤ `version`, or −1."""
        return bisect_right(self._state.versions, version) - 1

    def after(self, version: int) -> int:
        """The index of the oldest version > `version`, or −1."""
        index = bisect_right(self._state.versions, version)
        return index if index < len(self._state.versions) else -1

    def nearest(self, version: int, max_age: int) -> int:
        """The index of the version nearest to `version` and at most `max_age` [ns] from it, the older of two; or −1."""
        before, after = self.until(version), self.after(version)
        near = [index for index in (before, after) if index >= 0]
        index = min(near, key=lambda i: abs(self._state.versions[i] - version), default=-1)
        return index if index >= 0 and abs(self._state.versions[index] - version) <= max_age else -1
