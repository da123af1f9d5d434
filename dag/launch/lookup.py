"""Launch files: found by name, or by the hardware that their header names, and read."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from ...errors import ConfigError
from ..configuration import ConfigFile, nearest, override
from .schema import HardwareSpec, LaunchSpec
from .xml import XmlLaunchFile

__all__ = [
    "CommandLine",
    "config_folders",
    "find_by_hardware",
    "find_launch_file",
    "launch_files",
    "load_launch_file",
]

_ENDINGS = (".launch.yaml", ".launch.yml", ".launch.xml")


def config_folders(shipped: Path) -> list[Path]:
    """Where configuration is searched: `./conf`, `$WARPLOOM_CONF`, the package."""
    own = os.environ.get("WARPLOOM_CONF")
    return [Path("conf"), *([Path(own)] if own else []), shipped]


def launch_files(shipped: Path) -> dict[str, Path]:
    """The launch files that there are, by name: in `./conf/launch`, `$WARPLOOM_CONF/launch` and the package's.

    Args:
        shipped: The conf folder of the package. Of two files of one name the one in the folder before it counts.
    """
    found: dict[str, Path] = {}
    for folder in config_folders(shipped):
        for ending in _ENDINGS:
            for path in sorted((folder / "launch").glob(f"*{ending}")):
                found.setdefault(path.name.removesuffix(ending), path)
    return found


def find_launch_file(name: str, shipped: Path) -> Path:
    """A launch file by its path or its name.

    Raises:
        ConfigError: There is none; the message lists those that are.
    """
    direct = Path(name)
    if direct.suffix in (".yaml", ".yml", ".xml"):
        if os.path.isfile(direct):
            return direct
        if direct.name != name:
            raise ConfigError(f"{direct}: there is no such file")
    known = launch_files(shipped)
    bare = next((name.removesuffix(ending) for ending in (*_ENDINGS, ".yaml", ".xml") if name.endswith(ending)), name)
    if bare not in known:
        raise ConfigError(f"no launch file {name!r}: neither a file nor a name; {nearest(bare, known)}")
    return known[bare]


def find_by_hardware(wanted: Mapping[str, str], shipped: Path) -> Path:
    """The one launch file whose `hardware:` header has all that is wanted; its name does not matter.

    Args:
        wanted: Such as `{"hw": "hw50", "lidar": "pandar90"}`.
        shipped: The conf folder of the package.

    Raises:
        ConfigError: None fits, or several do; the message lists what exists.
    """
    headers: dict[Path, HardwareSpec] = {}
    unreadable: list[str] = []
    for path in launch_files(shipped).values():
        try:
            header = _header(path)
        except ConfigError as error:
            unreadable.append(str(error))
            continue
        if header is not None:
            headers[path] = header
    fitting = [path for path, header in headers.items() if all(getattr(header, k) == v for k, v in wanted.items())]
    if len(fitting) == 1:
        return fitting[0]
    asked = HardwareSpec(**wanted).described()
    if fitting:
        options = "\n".join(f"  {headers[path].described()}   ({path})" for path in fitting)
        raise ConfigError(f"{asked} fits {len(fitting)} launch files; say more, so that one is left:\n{options}")
    lines = [f"no launch file is for {asked}; there are:"]
    lines += [f"  {header.described()}   ({path})" for path, header in headers.items()] or ["  none"]
    for name, value in wanted.items():
        known = {getattr(header, name) for header in headers.values()} - {None, value}
        if value not in {getattr(header, name) for header in headers.values()}:
            lines.append(f"--{name} {value}: {nearest(value, known)}")
    lines += [f"not readable: {why}" for why in unreadable]
    raise ConfigError("\n".join(lines))


def _header(path: Path) -> HardwareSpec | None:
    """What a file's `hardware:` says; None where it has none. What else is in it need not be right."""
    if path.suffix == ".xml":
        return XmlLaunchFile(path).content.hardware
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
        hardware = data.get("hardware") if isinstance(data, dict) else None
        return None if hardware is None else HardwareSpec.model_validate(hardware)
    except (OSError, UnicodeDecodeError, yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: {str(error).splitlines()[0]}") from error


def load_launch_file(path: Path, changes: Mapping[tuple[str | int, ...], Any] | None = None) -> ConfigFile[LaunchSpec]:
    """Reads and validates a launch file, YAML or XML by its ending.

    Args:
        path: The file.
        changes: Values that replace those of the file, by the path of their keys; a process goes by its number or name.

    Raises:
        ConfigError: It is bad; the message names the file, the line, the key, what was expected and the nearest name.
    """
    file = _read(path, None)
    names: dict[str, int] = {}
    for index, process in enumerate(file.content.processes):
        if process.name in names:
            raise file.error(["processes", index, "name"], f"there is a process {process.name!r} already")
        names[process.name] = index
    if not changes:
        return file
    placed: dict[tuple[str | int, ...], Any] = {}
    for keys, value in changes.items():
        if len(keys) > 1 and keys[0] == "processes" and not str(keys[1]).isdecimal():
            if keys[1] not in names:
                raise ConfigError(
                    f"setting launch.{'.'.join(map(str, keys))}: no process {keys[1]!r}; {nearest(str(keys[1]), names)}"
                )
            keys = (keys[0], names[str(keys[1])], *keys[2:])
        placed[keys] = value
    return _read(path, placed)


class CommandLine(ConfigFile[LaunchSpec]):
    """A launch file that is not one: the modules of one process, as the command line names them."""

    def __init__(
        self, process: str, modules: Sequence[str], changes: Mapping[tuple[str | int, ...], Any] | None = None
    ):
        """Makes the node, called as its process.

        Args:
            process: Name of the process.
            modules: Its module files.
            changes: Values for further keys, by their path.

        Raises:
            ConfigError: The name is not one, or a change does not fit.
        """
        self.path = Path("command line")
        self._changes = ()
        data: dict[str, Any] = {"node": process, "processes": [{"name": process, "modules": list(modules)}]}
        for keys, value in (changes or {}).items():
            override(data, [0 if key == process and depth == 1 else key for depth, key in enumerate(keys)], value)
        try:
            self.content = LaunchSpec.model_validate(data)
        except ValidationError as error:
            raise ConfigError("\n".join(dict.fromkeys(self._explain(error, LaunchSpec)))) from error

    def line(self, keys: Sequence[str | int]) -> int:
        """There are no lines."""
        return 1

    def error(self, keys: Sequence[str | int], message: str) -> ConfigError:
        """An error about a part of the command line."""
        if len(keys) == 4 and keys[2] == "modules":
            return ConfigError(f"-c {self.content.processes[0].modules[int(keys[3])]}: {message}")
        return ConfigError(f"command line: {'.'.join(map(str, keys))}: {message}")


def _read(path: Path, changes: Mapping[tuple[str | int, ...], Any] | None) -> ConfigFile[LaunchSpec]:
    return XmlLaunchFile(path, changes) if path.suffix == ".xml" else ConfigFile(path, LaunchSpec, changes)
