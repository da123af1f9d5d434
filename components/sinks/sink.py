"""What every sink of perception's output has in common."""

from __future__ import annotations

from typing import Protocol, Self

import numpy as np

from ..messages import Obstacles

__all__ = ["Sink"]


class Sink(Protocol):
    """Takes the obstacles of frame after frame; a context manager that closes it at its end."""

    written: int
    """Frames that were taken."""
    dropped: int
    """Frames that were left out because the sink was too slow."""

    def write(
        self,
        obstacles: Obstacles,
        *,
        latency_ms: float,
        points: np.ndarray | None = None,
        pose: np.ndarray | None = None,
    ) -> None:
        """Takes one frame.

        Args:
            obstacles: What perception said.
            latency_ms: From the frame's arrival to its obstacles [ms].
            points: x y z [m], intensity of the frame, shape (n, 4); a sink that keeps no clouds leaves them.
            pose: World from sensor, shape (4, 4), where known.

        Raises:
            SinkError: It cannot be written.
        """
        ...

    def close(self) -> None:
        """Writes what is left; after that nothing can be written. Twice is no harm.

        Raises:
            SinkError: It cannot be written.
        """
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *exc_info: object) -> None: ...
