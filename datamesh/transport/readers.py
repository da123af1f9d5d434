"""What a writer knows of one of its readers."""

from __future__ import annotations

import select
import socket
from collections import deque
from collections.abc import Sequence

from ..snapshot import Entry
from .keeping import Kept
from .slabs import Slab

__all__ = ["Reader"]


class Reader:
    """A connection to a process that reads the topic, and what that holds."""

    __slots__ = (
        "_slabs",
        "blocks",
        "ended",
        "flight",
        "held",
        "kept",
        "leaves",
        "most",
        "name",
        "number",
        "reached",
        "send",
        "socket",
    )

    def __init__(self, connection: socket.socket, name: str, most: int, blocks: bool) -> None:
        """It holds nothing yet.

        Args:
            connection: Its socket, which does not block.
            name: Of its process.
            most: How many payloads in slabs it may hold.
            blocks: Whether its backlog blocks its producer.
        """
        self.socket = connection
        self.send = connection.send
        self.name = name
        self.most = most
        self.blocks = blocks
        self.reached = (-1, -1)
        """The newest that it was sent: epoch and version."""
        self.number = 0
        """Of events, dropped ones too."""
        self.held = 0
        """How many payloads it has at least one slab of."""
        self._slabs: dict[int, deque[list[int]]] = {}
        # By offset: for each payload that is in the slab, of how many slabs the reader still has to let go, in a list
        # that its slabs share.
        self.flight: deque[Entry] = deque()
        """What it was sent last, and may not have read."""
        self.kept: Kept | None = None
        """What was kept for it while it was away, and what was committed since; None once it has caught up."""
        self.leaves = False
        """It has said good-bye; otherwise it was killed."""
        self.ended = False
        """It is sent nothing any more."""

    @property
    def is_full(self) -> bool:
        """Whether it holds as much as it may."""
        return self.held >= self.most

    def has_sent(self, entry: Entry, epoch: int, in_slabs: bool) -> None:
        """Notes what it was sent, for when it is killed; what it has let go of, it has read."""
        self.reached = max(self.reached, (epoch, entry.version))
        self.flight.append(entry)
        while len(self.flight) > (self.held if in_slabs else self.most):
            self.flight.popleft()

    def holds(self, slabs: Sequence[Slab]) -> None:
        """Notes that it was sent a payload in slabs, each of which it will let go of once."""
        if not slabs:
            return
        left = [len(slabs)]
        for slab in slabs:
            slab.holders += 1
            self._slabs.setdefault(slab.offset, deque()).append(left)
        self.held += 1

    def lets_go(self, offset: int) -> bool:
        """Notes that it has let go of a slab, once; false where it does not hold it."""
        payloads = self._slabs.get(offset)
        if payloads is None:
            return False
        left = payloads.popleft()
        if not payloads:
            del self._slabs[offset]
        left[0] -= 1
        if not left[0]:
            self.held -= 1
            while len(self.flight) > self.held:
                self.flight.popleft()
        return True

    def slabs(self) -> list[int]:
        """The offsets of the slabs that it holds, each as often as it does."""
        return [offset for offset, payloads in self._slabs.items() for _ in payloads]

    def wait(self, full: bool) -> None:
        """Waits until it has let go of something, or takes another message where it is not full."""
        poll = select.poll()
        poll.register(self.socket, select.POLLIN | (0 if full else select.POLLOUT))
        poll.poll(50)
