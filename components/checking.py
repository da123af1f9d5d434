"""Validates configuration files, and draws them, without running them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ..dag import Process, draw_mermaid, draw_svg, draw_text, find_config, load_module, parse_overrides
from ..dag.graph import declare_vertices
from ..errors import ConfigError
from .execution import ExecutionContext
from .messages import SensorFrame
from .pipeline import LIDAR_TOPIC, Pipeline, profile_modules
from .profile import CONF, load_profile

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
    if kind == "profiles":
        pipeline = Pipeline.from_profile(str(path), settings=settings)
        profile = pipeline.profile
        pipeline.close()
        return [
            f"{path}: profile {profile.profile!r} is good",
            f"  device {pipeline.device}, modules {profile.modules}",
        ]
    changes = {tuple(key.split(".")): value for key, value in parse_overrides(settings).items()}
    file = load_module(path, changes)
    Process([file], context=ExecutionContext(), external={LIDAR_TOPIC: SensorFrame})
    components = file.content.components
    lines = [f"{path}: module {file.content.module!r} is good"]
    lines += [f"  {component.name} ({component.kind}), {len(component.graph)} vertices" for component in components]
    return lines


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
