"""The backlog: triggers that wait for their component, bounded, with every drop counted."""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from ..datamesh import LossCounters
from .trigger import Trigger

__all__ = ["Backlog", "BacklogConfig"]

_SETTLED = 256
"""How many settled versions may wait for their turn."""


class BacklogConfig(BaseModel):
    """What happens when triggers come faster than the component runs."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    policy: Literal["latest", "fifo", "block"] = "latest"
    """latest: the newest replaces what waits; fifo: a queue that drops when full; block: the producer waits."""
    depth: int = Field(1, ge=1, le=1 << 20)
    """How many triggers may wait; `latest` keeps one."""
    drop: Literal["oldest", "newest"] = "oldest"
    """Which one a full fifo drops."""


class Backlog:
    """A queue of triggers between the committing threads and the component."""

    def __init__(self, place: str, config: BacklogConfig, losses: LossCounters) -> None:
        """Makes an empty backlog.

        Args:
            place: The component's name, for the counters.
            config: Policy and depth.
            losses: Where drops are counted, with the reason `backlog`.
        """
        self._place = place
        self._blocks = config.policy == "block"
        self._depth = 1 if config.policy == "latest" else config.depth
        self._drop_newest = config.policy == "fifo" and config.drop == "newest"
        self._losses = losses
        self.waiting: deque[Trigger] = deque()
        """What waits, the oldest first: to be looked at."""
        self.on_taken: Callable[[Trigger], None] | None = None
        """Is told of each frame that is taken, in the thread that takes it."""
        self.on_dropped: Callable[[Trigger], None] = lambda trigger: None
        """Is told of each trigger that `offer` gives back, in the thread that offers."""
        self.gives_way: Callable[[], bool] = lambda: False
        """Whether it takes more than it has room for, rather than let a producer wait; `look_again` as that changes."""
        self._frames = 0  # of those that wait, the ones that are not settled
        self._lock = threading.Lock()
        self._room = threading.Condition(self._lock)
        # A queue in C wakes its thread in half the time that a condition does.
        self._wakes: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._sleepers = 0
        self.closed = False
        """Whether it takes nothing more."""

    def __len__(self) -> int:
        return len(self.waiting)

    def offer(self, trigger: Trigger) -> Trigger | None:
        """Adds a trigger; with policy `block` waits for room.

        Returns:
            The trigger that was dropped for it, or it itself when it was refused; None when nothing was lost. A settled
            one is only given back where very many wait, and is not counted.
        """
        dropped: Trigger | None = None
        reason = "backlog"
        with self._lock:
            if trigger.settled or self._frames >= self._depth or self.closed:
                dropped, reason = self._make_room(trigger)
            wakes = False
            if dropped is not trigger:
                self.waiting.append(trigger)
                self._frames += not trigger.settled
                wakes = self._sleepers > 0
                self._sleepers -= wakes
        if wakes:
            self._wakes.put(None)
        if dropped is not None:
            if not dropped.settled:
                self._losses.count(self._place, reason, dropped.version)
            self.on_dropped(dropped)
        return dropped

    def _make_room(self, trigger: Trigger) -> tuple[Trigger | None, str]:
        """Makes room, or waits for it: what is dropped, and why. Called with the lock held."""
        while self._blocks and not trigger.settled and self._frames >= self._depth and not self.closed:
            if self.gives_way():
                return None, "backlog"
            self._room.wait()
        if self.closed:
            return trigger, "shutdown"
        if trigger.settled:
            full = len(self.waiting) - self._frames >= _SETTLED
            return (self._take_first(settled=True) if full else None), "backlog"
        if self._frames >= self._depth:
            return (trigger if self._drop_newest else self._take_first(settled=False)), "backlog"
        return None, "backlog"

    def _take_first(self, *, settled: bool) -> Trigger:
        dropped = next(waiting for waiting in self.waiting if waiting.settled is settled)
        self.waiting.remove(dropped)
        self._frames -= not settled
        return dropped

    def take(self) -> Trigger | None:
        """The oldest trigger, waited for; None once the backlog is closed and empty."""
        while True:
            trigger = self.take_now()
            if trigger is not None:
                return trigger
            with self._lock:
                if self.waiting:
                    continue
                if self.closed:
                    return None
                self._sleepers += 1
            self._wakes.get()

    def take_now(self) -> Trigger | None:
        """The oldest trigger; None when there is none."""
        with self._lock:
            if not self.waiting:
                return None
            trigger = self.waiting.popleft()
            if trigger.settled:
                return trigger
            self._frames -= 1
            if self._blocks:
                self._room.notify()
        if self.on_taken is not None:
            self.on_taken(trigger)
        return trigger

    def look_again(self) -> None:
        """Lets producers that wait for room see whether it gives way."""
        with self._lock:
            self._room.notify_all()

    def close(self) -> None:
        """Takes nothing more; what waits can still be taken."""
        with self._lock:
            self.closed = True
            self._room.notify_all()
            sleepers, self._sleepers = self._sleepers, 0
        for _ in range(sleepers):
            self._wakes.put(None)

    def open(self) -> None:
        """Takes triggers again."""
        with self._lock:
            self.closed = False
