"""The execution context: what a profile gives to every component and processor of a process."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import warp as wp

__all__ = ["ExecutionContext", "empty_cloud"]


@dataclass(frozen=True, kw_only=True)
class ExecutionContext:
    """Where and how large: processors read it as `self.context`."""

    device: str = "cpu"
    """The Warp device of the kernels."""
    capacity: int = 200_000
    """Points of a cloud that there is room for."""
    mounting_height: float | None = None
    """Height of the LiDAR above the ground [m]; None: estimated in each frame."""
    inference_threads: int = 2
    """Threads of a detection head on a CPU."""
    detector: Path | None = None
    """Card of the detection head; None is the shipped one."""


def empty_cloud(device: str) -> tuple[wp.array, wp.array]:
    """No points, and their count: a stage runs on them when it is made, so that its kernels are compiled and loaded.

    Returns:
        Positions with room for one point, vec3, and the count zero, int32, both on `device`.
    """
    return wp.zeros(1, dtype=wp.vec3, device=device), wp.zeros(1, dtype=wp.int32, device=device)
