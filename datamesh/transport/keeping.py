"""What is kept for a reader that was killed, until it is back and has caught up."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable

from ..snapshot import Entry
from .config import SharedMemoryConfig

__all__ = ["Absent", "Kept"]


class Kept:
    """Data for one reader, the oldest first."""

    __slots__ = ("entries", "until_s")

    def __init__(self, entries: Iterable[tuple[Entry, bool]], until_s: float) -> None:
        self.entries = deque(entries)
        """Each with whether it was sent before, so that it is to trigger nothing when it is sent again."""
        self.until_s = until_s
        """When they are let go of, if the reader is not back."""

    def add(self, entry: Entry, most: int) -> list[Entry]:
        """Keeps one more, and at most so many; gives those that made way for it and were never sent."""
        self.entries.append((entry, False))
        lost = []
        while len(self.entries) > most:
            oldest, sent = self.entries.popleft()
            if not sent:
                lost.append(oldest)
        return lost


class Absent:
    """The readers of a topic that went without a word, and what is kept for each."""

    def __init__(self, config: SharedMemoryConfig, on_lost: Callable[[Entry], None]) -> None:
        """Nobody is absent yet.

        Args:
            config: How much is kept, and for how long.
            on_lost: Is told of each datum that was kept in vain.
        """
        self._config = config
        self._on_lost = on_lost
        self.readers: dict[str, Kept] = {}
        """Those who are absent, by name."""

    def __len__(self) -> int:
        """How many data are kept."""
        return sum(len(kept.entries) for kept in self.readers.values())

    def leaves(self, name: str, entries: Iterable[tuple[Entry, bool]]) -> None:
        """A reader is gone: from here on all is kept for it, behind what is given."""
        if self._config.kept:
            self.readers[name] = Kept(entries, time.monotonic() + self._config.kept_s)

    def returns(self, name: str) -> Kept | None:
        """A reader is here: what was kept for it, if it was absent."""
        self.tidy()
        return self.readers.pop(name, None)

    def most(self, size: int) -> int:
        """How many data of a size [B] are kept for a reader."""
        return max(1, min(self._config.kept, self._config.kept_bytes // max(1, size)))

    def add(self, entry: Entry, size: int) -> None:
        """Keeps a datum, of about `size` [B], for each."""
        self.tidy()
        for kept in self.readers.values():
            for lost in kept.add(entry, self.most(size)):
                self._on_lost(lost)

    def tidy(self) -> None:
        """Gives up those who have been absent for too long."""
        now = time.monotonic()
        for name in [name for name, kept in self.readers.items() if now >= kept.until_s]:
            self._give_up(name)

    def make_room(self) -> bool:
        """Lets go of the older half, as the memory is needed; tells whether there was any."""
        some = False
        for kept in self.readers.values():
            some = some or bool(kept.entries)
            self._lose(kept, (len(kept.entries) + 1) // 2)
        return some

    def _give_up(self, name: str) -> None:
        kept = self.readers.pop(name)
        self._lose(kept, len(kept.entries))

    def _lose(self, kept: Kept, count: int) -> None:
        for _ in range(count):
            entry, sent = kept.entries.popleft()
            if not sent:
                self._on_lost(entry)
