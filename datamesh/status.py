"""How a commit, a wait or a run of a processor ended."""

from __future__ import annotations

from enum import Enum, IntEnum

__all__ = ["Outcome", "Status"]


class Status(IntEnum):
    """The outcome of a commit or of a run. Falsy on OK only, so `if status:` reads "if something is wrong"."""

    OK = 0
    MISS = 1
    """An input was not there at the version wanted."""
    OUT_OF_ORDER = 2
    """Older than the newest in the window, so it was discarded."""
    DUPLICATE = 3
    """This version is in the window already, and stays."""
    TIMEOUT = 4
    """An input did not come before the deadline."""
    SKIPPED = 5
    """Not run, because an input that it needs is absent in this frame."""
    FAILED = 6
    """It raised an exception: the frame is lost, the next one runs."""
    SHUTDOWN = 7
    """The process is stopping."""
    REJECTED = 8
    """Older than the newest in the window: the change stays with its writer, who may give it another version."""
    CUT = 9
    """Left out, because the frame is past its deadline."""


class Outcome(Enum):
    """How a wait for a version ended."""

    FOUND = "found"
    """The datum is there."""
    TIMEOUT = "timeout"
    """It was not there at the deadline."""
    EVICTED = "evicted"
    """The window's history no longer reaches back to it, so it cannot come any more."""
    SETTLED_EMPTY = "settled empty"
    """The producer said that there will be nothing."""
    SHUTDOWN = "shutdown"
    """Who waited is stopping."""
