"""How the work on a cloud is cut into parts for the threads of a CPU: by points, or by the rows of a grid.

Results never depend on the cut: a part by points writes places of its own, a part by rows has whole cells.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import warp as wp

from .device import DEFAULT_DEVICE
from .threads import PackedLaunch, thread_count

__all__ = ["first_row_of", "packed_parts", "part_start", "parts_for", "run_parts"]


def parts_for(capacity: int, least: int) -> int:
    """How many parts a plan for up to `capacity` points is cut into: one a thread, of at least `least` points."""
    return max(1, min(thread_count(), capacity // least))


@wp.func
def part_start(length: int, part: int, parts: int) -> int:
    """Where a part of `length` things begins; where the part after it begins, it ends."""
    return length / parts * part + wp.min(part, length % parts)


@wp.func_native("""
    constexpr int MOST = 512;
    if (part == 0 || part == parts) return part == 0 ? 0 : rows;
    const int step = count / MOST + 1;
    int sample[MOST], samples = 0;
    for (int i = 0; i < count; i += step) {
        sample[samples] = cell_in.data[i];
        samples += cell_in.data[i] >= 0;
    }
    const int wanted = (int)((long long)samples * part / parts);
    int low = 0, high = rows;
    while (low < high) {
        const int middle = (low + high) / 2, end = (middle + 1) * width;
        int below = 0;
        for (int i = 0; i < samples; ++i) below += sample[i] < end;
        if (below <= wanted) low = middle + 1;
        else high = middle;
    }
    return low;
""")
def first_row_of(part: int, parts: int, cell_in: wp.array(dtype=wp.int32), count: int, rows: int, width: int) -> int:
    """Where a part's rows of a grid begin, so that each part has about as many of a sample of the points.

    Args:
        part: The part, 0 … parts; where the part after it begins, it ends.
        parts: How many.
        cell_in: Of each point row × width + column, or −1 where it is in none.
        count: How many points.
        rows: Of the grid.
        width: How many numbers a row takes.
    """
    return 0


def run_parts(kernel: Any, parts: int, device: str, inputs: Sequence[Any], outputs: Sequence[Any] = ()) -> None:
    """Launches a kernel once per part, at once on a CPU, one after the other on another device.

    Args:
        kernel: A Warp kernel whose first two parameters are the part and `parts`, for one thread each.
        parts: How many.
        device: Where.
        inputs: The parameters that follow.
        outputs: Those that it writes.
    """
    packed_parts(kernel, parts, device, inputs, outputs)()


def packed_parts(
    kernel: Any, parts: int | None, device: str, inputs: Sequence[Any], outputs: Sequence[Any] = ()
) -> Callable[..., None]:
    """The same as a function, to be called often: on a CPU it packs the parameters once.

    It takes those that change, and are None at first, by name. With None for `parts` the kernel has no such
    parameters, and is launched once.
    """
    if device == DEFAULT_DEVICE:
        return PackedLaunch(kernel, parts, inputs, outputs).launch
    own = [[]] if parts is None else [[part, parts] for part in range(parts)]
    names = [argument.label for argument in kernel.adj.args[len(own[0]) :]]

    def launch(**changed: Any) -> None:
        given = [changed.get(name, value) for name, value in zip(names, [*inputs, *outputs], strict=True)]
        for first in own:
            wp.launch(kernel, 1, inputs=[*first, *given], device=device)

    return launch
