"""How the work on a cloud is cut into parts for the threads of a CPU: by points, or by the rows of a grid.

Results never depend on the cut: a part by points writes places of its own, a part by rows has whole cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

from .device import DEFAULT_DEVICE
from .threads import launch_parts, thread_count

__all__ = ["part_start", "parts_for", "run_parts"]


def parts_for(capacity: int, least: int) -> int:
    """How many parts a plan for up to `capacity` points is cut into: one a thread, of at least `least` points."""
    return max(1, min(thread_count(), capacity // least))


@wp.func
def part_start(length: int, part: int, parts: int) -> int:
    """Where a part of `length` things begins; where the part after it begins, it ends."""
    return length / parts * part + wp.min(part, length % parts)


def run_parts(kernel: Any, parts: int, device: str, inputs: Sequence[Any], outputs: Sequence[Any] = ()) -> None:
    """Launches a kernel once per part, at once on a CPU, one after the other on another device.

    Args:
        kernel: A Warp kernel whose first two parameters are the part and `parts`, for one thread each.
        parts: How many.
        device: Where.
        inputs: The parameters that follow.
        outputs: Those that it writes.
    """
    if device == DEFAULT_DEVICE:
        launch_parts(kernel, parts, inputs, outputs)
        return
    for part in range(parts):
        wp.launch(kernel, 1, inputs=[part, parts, *inputs], outputs=list(outputs), device=device)
