"""Topics between hosts, over zenoh."""

from __future__ import annotations

from typing import Any

from ...errors import ConfigError
from ..window import Window
from .config import ZenohConfig

__all__ = ["ZenohSession"]


class ZenohSession:
    """The connection of a process to the zenoh network."""

    def __init__(self, config: ZenohConfig, *, node: str, name: str) -> None:
        """Connects.

        Raises:
            ConfigError: It cannot.
        """
        raise ConfigError(f"{name} of {node}: topics between hosts are not there yet ({config.mode})")

    def exporter(self, window: Window[Any]) -> Any:
        """Sends a topic."""

    def importer(self, window: Window[Any]) -> Any:
        """Receives a topic."""

    def close(self) -> None:
        """Ends it."""
