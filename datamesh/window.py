"""The Window, the carrier of data inside the mesh, and the Snapshot, which reads it.

A window is a bounded history, sorted by version, each version at most once. Its state is one immutable object that a
commit replaces, so a snapshot is one reference: taken in constant time, and unaffected by what is committed later.
"""

from __future__ import annotations

import threading
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import Generic, TypeVar

from .counters import LossCounters
from .payload import freeze
from .status import Status

__all__ = ["CommitPolicy", "Entry", "Miss", "Snapshot", "Window"]

T = TypeVar("T")

_REMEMBERED = 256
"""How many settled and how many evicted versions a window knows one by one."""


class CommitPolicy(IntEnum):
    """What a commit does when its version is older than the newest in the window."""

    DISCARD_OUT_OF_ORDER = 0
    """Drops it, counted: the usual one."""
    INSERT_SORTED = 1
    """Puts it in its place in the history; it triggers nobody."""


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


@dataclass(frozen=True, slots=True)
class Entry(Generic[T]):
    """One committed datum."""

    version: int
    """Time of reception of the frame it belongs to [ns]."""
    value: T
    received_ns: int
    """`time.perf_counter_ns` when the sensor's data that it derives from was received."""
    committed_ns: int
    """`time.perf_counter_ns` of its own commit."""


@dataclass(frozen=True, slots=True)
class _State(Generic[T]):
    epoch: int = 0
    versions: tuple[int, ...] = ()
    entries: tuple[Entry[T], ...] = ()
    evicted: int = -1
    """The highest version that was evicted in this epoch; −1 when none was."""
    settled: dict[int, None] = field(default_factory=dict)


class Snapshot(Generic[T]):
    """What a window held at one moment, oldest first; immutable."""

    __slots__ = ("_state",)

    def __init__(self, state: _State[T]) -> None:
        self._state = state

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
        return self.entry(index).value

    def __iter__(self) -> Iterator[T]:
        return (entry.value for entry in self._state.entries)

    def entry(self, index: int) -> Entry[T]:
        """The datum at an index, with its version and times.

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
        if version <= state.evicted:
            return Miss.EVICTED
        if not state.versions or version > state.versions[-1]:
            return Miss.FUTURE
        return Miss.NEVER

    def last(self) -> T:
        """The newest datum, which need not be that of the trigger: read frame data by its version.

        Raises:
            LookupError: The window is empty.
        """
        if not self._state.entries:
            raise LookupError("the window is empty: nothing was committed yet")
        return self._state.entries[-1].value

    def before(self, version: int) -> int:
        """The index of the newest version < `version`, or −1."""
        return bisect_left(self._state.versions, version) - 1

    def after(self, version: int) -> int:
        """The index of the oldest version > `version`, or −1."""
        index = bisect_right(self._state.versions, version)
        return index if index < len(self._state.versions) else -1

    def nearest(self, version: int, max_age: int) -> int:
        """The index of the version nearest to `version` and at most `max_age` [ns] from it, the older of two; or −1."""
        before, after = bisect_right(self._state.versions, version) - 1, self.after(version)
        near = [index for index in (before, after) if index >= 0]
        index = min(near, key=lambda i: abs(self._state.versions[i] - version), default=-1)
        return index if index >= 0 and abs(self._state.versions[index] - version) <= max_age else -1


class Window(Generic[T]):
    """A bounded history of one topic. Many threads may read and commit."""

    def __init__(self, topic: str, capacity: int = 8, losses: LossCounters | None = None) -> None:
        """Makes an empty window.

        Args:
            topic: Its name, for messages and counters.
            capacity: How many versions it keeps, ≥ 1; a further one evicts the lowest.
            losses: Where discarded data are counted.

        Raises:
            ValueError: `capacity` is below 1.
        """
        if capacity < 1:
            raise ValueError(f"capacity of window {topic!r} must be >= 1, not {capacity}")
        self.topic = topic
        self.capacity = capacity
        self.losses = losses if losses is not None else LossCounters()
        self._state: _State[T] = _State()
        self._evicted: dict[int, None] = {}
        self._lock = threading.Lock()
        # Held from a commit to the end of its callbacks: subscribers see the commits in their order.
        self._commit_lock = threading.RLock()
        self._on_commit: list[Callable[[Entry[T]], None]] = []
        self._on_settle: list[Callable[[int], None]] = []

    def snapshot(self) -> Snapshot[T]:
        """What the window holds now."""
        return Snapshot(self._state)

    def subscribe(self, on_commit: Callable[[Entry[T]], None], on_settle: Callable[[int], None]) -> None:
        """Calls back after each commit that triggers, and after each settle, in the committing thread."""
        with self._lock:
            self._on_commit.append(on_commit)
            self._on_settle.append(on_settle)

    def commit(self, policy: CommitPolicy, entry: Entry[T]) -> Status:
        """Adds a datum, read-only from here on, and tells the subscribers.

        An equal version is kept as it is, and the new one discarded.

        Returns:
            OK, OUT_OF_ORDER or DUPLICATE; the latter two are counted.
        """
        with self._commit_lock:
            with self._lock:
                state = self._state
                index = bisect_left(state.versions, entry.version)
                newest = index == len(state.versions)
                evicts_itself = index == 0 and len(state.versions) == self.capacity
                if not newest and state.versions[index] == entry.version:
                    status = Status.DUPLICATE
                elif not newest and (policy is CommitPolicy.DISCARD_OUT_OF_ORDER or evicts_itself):
                    status = Status.OUT_OF_ORDER
                else:
                    status = Status.OK
                    freeze(entry.value)
                    self._insert(state, index, entry)
            if status:
                self.losses.count(self.topic, status.name.lower(), entry.version)
            elif newest:
                for on_commit in self._on_commit:
                    on_commit(entry)
            return status

    def _insert(self, state: _State[T], index: int, entry: Entry[T]) -> None:
        versions = (*state.versions[:index], entry.version, *state.versions[index:])
        entries = (*state.entries[:index], entry, *state.entries[index:])
        evicted = state.evicted
        if len(versions) > self.capacity:
            evicted = versions[0]
            versions, entries = versions[1:], entries[1:]
            _remember(self._evicted, evicted)
        settled = state.settled
        if entry.version in settled:
            settled = {version: None for version in settled if version != entry.version}
        self._state = _State(state.epoch, versions, entries, evicted, settled)

    def settle(self, version: int) -> None:
        """Says that there will be nothing at `version` and tells the subscribers, unless there is or was something."""
        with self._lock:
            state = self._state
            if version in state.settled or version in state.versions or version in self._evicted:
                return
            settled = dict(state.settled)
            _remember(settled, version)
            self._state = _State(state.epoch, state.versions, state.entries, state.evicted, settled)
        for on_settle in self._on_settle:
            on_settle(version)

    def new_epoch(self) -> int:
        """Starts over, empty, in the next epoch: versions may begin anew. Gives the epoch."""
        with self._lock:
            self._evicted.clear()
            self._state = _State(epoch=self._state.epoch + 1)
            return self._state.epoch


def _remember(versions: dict[int, None], version: int) -> None:
    """Adds a version to a bounded memory of versions, which forgets its oldest."""
    versions[version] = None
    if len(versions) > _REMEMBERED:
        del versions[next(iter(versions))]
