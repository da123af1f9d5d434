"""What a run shows of itself: a trace for Perfetto, counters and histograms, an endpoint for Prometheus."""

from __future__ import annotations

import http.server
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from ..dag import DataProcessComponent, Process
from ..dag.metrics import Metrics
from ..dag.replay import produced_topics
from ..dag.trace import Trace
from ..errors import ConfigError
from .pipeline import OBSTACLES_TOPIC, Pipeline

__all__ = ["MetricsServer", "Observer"]


class _Server(http.server.ThreadingHTTPServer):
    def handle_error(self, request: Any, client_address: Any) -> None:
        """Who breaks off is no news; the rest is."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class MetricsServer:
    """Answers `GET /metrics` in Prometheus' text format, on this machine alone."""

    def __init__(self, port: int, text: Callable[[], str]) -> None:
        """Begins to answer.

        Args:
            port: 0 takes a free one, which `port` tells.
            text: Makes the answer.

        Raises:
            ConfigError: The port is taken or not permitted.
        """

        class Handler(http.server.BaseHTTPRequestHandler):
            timeout = 5.0  # whoever connects and says nothing is let go of

            def do_GET(self) -> None:
                body = text().encode() if self.path.split("?")[0] == "/metrics" else b""
                self.send_response(200 if body else 404)
                self.send_header("Content-Type", "text/plain; version=0.0.4; charset=utf-8")
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, format: str, *args: object) -> None:
                pass

        try:
            self._server = _Server(("127.0.0.1", port), Handler)
        except (OSError, OverflowError) as error:
            raise ConfigError(f"port {port} cannot be used for metrics: {error}; take another, or 0 for any") from error
        self.port: int = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), name="metrics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Answers no more."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class Observer:
    """Watches a pipeline's run; a context manager that closes what it opened."""

    def __init__(self, pipeline: Pipeline, *, trace: Path | None = None, metrics_port: int | None = None) -> None:
        """Prepares; `watch` is given to `Pipeline.run`.

        Args:
            pipeline: Whose vertices are timed.
            trace: File for a trace that ui.perfetto.dev opens.
            metrics_port: Port of an endpoint for Prometheus on this machine; None: there is none.

        Raises:
            SinkError: The trace cannot be created.
            ConfigError: The port cannot be used.
        """
        self.metrics = Metrics()
        self.trace = Trace(trace, pipeline.profile.profile) if trace is not None else None
        pipeline.on_timing(self.metrics.on_timing)
        if self.trace is not None:
            pipeline.on_timing(self.trace.on_timing)
        self.server = MetricsServer(metrics_port, self.metrics.prometheus) if metrics_port is not None else None

    def watch(self, process: Process) -> None:
        """Watches the topics of a process that has not started."""
        produced = produced_topics(process)
        read = {handle.topic for component in process.components.values() for handle in component.inputs.values()}
        self.metrics.watch(process.mesh, sorted(produced | read))
        if self.trace is not None:
            # A frame is on its way from where it starts a component; what is only looked at, as a camera's, is none.
            starting = {
                component.inputs[name].topic
                for component in process.components.values()
                if isinstance(component, DataProcessComponent)
                for name in component.trigger_inputs
            }
            sources, results = starting - produced, produced & {OBSTACLES_TOPIC}
            others = (read | produced) - sources - results
            self.trace.watch(process.mesh, sorted(sources), sorted(results), sorted(others))

    def close(self) -> None:
        """Writes the trace to its end and closes the endpoint."""
        if self.server is not None:
            self.server.close()
        if self.trace is not None:
            self.trace.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
