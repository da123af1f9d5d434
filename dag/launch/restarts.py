"""When a process that died is started again, and when that has no more sense."""

from __future__ import annotations

from collections import deque

from .schema import BackOffSpec, RestartsSpec

__all__ = ["Restarts"]


class Restarts:
    """Counts the deaths of one process.

    The n-th death within the window is followed by a wait of `first_s · factor^(n−1)`, at most `max_s`, without
    chance; the one after `limit` restarts by none: it is given up.
    """

    def __init__(self, back_off: BackOffSpec, restarts: RestartsSpec) -> None:
        """Begins with no death.

        Args:
            back_off: How long the waits are.
            restarts: Window and limit.
        """
        self._back_off = back_off
        self._restarts = restarts
        self._deaths: deque[float] = deque()
        self.count = 0
        """Restarts since the beginning."""

    def died(self, now: float) -> float | None:
        """Notes a death.

        Args:
            now: By a clock that only goes forward [s].

        Returns:
            How long to wait before the next start [s]; None: the limit is reached.
        """
        while self._deaths and now - self._deaths[0] >= self._restarts.window_s:
            self._deaths.popleft()
        self._deaths.append(now)
        if len(self._deaths) > self._restarts.limit:
            return None
        self.count += 1
        # The exponent is bounded, so that no power overflows; after 1024 doublings every wait is at its maximum.
        power = min(len(self._deaths) - 1, 1024)
        try:
            wait = self._back_off.first_s * self._back_off.factor**power
        except OverflowError:
            wait = self._back_off.max_s
        return min(wait, self._back_off.max_s)

    def said(self) -> str:
        """The limit as a text."""
        return f"{self._restarts.limit} restarts within {self._restarts.window_s:g} s"
