"""The Window, the carrier of data inside the mesh.

A window is a bounded history, sorted by version, each version at most once. Its state is one immutable object that a
commit replaces, so a snapshot is one reference: taken in constant time, and unaffected by what is committed later.
"""

from __future__ import annotations

import logging
import threading
from bisect import bisect_left, insort
from collections.abc import Callable
from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar

from .clock import Clock, SystemClock
from .counters import LossCounters
from .payload import Arena, checksum, freeze
from .policy import CommitPolicy, EqualVersion, Reorder
from .snapshot import CURRENT_EPOCH, Entry, Snapshot, State
from .status import Status
from .waiting import Waiting

__all__ = ["OnCommit", "OnSettle", "Window"]

T = TypeVar("T")
OnCommit = Callable[[Entry[T]], None]
OnSettle = Callable[[int, int], None]

_log = logging.getLogger(__name__)

_OK = Status.OK  # a member of an enum takes longer to look up than to compare
_new_state = partial(tuple.__new__, State)  # what a named tuple calls is written in Python, and takes twice as long

_REMEMBERED = 256
"""How many settled versions a window knows one by one."""


class _Held(NamedTuple):
    """A datum that `Reorder` holds back."""

    order: tuple[int, int]
    due_ns: int
    entry: Entry
    equal: EqualVersion
    triggers: bool | None


class Window(Generic[T]):
    """A bounded history of one topic. Many threads may read and commit."""

    def __init__(
        self,
        topic: str,
        capacity: int = 8,
        losses: LossCounters | None = None,
        *,
        clock: Clock | None = None,
        check: bool = False,
    ) -> None:
        """Makes an empty window.

        Args:
            topic: Its name, for messages and counters.
            capacity: How many versions it keeps, ≥ 1; a further one evicts the lowest.
            losses: Where discarded data are counted.
            clock: By which data are stamped, held back and waited for.
            check: Payloads are compared with what they were at their commit, when they are released and evicted.

        Raises:
            ValueError: `capacity` is below 1.
        """
        if capacity < 1:
            raise ValueError(f"capacity of window {topic!r} must be >= 1, not {capacity}")
        self.topic = topic
        self.capacity = capacity
        self.losses = losses if losses is not None else LossCounters()
        self.clock = clock if clock is not None else SystemClock()
        self.check = check
        self.arena: Callable[[], Arena] | None = None
        """Gives the memory in which a payload is built that other processes read; None: this process's own."""
        self.on_begin: Callable[[], None] | None = None
        """Is told that a change is begun, for who has to get ready for its commit."""
        self.state: State[T] = State.empty(0)
        """What it holds: immutable, and replaced by each commit."""
        self._lock = threading.Lock()
        # Held from a commit to the end of its callbacks: subscribers see the commits in their order.
        self._commit_lock = threading.RLock()
        self._on_commit: tuple[OnCommit, ...] = ()
        self._on_settle: tuple[OnSettle, ...] = ()
        self._after: tuple[Callable[[], None], ...] = ()
        self._puts_off = False
        self._waits: list[Waiting[T]] = []
        self._held: list[_Held] = []
        self._modified: set[tuple[int, int]] = set()

    @property
    def epoch(self) -> int:
        """The epoch it is in."""
        return self.state.epoch

    def snapshot(self, epoch: int = CURRENT_EPOCH, stream: Any = None) -> Snapshot[T]:
        """What the window holds now.

        Args:
            epoch: Whose data; those of the epoch before are there until the current one has filled the window.
            stream: Where the values will be read, so that it waits for those that a device is still writing. None:
                on the host, so the calling thread waits.
        """
        state = self.state
        return Snapshot(state if epoch == state.epoch else state.of_epoch(epoch), stream)

    def find(self, version: int, epoch: int = CURRENT_EPOCH) -> Entry[T] | None:
        """The datum of exactly a version, if it is there now; a device may still be writing it."""
        state = self.state
        if epoch != state.epoch:
            state = state.of_epoch(epoch)
        if state.versions and state.versions[-1] == version:
            return state.entries[-1]
        index = bisect_left(state.versions, version)
        return state.entries[index] if index < len(state.versions) and state.versions[index] == version else None

    def subscribe(
        self, on_commit: OnCommit, on_settle: OnSettle, after: Callable[[], None] | None = None
    ) -> Callable[[], None]:
        """Calls back after each commit that was kept, and after each settle, in the thread that made it.

        Args:
            on_commit: Takes the entry; `triggers` in it is false for one put into the history. All subscribers are told
                of a commit before the next one to this window, so it must be short.
            on_settle: Takes the version and its epoch.
            after: Is called when that is through, and others can commit: it may take its time, which is the producer's.

        Returns:
            Ends the subscription.
        """
        with self._lock:
            self._on_commit = (*self._on_commit, on_commit)
            self._on_settle = (*self._on_settle, on_settle)
            if after is not None:
                self._after = (*self._after, after)

        def unsubscribe() -> None:
            with self._lock:
                self._on_commit = tuple(one for one in self._on_commit if one is not on_commit)
                self._on_settle = tuple(one for one in self._on_settle if one is not on_settle)
                self._after = tuple(one for one in self._after if one is not after)

        return unsubscribe

    def commit(
        self,
        policy: CommitPolicy | Reorder,
        entry: Entry[T],
        equal: EqualVersion = EqualVersion.KEEP_FIRST,
        triggers: bool | None = None,
    ) -> Status:
        """Adds a datum, read-only from here on, and tells the subscribers.

        Args:
            policy: What to do where it is older than the newest. An epoch older than the window's is out of order under
                every policy but FORCE_NEW_EPOCH, with which the topic has epochs of its own; a newer one takes the
                window into it.
            entry: The datum.
            equal: What to do where there is one of its version.
            triggers: Whether it starts runs; by default if it becomes the newest.

        Returns:
            OK (also for what is held back to be put in order), OUT_OF_ORDER, DUPLICATE or REJECTED, which are counted.

        Raises:
            TypeError: `policy` or `equal` is none.
            ValueError: There is one of its version, and `equal` is ERROR.
        """
        with self._commit_lock:
            if isinstance(policy, CommitPolicy):
                status = self._publish(policy, entry, equal, triggers)
            elif isinstance(policy, Reorder):
                status = self._hold(policy, entry, equal, triggers)
            else:
                raise TypeError(f"policy must be a CommitPolicy or a Reorder, not {policy!r}")
        if not self._puts_off:
            for after in self._after:
                after()
        return status

    def put_off(self, more: bool) -> None:
        """Says whether more commits follow at once: what is called after a commit then waits for the last of them.

        For the thread that makes all commits of the window, such as one that receives them: a component that runs in
        it is so given the newest of those that wait, and not one after the other.
        """
        before, self._puts_off = self._puts_off, more
        if before and not more:
            for after in self._after:
                after()

    def _publish(
        self, policy: CommitPolicy, entry: Entry[T], equal: EqualVersion, triggers: bool | None = None
    ) -> Status:
        """Commits at once. Called with the commit lock held."""
        lost: tuple[tuple[str, int], ...] = ()
        status, oldest = _OK, None
        with self._lock:
            epoch, versions, entries, evicted, settled, gone, previous = state = self.state
            version = entry[0]
            if (
                (not versions or version > versions[-1])
                and entry[4] == epoch
                and triggers is None
                and version not in settled
                and not self.check
            ):  # the usual case, without a call
                freeze(entry[1])
                if len(versions) >= self.capacity:
                    first, previous = versions[0], None
                    gone.append(first)
                    if first > evicted:  # it is lower where versions were overwritten
                        evicted = first
                    versions, entries = versions[1:], entries[1:]
                versions, entries = versions + (version,), entries + (entry,)  # noqa: RUF005  in half the time
                self.state = _new_state((epoch, versions, entries, evicted, settled, gone, previous))
            else:
                status, state, index, entry, lost = self._place(state, policy, entry, equal, triggers)
                if status is _OK:
                    if self.check and len(state.entries) == self.capacity:
                        oldest = state.entries[0]
                    entry = self._insert(state, index, entry)
        # Who watches losses may read the window, or write to it: no lock of it is held.
        if oldest is not None:
            self.verify(oldest)
        for reason, version in lost:
            self.losses.count(self.topic, reason, version)
        if status is not _OK:
            self.losses.count(self.topic, status.name.lower(), entry.version)
            if status is Status.DUPLICATE and equal is EqualVersion.ERROR:
                raise ValueError(f"version {entry.version} is in {self.topic!r} already, and equal versions are errors")
            return status
        for on_commit in self._on_commit:
            try:
                on_commit(entry)
            except Exception:  # the others are to be told all the same
                _log.exception("a subscriber of %s failed at version %d", self.topic, entry.version)
        if self._waits:
            self._end_waits()
        return status

    def _place(
        self, state: State[T], policy: CommitPolicy, entry: Entry[T], equal: EqualVersion, triggers: bool | None
    ) -> tuple[Status, State[T], int, Entry[T], tuple[tuple[str, int], ...]]:
        """Where a datum goes: status, the state to put it in, index, entry, losses."""
        if entry.epoch == CURRENT_EPOCH or (policy is CommitPolicy.FORCE_NEW_EPOCH and entry.epoch < state.epoch):
            entry = entry._replace(epoch=state.epoch)
        refused = Status.REJECTED if policy is CommitPolicy.REJECT else Status.OUT_OF_ORDER
        if entry.epoch < state.epoch:
            return refused, state, -1, entry, ()
        if entry.epoch > state.epoch:
            state = self._stepped(entry.epoch)
        versions = state.versions
        if not versions or entry.version > versions[-1]:
            entry = entry if triggers is None else entry._replace(triggers=triggers)
            return Status.OK, state, len(versions), entry, ()
        index = bisect_left(versions, entry.version)
        if versions[index] == entry.version:
            if not isinstance(equal, EqualVersion):
                raise TypeError(f"equal must be an EqualVersion, not {equal!r}")
            if equal is not EqualVersion.REPLACE:
                return Status.DUPLICATE, state, index, entry, ()
            lost = (("replaced", entry.version),)
            return Status.OK, _without(state, index, index + 1), index, entry._replace(triggers=False), lost
        if policy is CommitPolicy.INSERT_SORTED and (index > 0 or len(versions) < self.capacity):
            return Status.OK, state, index, entry._replace(triggers=triggers is True), ()
        if policy is CommitPolicy.OVERWRITE:
            lost = tuple(("overwritten", version) for version in versions[index:])
            return Status.OK, _without(state, index, len(versions)), index, entry, lost
        if policy is CommitPolicy.FORCE_NEW_EPOCH:
            return Status.OK, self._stepped(state.epoch + 1), 0, entry._replace(epoch=state.epoch + 1), ()
        return refused, state, index, entry, ()

    def _insert(self, state: State[T], index: int, entry: Entry[T]) -> Entry[T]:
        """Puts a datum, made read-only, into a state, and the state into the window."""
        freeze(entry.value)
        if self.check:
            if entry.completion is not None:
                entry.completion.synchronize()
            entry = entry._replace(checksum=checksum(entry.value))
        version, evicted, previous = entry.version, state.evicted, state.previous
        first = 1 if len(state.versions) >= self.capacity else 0
        if first:
            state.gone.append(state.versions[0])
            evicted, previous = max(evicted, state.versions[0]), None
        versions = (*state.versions[first:index], version, *state.versions[index:])
        entries = (*state.entries[first:index], entry, *state.entries[index:])
        settled = state.settled
        if settled and version in settled:
            settled = {other: None for other in settled if other != version}
        self.state = _new_state((state.epoch, versions, entries, evicted, settled, state.gone, previous))
        return entry

    def settle(self, version: int, epoch: int = CURRENT_EPOCH) -> None:
        """Says that there will be nothing at `version`, unless there is or was something, and tells the subscribers."""
        state = self.state
        if state.versions and state.versions[-1] == version and epoch in (state.epoch, CURRENT_EPOCH):
            return  # the usual case: a component settles what it has committed
        if epoch > state.epoch:
            self.new_epoch(epoch)
        with self._lock:
            state = self.state.of_epoch(epoch)
            epoch = state.epoch
            if version in state.settled or version in state.versions:
                return
            if version <= state.evicted and version in state.gone:
                return
            if any(held.order == (epoch, version) for held in self._held):
                return
            settled = {**state.settled, version: None}
            if len(settled) > _REMEMBERED:
                del settled[next(iter(settled))]
            now = state._replace(settled=settled)
            if state is self.state:
                self.state = now
            elif state is self.state.previous:
                self.state = self.state._replace(previous=now)
        for on_settle in self._on_settle:
            try:
                on_settle(version, epoch)
            except Exception:
                _log.exception("a subscriber of %s failed at the settled version %d", self.topic, version)
        if self._waits:
            self._end_waits()
        if not self._puts_off:
            for after in self._after:
                after()

    def new_epoch(self, epoch: int | None = None) -> int:
        """Starts over, empty: versions may begin anew. Gives the epoch.

        Args:
            epoch: Which; by default the next. One that the window has reached already changes nothing.
        """
        with self._commit_lock:
            self.flush()
            with self._lock:
                self.state = self._stepped(self.state.epoch + 1 if epoch is None else epoch)
                epoch = self.state.epoch
            if self._waits:
                self._end_waits()
            return epoch

    def _stepped(self, epoch: int) -> State[T]:
        """The state with which an epoch begins; the window's own where it is there already."""
        state = self.state
        if epoch <= state.epoch:
            return state
        return State.empty(epoch, state._replace(previous=None))

    def wait(
        self, version: int, on_end: Callable[[Waiting[T]], None], epoch: int = CURRENT_EPOCH, tolerance_ns: int = 0
    ) -> Waiting[T]:
        """Waits for a version, without a thread: calls back once, at once if it is decided already.

        Who lets it end otherwise, at a deadline, calls `Waiting.end` and then `forget`.
        """
        waiting: Waiting[T] = Waiting(version, self.epoch if epoch == CURRENT_EPOCH else epoch, tolerance_ns, on_end)
        with self._lock:
            decided = waiting.decide(self.state)
            if decided is None:
                self._waits.append(waiting)
        if decided is not None:
            waiting.end(*decided)
        return waiting

    def forget(self, waiting: Waiting[T]) -> None:
        """Lets go of a wait that has ended."""
        with self._lock:
            if waiting in self._waits:
                self._waits.remove(waiting)

    def _end_waits(self) -> None:
        ended = []
        with self._lock:
            for waiting in tuple(self._waits):
                decided = waiting.decide(self.state)
                if decided is not None:
                    self._waits.remove(waiting)
                    ended.append((waiting, decided))
        for waiting, decided in ended:
            waiting.end(*decided)

    def _hold(self, policy: Reorder, entry: Entry[T], equal: EqualVersion, triggers: bool | None) -> Status:
        """Holds a datum back until its turn, or commits it where that has passed."""
        state = self.state
        if entry.epoch == CURRENT_EPOCH:
            entry = entry._replace(epoch=max([state.epoch, *(held.entry.epoch for held in self._held)]))
        order = (entry.epoch, entry.version)
        newest = (state.epoch, state.versions[-1] if state.versions else -1)
        if order <= newest:
            return self._publish(CommitPolicy.DISCARD_OUT_OF_ORDER, entry, equal, triggers)
        due = self.clock.monotonic_ns() + policy.delay_ns
        same = next((held for held in self._held if held.order == order), None)
        if same is not None:
            if equal is not EqualVersion.REPLACE:
                self.losses.count(self.topic, "duplicate", entry.version)
                if equal is EqualVersion.ERROR:
                    raise ValueError(f"version {entry.version} of {self.topic!r} is held back already")
                return Status.DUPLICATE
            self.losses.count(self.topic, "replaced", entry.version)
            self._held.remove(same)
            due = same.due_ns
        freeze(entry.value)
        insort(self._held, _Held(order, due, entry, equal, triggers), key=lambda held: held.order)
        self._release(len(self._held) - policy.depth)
        if self._held and same is None:
            self.clock.call_at(due, self._release_due)
        return Status.OK

    def _release_due(self) -> None:
        """Publishes what was held long enough, and what comes before it."""
        with self._commit_lock:
            now = self.clock.monotonic_ns()
            self._release(max((number for number, held in enumerate(self._held, 1) if held.due_ns <= now), default=0))
        for after in self._after:
            after()

    def _release(self, count: int) -> None:
        for _ in range(count):
            held = self._held.pop(0)
            entry = held.entry._replace(committed_ns=self.clock.monotonic_ns())
            self._publish(CommitPolicy.DISCARD_OUT_OF_ORDER, entry, held.equal, held.triggers)

    def flush(self) -> None:
        """Publishes all that `Reorder` holds back."""
        with self._commit_lock:
            if not self._held:
                return
            self._release(len(self._held))
        for after in self._after:
            after()

    def verify_version(self, version: int, epoch: int) -> None:
        """Does what `verify` does with the datum of a version, if it is there."""
        entry = self.find(version, epoch)
        if entry is not None:
            self.verify(entry)

    def verify(self, entry: Entry[T]) -> None:
        """Counts a datum, once, whose payload is not what it was at its commit: somebody wrote to it."""
        if entry.checksum is None or checksum(entry.value) == entry.checksum:
            return
        order = (entry.epoch, entry.version)
        if order not in self._modified:
            self._modified.add(order)
            self.losses.count(self.topic, "modified", entry.version)
            _log.error("%s: the payload of version %d was written to after its commit", self.topic, entry.version)


def _without(state: State[T], start: int, end: int) -> State[T]:
    return state._replace(
        versions=state.versions[:start] + state.versions[end:], entries=state.entries[:start] + state.entries[end:]
    )
