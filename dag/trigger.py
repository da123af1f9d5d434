"""What starts a run: the version of the frame, and when its sensor data was received."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Trigger"]


@dataclass(frozen=True, slots=True)
class Trigger:
    """One event that a component runs for."""

    version: int
    """Version of the frame [ns]; frame data is read at exactly this version."""
    received_ns: int = 0
    """`time.perf_counter_ns` when the sensor's data was received: latency counts from here."""
    settled: bool = False
    """True: there will be nothing at this version; the component passes that on instead of running."""
