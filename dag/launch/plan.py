"""The plan of a launch: everything that is to run, read and validated before anything starts."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...errors import ConfigError
from ..configuration import ConfigFile, find_config, nearest
from ..modules import load_module
from ..schema import ModuleSpec
from .lookup import config_folders
from .schema import LaunchSpec, ProcessSpec

if TYPE_CHECKING:
    from ...datamesh.transport import ZenohConfig
    from .linking import LinkPlan

__all__ = ["LaunchPlan", "plan_modules", "plan_zenoh"]

Changes = Mapping[tuple[str, ...], Any]


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


def plan_modules(
    file: ConfigFile[LaunchSpec],
    shipped: Path,
    *,
    sensors: Mapping[str, Sequence[str]] | None = None,
    changes: Changes | None = None,
    defaults: Changes | None = None,
) -> dict[str, tuple[ConfigFile[ModuleSpec], ...]]:
    """Reads the module files of all processes.

    Args:
        file: The launch file.
        shipped: The conf folder of the package, searched last.
        sensors: Names by kind, for the placeholders in the modules.
        changes: Settings by the parts of their dotted keys; they go before those of the launch file.
        defaults: The same, of a profile; those of the launch file go before them. One for a component that is in none
            of the modules is left out.

    Raises:
        ConfigError: A module is not there, or bad, or stands twice in a process; a setting is for no component.
    """
    own = {tuple(key.split(".")): value for key, value in file.content.settings.items()}
    changes = changes or {}
    merged = {**(defaults or {}), **own, **changes}
    modules: dict[str, tuple[ConfigFile[ModuleSpec], ...]] = {}
    for number, process in enumerate(file.content.processes):
        files: list[ConfigFile[ModuleSpec]] = []
        for index, name in enumerate(process.modules):
            keys = ["processes", number, "modules", index]
            try:
                path = _module_path(file.path.parent, name, shipped)
            except ConfigError as error:
                raise file.error(keys, str(error)) from None
            if path.resolve() in [one.path.resolve() for one in files]:
                raise file.error(keys, f"the module file {name!r} stands twice in process {process.name!r}")
            files.append(load_module(path, merged, sensors))
        modules[process.name] = tuple(files)
    known = {component.name for files in modules.values() for one in files for component in one.content.components}
    for key in own:
        if key[0] not in known:
            raise file.error(["settings", ".".join(key)], f"no component {key[0]!r}; {nearest(key[0], known)}")
    for key in changes:
        if key[0] not in known:
            raise ConfigError(
                f"setting {'.'.join(key)}: no component {key[0]!r}; {nearest(key[0], {*known, 'profile', 'launch'})}"
            )
    return modules


def plan_zenoh(plans: Mapping[str, LinkPlan], zenoh: ZenohConfig) -> dict[str, ZenohConfig]:
    """How each process of a node joins the network.

    At an endpoint one process can listen: the first that has topics between hosts. The others connect to it there, and
    zenoh's gossip makes them known to whoever does so too; what they send does not go through it.

    Args:
        plans: The links of all processes.
        zenoh: What the launch file says.
    """
    first = next((name for name, plan in plans.items() if plan.remote), None)
    other = zenoh
    if zenoh.mode == "peer" and zenoh.listen:
        other = zenoh.model_copy(update={"connect": (*zenoh.connect, *zenoh.listen), "listen": ()})
    return {name: zenoh if name == first else other for name in plans}


def _module_path(beside: Path, name: str, shipped: Path) -> Path:
    """A module file: beside the launch file, or wherever configuration lies."""
    path = beside / name
    if path.suffix in (".yaml", ".yml") and os.path.isfile(path):
        return path
    try:
        return find_config(name, "modules", shipped)
    except ConfigError:
        folders = [folder / "modules" for folder in config_folders(shipped)]
        known = {str(one.relative_to(folder)) for folder in folders for one in folder.rglob("*.yaml")}
        raise ConfigError(f"no module file {name!r}: neither a path nor a name; {nearest(name, known)}") from None
