"""Module files: read, with the sensors of a profile in the place of their names, and with settings from outside."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ..errors import ConfigError
from .configuration import ConfigFile, nearest
from .placeholders import expand_sensors
from .schema import ComponentSpec, ModuleSpec

__all__ = ["load_module", "module_changes"]


def load_module(
    path: Path,
    changes: Mapping[tuple[str, ...], Any] | None = None,
    sensors: Mapping[str, Sequence[str]] | None = None,
) -> ConfigFile[ModuleSpec]:
    """Reads and validates a module file.

    Args:
        path: The file.
        changes: Settings by (component, …, key); those for components that are not in the file are left out.
        sensors: For the placeholders in it, as `dag.placeholders` explains.

    Raises:
        ConfigError: The file is bad.
    """
    expand = partial(expand_sensors, sensors=sensors)
    file = ConfigFile(path, ModuleSpec, expand=expand)
    placed = module_changes(file.content, changes or {})
    return ConfigFile(path, ModuleSpec, placed, expand=expand) if placed else file


def module_changes(module: ModuleSpec, changes: Mapping[tuple[str, ...], Any]) -> dict[tuple[str | int, ...], Any]:
    """Settings by the user's keys, made into keys of the file.

    `component.vertex.key` is a key of the vertex's configuration, `component.key` one of the component's configuration
    or, where the component's schema has it (`workers`, `in_flight`, `backlog` …), of the component.
    """
    placed: dict[tuple[str | int, ...], Any] = {}
    for keys, value in changes.items():
        for index, component in enumerate(module.components):
            if len(keys) < 2 or component.name != keys[0]:
                continue
            if keys[1] in component.graph and len(keys) > 2:
                place: tuple[str, ...] = ("graph", keys[1], "config", *keys[2:])
            elif keys[1] in {field.alias or name for name, field in ComponentSpec.model_fields.items()}:
                place = keys[1:]
            elif component.graph:
                raise ConfigError(
                    f"setting {'.'.join(keys)}: component {component.name!r} has no vertex {keys[1]!r}; "
                    f"{nearest(keys[1], component.graph)}"
                )
            else:
                place = ("config", *keys[1:])
            placed["components", index, *place] = value
    return placed
