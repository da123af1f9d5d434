"""What first calls cost, in a process of their own: `python -m warploom.bench.first_calls [BACKEND]`."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

__all__ = ["first_calls"]


def first_calls(backend: str = "warp") -> dict[str, tuple[float, float]]:
    """Seconds of the first and the second call of functions of the API, on a small cloud on the CPU.

    Args:
        backend: `warp`, or `taichi`, which has fewer of them.
    """
    import warploom as wl

    points = np.random.default_rng(0).uniform((-20, -20, -2, 0), (20, 20, 2, 1), (5000, 4)).astype(np.float32)
    box = (-20.0, -20.0, -2.0, 20.0, 20.0, 2.0)
    labels = np.arange(len(points), dtype=np.int32) % 20
    calls: dict[str, Callable[[], Any]] = {
        "filter_points": lambda: wl.filter_points(points, point_range=box),
        "segment_ground": lambda: wl.segment_ground(points),
        "cluster": lambda: wl.cluster(points, 0.5),
        "fit_boxes": lambda: wl.fit_boxes(points, labels),
        "voxelize": lambda: wl.voxelize(points, 0.5, box),
        "voxel_downsample": lambda: wl.voxel_downsample(points, 0.5),
        "bev": lambda: wl.bev(points, box, (80, 80)),
    }

    if backend != "warp":
        calls = {
            "segment_ground": lambda: wl.segment_ground(points, backend=backend),
            "cluster": lambda: wl.cluster(points, 0.5, backend=backend),
            "voxelize": lambda: wl.voxelize(points, 0.5, box, backend=backend),
            "bev": lambda: wl.bev(points, box, (80, 80), backend=backend),
        }

    def seconds(call: Callable[[], Any]) -> float:
        start = time.perf_counter()
        call()
        return time.perf_counter() - start

    return {name: (seconds(call), seconds(call)) for name, call in calls.items()}


if __name__ == "__main__":
    json.dump(first_calls(*sys.argv[1:]), sys.stdout)
