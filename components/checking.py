"""Validates configuration files, and draws them, without running them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ..dag import (
    ConfigFile,
    ModuleSpec,
    Process,
    draw_mermaid,
    draw_svg,
    draw_text,
    find_config,
    load_module,
    parse_overrides,
)
from ..dag.graph import declare_vertices
from ..dag.launch.lookup import config_folders
from ..errors import ConfigError
from .execution import ExecutionContext
from .messages import SensorFrame
from .pipeline import LIDAR_TOPIC, profile_modules, refuse_unknown
from .profile import CONF, execution_context, load_profile, profile_device

__all__ = ["FORMATS", "check_file", "draw_file"]

FORMATS = {"text": draw_text, "mermaid": draw_mermaid, "svg": draw_svg}
"""How a module can be drawn."""


def check_file(name: str, settings: Iterable[str] = ()) -> list[str]:
    """Validates a profile or a module file, with all the classes, models and settings it names.

    Args:
        name: The path of a YAML file, or the name of a profile or a module.
        settings: Changes by dotted key, as texts `key=value`.

    Returns:
        Lines that say what was found good.

    Raises:
        ConfigError: Something is wrong; the message names file, line, key, and what was expected.
        ModelError: A model does not fit its card.
        DeviceError: There is no such device.
    """
    path, kind = _find(name)
    changes = {tuple(key.split(".")): value for key, value in parse_overrides(settings).items()}
    if kind == "profiles":
        return _check_profile(path, changes)
    file = load_module(path, changes)
    components = file.content.components
    elsewhere = _topics_elsewhere(file)
    Process(
        [file],
        context=ExecutionContext(),
        external={LIDAR_TOPIC: SensorFrame} | dict.fromkeys(elsewhere, object),
        prepare=False,
    )
    lines = [f"{path}: module {file.content.module!r} is good"]
    lines += [f"  {component.name} ({component.kind}), {len(component.graph)} vertices" for component in components]
    lines += [f"  reads {topic}, which {module} gives" for topic, module in elsewhere.items()]
    return lines


def _check_profile(path: Path, changes: Mapping[tuple[str, ...], Any]) -> list[str]:
    of_profile = {keys[1:]: value for keys, value in changes.items() if keys[0] == "profile"}
    of_modules = {keys: value for keys, value in changes.items() if keys[0] != "profile"}
    file = load_profile(str(path), of_profile)
    profile = file.content
    modules = profile_modules(file, of_modules)
    refuse_unknown(of_modules, modules)
    device = profile_device(profile)
    Process(modules, context=execution_context(file, device), external={LIDAR_TOPIC: SensorFrame}, prepare=False)
    return [f"{path}: profile {profile.profile!r} is good", f"  device {device}, modules {profile.modules}"]


def _topics_elsewhere(file: ConfigFile[ModuleSpec]) -> dict[str, str]:
    """Topics that a module reads and does not give, but another module file gives, and the name of that module."""
    components = file.content.components
    given = {topic for component in components for topic in component.outputs.values()} | {LIDAR_TOPIC}
    wanted = {topic for component in components for topic in component.inputs.values()} - given
    found: dict[str, str] = {}
    if not wanted:
        return found
    for folder in config_folders(CONF):
        for path in sorted((folder / "modules").rglob("*.yaml")):
            try:
                module = load_module(path).content
            except ConfigError:  # it is another file's mistake
                continue
            for component in module.components:
                for topic in wanted & set(component.outputs.values()):
                    found.setdefault(topic, module.module)
    return found


def draw_file(name: str, form: str = "text", settings: Iterable[str] = ()) -> str:
    """Draws a module file, or all the modules of a profile.

    Args:
        name: The path of a YAML file, or the name of a module or a profile.
        form: One of `FORMATS`.
        settings: Changes by dotted key, as texts `key=value`.

    Raises:
        ConfigError: Something is wrong in one of the files.
    """
    path, kind = _find(name, first="modules")
    changes = {tuple(key.split(".")): value for key, value in parse_overrides(settings).items()}
    if kind == "profiles":
        files = profile_modules(load_profile(str(path)), changes)
    else:
        files = [load_module(path, changes)]
    for file in files:
        for index, component in enumerate(file.content.components):
            if component.graph:
                declare_vertices(file, ["components", index], component)
    return FORMATS[form](*(file.content for file in files))


def _find(name: str, first: str = "profiles") -> tuple[Path, str]:
    """The file, and whether it belongs to the profiles or the modules; a name is looked for in `first` first."""
    direct = Path(name)
    if direct.suffix in (".yaml", ".yml"):
        if not direct.is_file():
            raise ConfigError(f"{direct}: there is no such file")
        text = direct.read_text(encoding="utf-8", errors="replace")
        top = {line.partition(":")[0] for line in text.splitlines() if line[:1].isalpha()}
        if "profile" in top:
            return direct, "profiles"
        if "module" in top:
            return direct, "modules"
        raise ConfigError(f"{direct}:1: has neither a key 'profile' nor a key 'module', so it is not of a known kind")
    second = "modules" if first == "profiles" else "profiles"
    try:
        return find_config(name, first, CONF), first
    except ConfigError as error:
        try:
            return find_config(name, second, CONF), second
        except ConfigError as other:
            raise ConfigError(f"{error}; {other}") from None
