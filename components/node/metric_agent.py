"""The metric agent: answers Prometheus on this machine, where a port is given."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from pydantic import Field

from ...dag import Component, ProcessorConfig
from ...dag.metrics import Metrics
from ...datamesh import DataMesh
from ...errors import ConfigError
from ..execution import ExecutionContext
from ..observing import MetricsServer

__all__ = ["MetricAgent", "MetricAgentConfig"]

_log = logging.getLogger(__name__)


class MetricAgentConfig(ProcessorConfig):
    """Where it answers."""

    port: int | None = Field(None, ge=0, le=65535)
    """Of 127.0.0.1; 0 takes a free one; null: it does not answer."""


class MetricAgent(Component):
    """Collects commits, latencies, losses and the times of vertices, and gives them to who asks.

    A port that cannot be had costs the metrics and nothing else.
    """

    Config = MetricAgentConfig
    context: ExecutionContext | None

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._mesh: DataMesh | None = None
        self._config = MetricAgentConfig()
        self._metrics = Metrics()
        self._server: MetricsServer | None = None
        self._failure: str | None = None

    def bind(self, mesh: DataMesh, topics: Mapping[str, str]) -> None:
        """Keeps the mesh whose topics it watches."""
        super().bind(mesh, topics)
        self._mesh = mesh

    def init(self, config: MetricAgentConfig) -> None:
        """Keeps the port."""
        self._config = config

    def start(self) -> None:
        """Begins to count and to answer."""
        if self._config.port is None:
            return
        assert self._mesh is not None
        new = [topic for topic in self._mesh.topics() if topic not in self._metrics.latency]
        self._metrics.watch(self._mesh, new)
        if self.context is not None:
            self.context.timings.watch(self._metrics.on_timing)
        try:
            self._server = MetricsServer(self._config.port, self._metrics.prometheus)
            self._failure = None
        except ConfigError as error:
            self._failure = str(error)
            _log.error("%s: %s", self.name, error)

    def stop(self) -> None:
        """Answers no more."""
        if self.context is not None:
            self.context.timings.forget(self._metrics.on_timing)
        server, self._server = self._server, None
        if server is not None:
            server.close()

    @property
    def idle_because(self) -> str | None:
        """No port is given, or it cannot be had."""
        if self._config.port is None:
            return f"no port is given: set {self.name}.port, 0 for any that is free"
        return self._failure

    def state(self) -> Mapping[str, str | float | int]:
        """Where it answers."""
        return {"metrics": f"http://127.0.0.1:{self._server.port}/metrics"} if self._server is not None else {}
