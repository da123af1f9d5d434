"""The deadline of a frame, and what becomes of a frame that is past it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from ..datamesh import Clock
from .trigger import Trigger

__all__ = ["DeadlineConfig", "FrameDeadline"]


class DeadlineConfig(BaseModel):
    """By when a component is to be done with a frame."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    ms: float = Field(gt=0.0, le=86_400_000.0)
    """From when the sensor's data was received, or else from the trigger [ms]."""
    on_miss: Literal["count", "degrade", "cut"] = "count"
    """count: nothing else happens; degrade: expendable vertices that have not started are left out; cut: everything
    that has not started is left out, and whoever waits for the frame is told at once."""


class FrameDeadline:
    """The deadline of one frame."""

    __slots__ = ("_clock", "_done", "_due_ns", "_on_miss", "_timer")

    def __init__(
        self, config: DeadlineConfig, trigger: Trigger, clock: Clock, settle: Callable[[int, int], None]
    ) -> None:
        """Starts the time of a frame.

        Args:
            config: Its deadline.
            trigger: Of the frame.
            clock: By which its time passes.
            settle: Is called with version and epoch when the frame is cut, also while a vertex still hangs in it.
        """
        self._clock = clock
        self._on_miss = config.on_miss
        self._due_ns = (trigger.received_ns or trigger.at_ns or clock.monotonic_ns()) + round(config.ms * 1e6)
        self._done = False
        self._timer = None
        if config.on_miss == "cut":
            self._timer = clock.call_at(
                self._due_ns, lambda: None if self._done else settle(trigger.version, trigger.epoch)
            )

    def is_past(self) -> bool:
        """Whether its time is over."""
        return self._clock.monotonic_ns() > self._due_ns

    def leaves_out(self, expendable: bool) -> bool:
        """Whether a vertex that is about to start is left out."""
        return (self._on_miss == "cut" or (self._on_miss == "degrade" and expendable)) and self.is_past()

    def end(self) -> bool:
        """Ends it, as the frame is done; tells whether that was too late."""
        self._done = True
        if self._timer is not None:
            self._timer.cancel()
        return self.is_past()
