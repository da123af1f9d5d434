"""Triggers as they come of commits, of settled versions, and of time."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial

from ..datamesh import Clock, Entry, Input, LossCounters, Miss, Timer, Window
from .trigger import Trigger

__all__ = ["AllTrigger", "AnyTrigger", "TimeTrigger", "TriggerSource"]

_READINGS = 8
"""How often both times of the clock are read until no time passes in between."""
_REMEMBERED = 256
"""How many versions a source knows one by one: those that triggered, and those that it waits to complete."""

Offer = Callable[[Trigger], None]
_Order = tuple[int, int]
_new_trigger = partial(tuple.__new__, Trigger)  # in half the time that the named tuple's own takes, which is in Python


class _Seen:
    """The versions that a source was told of last."""

    __slots__ = ("newest", "orders")

    def __init__(self) -> None:
        self.newest = (-1, -1)
        self.orders: deque[_Order] = deque(maxlen=_REMEMBERED)

    def __contains__(self, order: _Order) -> bool:
        return order <= self.newest and order in self.orders

    def add(self, order: _Order) -> bool:
        """Adds one, and tells whether it is new."""
        if order > self.newest:
            self.newest = order
        elif order in self.orders:
            return False
        self.orders.append(order)
        return True


class TriggerSource:
    """Makes triggers of events, from its making on; `start` and `stop` matter to those of time alone."""

    def __init__(self, offer: Offer) -> None:
        self.offer = offer
        """Takes the triggers."""

    def start(self) -> None:
        """Begins to tick."""

    def stop(self) -> None:
        """Ends ticking."""


class AnyTrigger(TriggerSource):
    """Each commit to one of several inputs triggers, each version once.

    A version is settled when every input has settled it, or has gone past it without having it.
    """

    def __init__(self, inputs: Mapping[str, Input], offer: Offer, after: Callable[[], None] | None = None) -> None:
        """Subscribes to the inputs, which must be bound.

        Args:
            inputs: Those that trigger, by name.
            offer: Takes the triggers, in the thread that commits or settles.
            after: Is called in that thread when the commit or settle is through.
        """
        self._windows = {name: one.window for name, one in inputs.items()}
        super().__init__(offer)
        self._lock = threading.Lock()
        self._seen = _Seen()
        self._empty: dict[_Order, set[str]] = {}
        for name, window in self._windows.items():
            window.subscribe(partial(self._on_commit, name), partial(self._on_settle, name), after)

    def _on_commit(self, name: str, entry: Entry) -> None:
        version, _, received_ns, committed_ns, epoch, triggers, _, _ = entry
        if not triggers:
            self._on_settle(name, version, epoch)
            return
        order, seen, passed = (epoch, version), self._seen, ()
        with self._lock:
            if order > seen.newest:  # the usual case, without a call
                seen.newest = order
                seen.orders.append(order)
                new = True
            else:
                new = seen.add(order)
            if self._empty:
                self._empty.pop((epoch, version), None)
                passed = self._passed()
        if new:
            self.offer(_new_trigger((version, received_ns, False, epoch, committed_ns, {name: version})))
        if passed:
            self._settle(passed)

    def _on_settle(self, name: str, version: int, epoch: int) -> None:
        order = (epoch, version)
        with self._lock:
            if order in self._seen:
                return
            self._empty.setdefault(order, set()).add(name)
            passed = self._passed()
        self._settle(passed)

    def _passed(self) -> list[_Order]:
        """Takes the versions that will not come any more; when too many may, the oldest of them."""
        passed = [order for order, settled_by in self._empty.items() if self._is_empty(order, settled_by)]
        passed += list(self._empty)[: max(0, len(self._empty) - len(passed) - _REMEMBERED)]
        for order in passed:
            self._empty.pop(order, None)
            self._seen.add(order)
        return passed

    def _is_empty(self, order: _Order, settled_by: set[str]) -> bool:
        return all(name in settled_by or _newest(window) > order for name, window in self._windows.items())

    def _settle(self, orders: list[_Order] | tuple[()]) -> None:
        for epoch, version in orders:
            self.offer(Trigger(version, settled=True, epoch=epoch))


class AllTrigger(TriggerSource):
    """A version of the first input triggers once every other input has one within the tolerance, the nearest there.

    When one of them cannot come any more, the version is settled, and counted as `incomplete`.
    """

    def __init__(
        self,
        inputs: Mapping[str, Input],
        offer: Offer,
        after: Callable[[], None] | None = None,
        *,
        tolerance_ns: int,
        place: str,
        losses: LossCounters,
    ) -> None:
        """Subscribes to the inputs, which must be bound.

        Args:
            inputs: By name; the versions of the first are those of the triggers.
            offer: Takes the triggers, in the thread that completes them.
            after: Is called in that thread when the commit or settle is through.
            tolerance_ns: How far from it the others may be [ns].
            place: The component's name, for the counters.
            losses: Where what stays incomplete is counted.
        """
        self._windows = {name: one.window for name, one in inputs.items()}
        self._first = next(iter(inputs))
        super().__init__(offer)
        self._tolerance = tolerance_ns
        self._place = place
        self._losses = losses
        self._lock = threading.Lock()
        self._pending: dict[_Order, int] = {}
        self._seen = _Seen()
        self._bound = min(_REMEMBERED, *(window.capacity for window in self._windows.values()))
        for name, window in self._windows.items():
            window.subscribe(partial(self._on_commit, name), partial(self._on_settle, name), after)

    def _on_commit(self, name: str, entry: Entry) -> None:
        if name == self._first:
            order = (entry.epoch, entry.version)
            if not entry.triggers:
                self._on_settle(name, entry.version, entry.epoch)
                return
            with self._lock:
                if self._seen.add(order):
                    self._pending[order] = entry.received_ns
        self._complete()

    def _on_settle(self, name: str, version: int, epoch: int) -> None:
        if name == self._first:
            order = (epoch, version)
            with self._lock:
                new = self._seen.add(order)
            if new:
                self.offer(Trigger(version, settled=True, epoch=epoch))
        self._complete()

    def _complete(self) -> None:
        with self._lock:
            triggers, lost = [], []
            for order, received_ns in sorted(self._pending.items()):
                versions = self._versions(order)
                if versions is None:
                    lost.append(order)
                elif len(versions) == len(self._windows):
                    epoch, version = order
                    now = self._windows[self._first].clock.monotonic_ns()
                    triggers.append(Trigger(version, received_ns, False, epoch, now, versions))
                else:
                    continue
                del self._pending[order]
            while len(self._pending) > self._bound:
                lost.append(min(self._pending))
                del self._pending[lost[-1]]
        for epoch, version in lost:
            self._losses.count(self._place, "incomplete", version)
            triggers.append(Trigger(version, settled=True, epoch=epoch))
        for trigger in sorted(triggers, key=lambda one: (one.epoch, one.version)):
            self.offer(trigger)

    def _versions(self, order: _Order) -> dict[str, int] | None:
        """The versions that are there, by input; None when one cannot come any more."""
        epoch, version = order
        versions = {self._first: version}
        for name, window in self._windows.items():
            if name == self._first:
                continue
            snapshot = window.snapshot(epoch)
            index = snapshot.nearest(version, self._tolerance)
            if index >= 0:
                versions[name] = snapshot.versions[index]
            elif (
                _newest(window) > (epoch, version + self._tolerance)
                or snapshot.miss(version) is Miss.SETTLED_EMPTY
                or snapshot.miss(version + self._tolerance) is Miss.EVICTED
            ):
                return None
        return versions


class TimeTrigger(TriggerSource):
    """Triggers every period, at versions one period apart; a clock that is set back begins a new epoch.

    Ticks that come late, or while the component is busy, are skipped or become one, and are counted: never a burst.
    """

    def __init__(
        self,
        clock: Clock,
        offer: Offer,
        *,
        period_ns: int,
        is_busy: Callable[[], bool],
        place: str,
        losses: LossCounters,
    ) -> None:
        """Makes a source that `start` sets ticking.

        Args:
            clock: Gives the versions and the ticks.
            offer: Takes the triggers, in the clock's thread.
            period_ns: From tick to tick [ns].
            is_busy: Whether the component cannot take a tick now, so that it is skipped.
            place: The component's name, for the counters.
            losses: Where skipped ticks are counted, as `overrun`.
        """
        self._clock = clock
        super().__init__(offer)
        self._period = period_ns
        self._is_busy = is_busy
        self._place = place
        self._losses = losses
        self._lock = threading.Lock()
        self._timer: Timer | None = None
        self._ticking = False
        self._version: int | None = None
        self._epoch = 0

    def start(self) -> None:
        """Ticks first after one period."""
        with self._lock:
            self._ticking = True
            self._schedule(self._clock.monotonic_ns() + self._period)

    def stop(self) -> None:
        """Ends ticking."""
        with self._lock:
            self._ticking = False
            if self._timer is not None:
                self._timer.cancel()

    def _schedule(self, due_ns: int) -> None:
        self._timer = self._clock.call_at(due_ns, partial(self._tick, due_ns))

    def _tick(self, due_ns: int) -> None:
        with self._lock:
            if not self._ticking:
                return
            at, now = self._times()
            missed = max(0, at - due_ns) // self._period
            late = at - due_ns - missed * self._period
            self._version = version = self._next_version(now - late, missed)
            self._schedule(due_ns + (missed + 1) * self._period)
        if missed:
            self._losses.count(self._place, "overrun", version, amount=missed)
        trigger = Trigger(version, at, False, self._epoch, at)
        if self._is_busy():
            self._losses.count(self._place, "overrun", version)
            trigger = trigger._replace(settled=True)
        self.offer(trigger)

    def _times(self) -> tuple[int, int]:
        """Both times of the clock, of one moment.

        A thread that loses its core between the two would find the clock set forward, and at the next tick set back:
        where that took long they are read again.
        """
        at = now = 0
        for _ in range(_READINGS):
            at, now = self._clock.monotonic_ns(), self._clock.now_ns()
            if self._clock.monotonic_ns() - at < self._period // 8:
                break
        return at, now

    def _next_version(self, now: int, missed: int) -> int:
        last = self._version
        if last is None:
            return now
        expected = last + (missed + 1) * self._period
        if abs(now - expected) < self._period // 2:
            return expected  # versions do not shake with the thread that makes them
        if now <= last:
            self._epoch += 1
        return now


def _newest(window: Window) -> _Order:
    snapshot = window.snapshot()
    return snapshot.epoch, snapshot.versions[-1] if snapshot.versions else -1
