"""Hardware profiles: device, capacities, sensors, models, and the modules that run on them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from ..dag import ConfigFile, find_config
from .execution import ExecutionContext

__all__ = ["CONF", "LidarSpec", "ModelsSpec", "Profile", "ThreadsSpec", "load_profile"]

CONF = Path(__file__).resolve().parent.parent / "conf"
"""The configuration that ships with the package."""


SensorKind = Literal["lidar", "camera", "radar", "gnss", "imu", "wheel"]


class _Spec(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ThreadsSpec(_Spec):
    """How many threads each consumer of the CPU has."""

    inference: int = Field(2, ge=1, le=64)
    """Of a detection head on a CPU."""


class LidarSpec(_Spec):
    """The main LiDAR."""

    mounting_height: float | None = Field(None, gt=0.0, lt=20.0)
    """Height above the ground [m]; left out, it is estimated in each frame."""


class ModelsSpec(_Spec):
    """The models, by their cards."""

    detector: str | None = None
    """Card of the detection head, a path relative to the profile; left out, the shipped one."""


class Profile(_Spec):
    """What the hardware is, and what runs on it."""

    profile: str
    """Its name."""
    description: str = ""
    device: str = "cpu"
    """The Warp device of the kernels: cpu, cuda:0 …"""
    capacity: int = Field(200_000, ge=1, le=16_000_000)
    """Points of a cloud that there is room for; further ones are dropped, and counted."""
    latency_budget_ms: float = Field(100.0, gt=0.0)
    """From the reception of a LiDAR frame to the commit of its obstacles [ms]."""
    threads: ThreadsSpec = ThreadsSpec()
    lidar: LidarSpec = LidarSpec()
    sensors: dict[SensorKind, list[str]] = {}
    """Names of the sensors by kind; the placeholders of module files stand for them."""
    models: ModelsSpec = ModelsSpec()
    modules: list[str] = Field(min_length=1)
    """Module files, by name or path."""
    settings: dict[str, Any] = {}
    """Changes to the modules, by dotted key: `component.vertex.key`."""
    check: bool = False
    """Whether payloads are compared with what they were at their commit; reads every byte, for tests."""


def load_profile(name: str, changes: Mapping[tuple[str, ...], Any] | None = None) -> ConfigFile[Profile]:
    """Reads a profile.

    Args:
        name: Of a shipped profile, or the path of a file.
        changes: Values that replace those of the file, by the path of their keys.

    Raises:
        ConfigError: There is none of that name, or it is bad.
    """
    return ConfigFile(find_config(name, "profiles", CONF), Profile, dict(changes or {}))


def execution_context(file: ConfigFile[Profile], device: str) -> ExecutionContext:
    """The context in which the modules of a profile run, on a device that was found to exist."""
    profile = file.content
    detector = profile.models.detector
    return ExecutionContext(
        device=device,
        capacity=profile.capacity,
        mounting_height=profile.lidar.mounting_height,
        inference_threads=profile.threads.inference,
        detector=(file.path.parent / detector) if detector is not None else None,
    )
