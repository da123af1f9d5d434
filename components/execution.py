"""The execution context: what a profile gives to every component and processor of a process."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..dag import VertexTiming

if TYPE_CHECKING:
    import warp as wp

    from ..datamesh import Completion

__all__ = ["ExecutionContext", "Timings", "empty_cloud"]


class Timings:
    """Hands the timings of a process's vertices to whoever watches; it is the process's `on_timing`."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._watchers: tuple[Callable[[VertexTiming], None], ...] = ()

    def __call__(self, timing: VertexTiming) -> None:
        """Takes the timing of one run."""
        for watcher in self._watchers:
            watcher(timing)

    def watch(self, callback: Callable[[VertexTiming], None]) -> None:
        """Calls back after every run of a vertex, in the thread that ran it."""
        with self._lock:
            self._watchers = (*self._watchers, callback)

    def forget(self, callback: Callable[[VertexTiming], None]) -> None:
        """Calls back no more."""
        with self._lock:
            self._watchers = tuple(one for one in self._watchers if one != callback)


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
    precision: str = "fp32"
    """What a detection head on a GPU computes in: fp32, tf32 or fp16."""
    detector: Path | None = None
    """Card of the detection head; None is the shipped one."""
    backends: Mapping[str, str] = field(default_factory=dict)
    """Which library computes a kernel, by its name, where that is not Warp and the module file does not say."""
    sensors: Mapping[str, Any] = field(default_factory=dict)
    """The sensors of the profile by name: each a `profile.SensorSpec`."""
    sensor_kinds: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Names of the sensors by kind."""
    latency_budget_ms: float = 100.0
    """From the reception of a LiDAR frame to the commit of its obstacles [ms]."""
    handover: Path | None = None
    """Where components leave what their next life goes on with, should the process be killed; None: nowhere."""
    timings: Timings = field(default_factory=Timings, compare=False)
    """Tells the runs of vertices, if the process was built with it as its `on_timing`."""

    @property
    def stream(self) -> wp.Stream | None:
        """Where processors launch, and read what others wrote on the device; None on a CPU."""
        import warp as wp

        device = wp.get_device(self.device)
        return wp.get_stream(device) if device.is_cuda else None

    def completion(self) -> Completion | None:
        """The event after which what was launched so far is written; None on a CPU."""
        from .completion import completion_on

        return completion_on(self.device)


def empty_cloud(device: str) -> tuple[wp.array, wp.array]:
    """No points, and their count: a stage runs on them when it is made, so that its kernels are compiled and loaded.

    Returns:
        Positions with room for one point, vec3, and the count zero, int32, both on `device`.
    """
    import warp as wp

    return wp.zeros(1, dtype=wp.vec3, device=device), wp.zeros(1, dtype=wp.int32, device=device)
