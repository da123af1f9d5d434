"""What a commit does when its version is not newer than the newest."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

__all__ = ["CommitPolicy", "EqualVersion", "Reorder"]


class CommitPolicy(IntEnum):
    """What a commit does when its version is older than the newest in the window. One more is `Reorder`."""

    DISCARD_OUT_OF_ORDER = 0
    """Drops it, counted: the usual one."""
    INSERT_SORTED = 1
    """Puts it in its place in the history. It triggers nobody, unless the commit says `triggers=True`."""
    REJECT = 2
    """Refuses it, counted; the change stays open, and its writer may give it another version or policy."""
    OVERWRITE = 3
    """Makes it the newest: what is newer is taken out of the window, counted."""
    FORCE_NEW_EPOCH = 4
    """Begins a new epoch with it: for a producer whose clock steps back, or whose recording loops."""


@dataclass(frozen=True, slots=True)
class Reorder:
    """Holds data back, and publishes them in the order of versions; what comes later still is dropped, counted."""

    delay_ns: int
    """How long one is held at most, by the mesh's clock [ns]."""
    depth: int
    """How many are held at most; a further one lets the lowest go."""

    def __post_init__(self) -> None:
        if self.delay_ns < 0:
            raise ValueError(f"delay_ns must be >= 0, not {self.delay_ns}")
        if self.depth < 0:
            raise ValueError(f"depth must be >= 0, not {self.depth}")


class EqualVersion(IntEnum):
    """What a commit does when its version is in the window already, whatever its policy."""

    KEEP_FIRST = 0
    """Drops the second, counted."""
    REPLACE = 1
    """Puts the second in the place of the first, which is counted. It triggers nobody again."""
    ERROR = 2
    """Raises ValueError, counted."""
