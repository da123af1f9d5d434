"""A component whose work is not part of this version, or whose hardware is not there: it says so, and what it needs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field

from ...dag import Component, ProcessorConfig
from ...datamesh import DataMesh
from ..execution import ExecutionContext

__all__ = ["IdleComponent", "IdleConfig"]

Kind = Literal["lidar", "camera", "radar", "gnss", "imu", "wheel"]


class IdleConfig(ProcessorConfig):
    """What the component will do, and what it waits for."""

    purpose: str = Field(min_length=1)
    """What it does once all is there, in one line."""
    missing: str = Field(min_length=1)
    """What is not there, such as `a driver for GNSS receivers`."""
    sensors: dict[Kind, int] = Field(default_factory=dict)
    """How many sensors of each kind it serves; 0 is any number."""
    model: str | None = None
    """The type of these sensors."""
    topics: tuple[str, ...] = ()
    """Topics that it will read."""


class IdleComponent(Component):
    """Holds the place of a component of the node: checks the sensors that it is for, watches for its topics."""

    Config = IdleConfig
    context: ExecutionContext | None

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._mesh: DataMesh | None = None
        self._config = IdleConfig(purpose=name, missing="its configuration")
        self._named: dict[str, tuple[str, ...]] = {}

    def bind(self, mesh: DataMesh, topics: Mapping[str, str]) -> None:
        """Keeps the mesh, to see which topics there are."""
        super().bind(mesh, topics)
        self._mesh = mesh

    def check(self, config: IdleConfig) -> None:
        """Compares what it is for with the sensors of the profile.

        Raises:
            ValueError: The profile names another number of these sensors, or sensors of another type.
        """
        self._config = config
        profile = self.context or ExecutionContext()
        for kind, wanted in config.sensors.items():
            names = tuple(profile.sensor_kinds.get(kind, ()))
            self._named[kind] = names
            if names and wanted and len(names) != wanted:
                raise ValueError(
                    f"sensors: this is for {wanted} of kind {kind}, but the profile names {len(names)}: "
                    f"{', '.join(names)}; name as many, or take the module file for them"
                )
            for name in names:
                model = getattr(profile.sensors.get(name), "model", None)
                if config.model and model and model != config.model:
                    raise ValueError(f"model: this is for {config.model}, but the profile says {name} is a {model}")

    @property
    def idle_because(self) -> str:
        """What is missing, and which sensors and topics it waits for."""
        config = self._config
        parts = [f"{config.missing} is not there"]
        for kind, names in self._named.items():
            if not names:
                parts.append(f"the profile names no {kind}")
        there = self._topics_with_data()
        absent = [topic for topic in config.topics if topic not in there]
        if absent:
            parts.append(f"waits for {', '.join(absent)}")
        if there:
            parts.append(f"{', '.join(there)} has data already")
        return "; ".join(parts)

    def state(self) -> Mapping[str, str | float | int]:
        """Its purpose, and the sensors and topics that it waits for."""
        state: dict[str, str | float | int] = {"purpose": self._config.purpose}
        for kind, names in self._named.items():
            wanted = self._config.sensors[kind]  # type: ignore[index]
            state[kind] = f"{len(names)} of {wanted}" if wanted else len(names)
        if self._config.topics:
            state["topics with data"] = f"{len(self._topics_with_data())} of {len(self._config.topics)}"
        return state

    def _topics_with_data(self) -> list[str]:
        if self._mesh is None:
            return []
        known = set(self._mesh.topics())
        return [t for t in self._config.topics if t in known and len(self._mesh.window(t).snapshot())]
