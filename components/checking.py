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
from ..dag.launch.lookup import config_folders, find_launch_file
from ..errors import ConfigError
from .execution import ExecutionContext
from .messages import SensorFrame
from .pipeline import LIDAR_TOPIC, profile_modules, refuse_unknown
from .profile import CONF, execution_context, load_profile, profile_device

__all__ = ["FORMATS", "check_file", "draw_file"]

FORMATS = {"text": draw_text, "mermaid": draw_mermaid, "svg": draw_svg}
"""How a module can be drawn."""


def check_file(name: str, settings: Iterable[str] = ()) -> list[str]:
    """Validates a profile, a module or a launch file, with all the classes, models and settings it names.

    Args:
        name: The path of a file, or the name of a profile, a module or a launch file.
        settings: Changes by dotted key, as texts `key=value`.

    Returns:
        Lines that say what was found good.

    Raises:
        ConfigError: Something is wrong; the message names file, line, key, and what was expected.
        ModelError: A model does not fit its card.
        DeviceError: There is no such device.
    """
    path, kind = _find(name)
    if kind == "launch":
        return _check_launch(path, settings)
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


def _check_launch(path: Path, settings: Iterable[str]) -> list[str]:
    from .launching import plan_launch  # which is for Linux alone

    launch = plan_launch(str(path), settings=settings)
    plan = launch.plan
    lines = [f"{path}: node {plan.node!r} is good"]
    profile = plan.profile
    assert profile is not None  # there is always one
    context = execution_context(profile, profile_device(profile.content))
    for process, files in plan.modules.items():
        links = launch.links[process]
        Process(files, context=context, external=dict.fromkeys(links.imports, object), prepare=False)
        lines.append(f"  {process}: {len(files)} modules")
        lines += [f"    reads {topic} of another process" for topic in links.imports]
    return lines


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
        name: The path of a file, or the name of a module, a profile or a launch file; of a launch file its graphs.
        form: One of `FORMATS`.
        settings: Changes by dotted key, as texts `key=value`.

    Raises:
        ConfigError: Something is wrong in one of the files.
    """
    path, kind = _find(name, first="modules")
    changes = {tuple(key.split(".")): value for key, value in parse_overrides(settings).items()}
    if kind == "launch":
        from .launching import plan_launch

        modules = plan_launch(str(path), settings=settings).plan.modules
        files = [file for group in modules.values() for file in group if _has_graph(file)]
    elif kind == "profiles":
        files = profile_modules(load_profile(str(path)), changes)
    else:
        files = [load_module(path, changes)]
    for file in files:
        for index, component in enumerate(file.content.components):
            if component.graph:
                declare_vertices(file, ["components", index], component)
    return FORMATS[form](*(file.content for file in files))


def _has_graph(file: ConfigFile[ModuleSpec]) -> bool:
    return any(component.graph for component in file.content.components)


def _find(name: str, first: str = "profiles") -> tuple[Path, str]:
    """The file, and whether it belongs to the profiles, the modules or the launch files; `first` is searched first."""
    direct = Path(name)
    if direct.suffix in (".yaml", ".yml", ".xml"):
        if direct.is_file():
            return direct, _kind(direct)
        if direct.name != name or direct.suffix != ".xml":
            raise ConfigError(f"{direct}: there is no such file")
    second = "modules" if first == "profiles" else "profiles"
    told = []
    for kind in (first, second):
        try:
            return find_config(name, kind, CONF), kind
        except ConfigError as error:
            told.append(str(error))
    try:
        return find_launch_file(name, CONF), "launch"
    except ConfigError as error:
        raise ConfigError("; ".join([*told, str(error)])) from None


def _kind(path: Path) -> str:
    """What a file is, by its first keys."""
    if path.suffix == ".xml":
        return "launch"
    text = path.read_text(encoding="utf-8", errors="replace")
    top = {line.partition(":")[0] for line in text.splitlines() if line[:1].isalpha()}
    for key, kind in (("processes", "launch"), ("profile", "profiles"), ("module", "modules")):
        if key in top:
            return kind
    raise ConfigError(
        f"{path}:1: has neither a key 'profile' nor a key 'module' nor a key 'processes', so it is not of a known kind"
    )
