"""Sets up the compute device of the process: its memory pool, and that it works at all."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import Field

from ...dag import Component, ProcessorConfig
from ...errors import DeviceError
from ..execution import ExecutionContext

__all__ = ["GpuSetup", "GpuSetupConfig"]


class GpuSetupConfig(ProcessorConfig):
    """How a GPU is used."""

    memory_pool: bool = True
    """Whether memory is taken from CUDA's pool, where the driver has one: an allocation then costs no wait."""
    keep_mib: int = Field(256, ge=0, le=1 << 20)
    """How much of the pool stays with the process when it is free [MiB]."""


class GpuSetup(Component):
    """Prepares the GPU of the profile before the first frame; on a CPU there is nothing to set up."""

    Config = GpuSetupConfig
    context: ExecutionContext | None

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._config = GpuSetupConfig()
        self._state: dict[str, str | float | int] = {}

    @property
    def _device(self) -> str:
        return self.context.device if self.context is not None else "cpu"

    def init(self, config: GpuSetupConfig) -> None:
        """Keeps how."""
        self._config = config

    def start(self) -> None:
        """Sets the pool, and runs one copy to the device and back.

        Raises:
            DeviceError: The device does not answer.
        """
        self._state = {"device": self._device}
        if self._device == "cpu":
            return
        import numpy as np
        import warp as wp

        device = wp.get_device(self._device)
        pooled = bool(device.is_mempool_supported)
        if pooled:
            wp.set_mempool_enabled(device, self._config.memory_pool)
            if self._config.memory_pool:
                wp.set_mempool_release_threshold(device, self._config.keep_mib << 20)
        sent = np.arange(1024, dtype=np.float32)
        try:
            back = wp.array(sent, dtype=wp.float32, device=device).numpy()
        except RuntimeError as error:
            raise DeviceError(f"{self._device} does not answer: {error}") from error
        if not np.array_equal(sent, back):
            raise DeviceError(f"{self._device} gives back other bytes than it was given: its memory is not sound")
        self._state |= {
            "name": device.name,
            "memory_mib": round(device.total_memory / 2**20),
            "free_mib": round(device.free_memory / 2**20),
            "memory pool": "on" if pooled and self._config.memory_pool else "off",
        }

    @property
    def idle_because(self) -> str | None:
        """The profile computes on the CPU."""
        return "the profile's device is the CPU" if self._device == "cpu" else None

    def state(self) -> Mapping[str, str | float | int]:
        """The device and its memory at the start."""
        return dict(self._state)
