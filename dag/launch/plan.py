"""The plan of a launch: everything that is to run, read and validated before anything starts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ..configuration import ConfigFile
from ..schema import ModuleSpec
from .schema import LaunchSpec, ProcessSpec

__all__ = ["LaunchPlan"]


@dataclass(frozen=True)
class LaunchPlan:
    """A launch file, the profile, and the modules of each process."""

    file: ConfigFile[LaunchSpec]
    """The launch file, with what the command line changed."""
    modules: Mapping[str, tuple[ConfigFile[ModuleSpec], ...]]
    """The module files, by the name of their process; settings and the sensors of the profile are in them."""
    profile: ConfigFile[Any] | None = None
    """The hardware profile; its schema is known to who made the plan. None: there is none."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Changes by dotted key, from the command line and the environment."""

    @property
    def spec(self) -> LaunchSpec:
        """What the launch file says."""
        return self.file.content

    @property
    def node(self) -> str:
        """The name of the node."""
        return self.file.content.node

    @property
    def processes(self) -> Mapping[str, ProcessSpec]:
        """The processes by name."""
        return {process.name: process for process in self.spec.processes}
