"""The backlog: triggers that wait for their component, bounded, with every drop counted."""

from __future__ import annotations

import threading
from collections import deque
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from ..datamesh import LossCounters
from .trigger import Trigger

__all__ = ["Backlog", "BacklogConfig"]


class BacklogConfig(BaseModel):
    """What happens when triggers come faster than the component runs."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    policy: Literal["latest", "fifo", "block"] = "latest"
    """latest: the newest replaces what waits; fifo: a queue that drops when full; block: the producer waits."""
    depth: int = Field(1, ge=1)
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
        self._policy = config.policy
        self._depth = 1 if config.policy == "latest" else config.depth
        self._drop_newest = config.policy == "fifo" and config.drop == "newest"
        self._losses = losses
        self._waiting: deque[Trigger] = deque()
        self._changed = threading.Condition()
        self._closed = False

    def offer(self, trigger: Trigger) -> Trigger | None:
        """Adds a trigger; with policy `block` waits for room.

        Returns:
            The trigger that was dropped for it, or it itself when it was refused; None when nothing was lost.
        """
        dropped: Trigger | None = None
        with self._changed:
            while self._policy == "block" and self._full() and not (self._closed or trigger.settled):
                self._changed.wait()
            if self._closed:
                dropped = trigger
            elif not trigger.settled and self._full():
                if self._drop_newest:
                    dropped = trigger
                else:
                    dropped = next(waiting for waiting in self._waiting if not waiting.settled)
                    self._waiting.remove(dropped)
            if dropped is not trigger:
                self._waiting.append(trigger)
                self._changed.notify_all()
            reason = "shutdown" if self._closed else "backlog"
        if dropped is not None and not dropped.settled:
            self._losses.count(self._place, reason, dropped.version)
        return dropped

    def _full(self) -> bool:
        return sum(not trigger.settled for trigger in self._waiting) >= self._depth

    def take(self) -> Trigger | None:
        """The oldest trigger, waited for; None once the backlog is closed and empty."""
        with self._changed:
            while not self._waiting and not self._closed:
                self._changed.wait()
            if not self._waiting:
                return None
            trigger = self._waiting.popleft()
            self._changed.notify_all()
            return trigger

    def close(self) -> None:
        """Takes nothing more; what waits can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
