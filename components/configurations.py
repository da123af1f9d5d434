"""The configuration files that can be named: to list, to read, to take a copy of."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import yaml

from ..dag.configuration import nearest
from ..dag.launch.lookup import config_folders
from ..errors import ConfigError
from .profile import CONF

__all__ = ["NamedFile", "copy_file", "find_file", "named_files"]

_ENDINGS = (".yaml", ".yml", ".xml")


@dataclass(frozen=True)
class NamedFile:
    """A file of a conf folder."""

    kind: str
    """The folder within the conf folder: profiles, modules, launch, trackers."""
    name: str
    """Under which it is found: its path within that folder, without the ending."""
    path: Path

    def description(self) -> str:
        """What the file says that it is, by its description or its first comment; empty where it says nothing."""
        if self.path.suffix == ".xml":
            return "the reference's form of a launch file"
        try:
            text = self.path.read_text(encoding="utf-8")
            content = yaml.safe_load(text)
        except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as error:
            return f"cannot be read: {type(error).__name__}"
        told = content.get("description") if isinstance(content, dict) else None
        comment = itertools.takewhile(lambda line: line.startswith("#"), text.splitlines())
        words = " ".join(str(told or " ".join(line.lstrip("# ") for line in comment)).split())
        return words if told else words.partition(". ")[0]


def named_files() -> list[NamedFile]:
    """All files in `./conf`, `$WARPLOOM_CONF` and the package; of two of one name the first folder's."""
    found: dict[tuple[str, str], NamedFile] = {}
    for folder in config_folders(CONF):
        for path in _files(folder):
            kind, *rest = path.relative_to(folder).parts
            name = "/".join(rest)
            for ending in (".launch" + path.suffix, path.suffix):
                name = name.removesuffix(ending)
            key = (kind, name if path.suffix != ".xml" else f"{name}.xml")
            found.setdefault(key, NamedFile(kind, key[1], path))
    return [found[key] for key in sorted(found)]


def _files(folder: Path) -> Iterator[Path]:
    if folder.is_dir():
        for path in sorted(folder.rglob("*")):
            if path.suffix in _ENDINGS and len(path.relative_to(folder).parts) > 1:
                yield path


def find_file(name: str) -> NamedFile:
    """A file by `name`, or by `kind/name` where several kinds have one of that name.

    Raises:
        ConfigError: There is none, or there are several.
    """
    files = named_files()
    wanted = name.removesuffix(".yaml").removesuffix(".yml").removesuffix(".launch")
    fitting = [file for file in files if wanted in (file.name, f"{file.kind}/{file.name}")]
    if not fitting:
        raise ConfigError(f"no configuration file is called {name!r}; {nearest(wanted, [f.name for f in files])}")
    if len(fitting) > 1:
        raise ConfigError(f"{name!r} is any of {', '.join(f'{file.kind}/{file.name}' for file in fitting)}: say which")
    return fitting[0]


def copy_file(name: str, folder: Path) -> Path:
    """Copies a file to where it is found before the package's, to be changed there.

    Args:
        name: As `find_file` takes it.
        folder: The conf folder to copy into; made where it is not.

    Returns:
        The copy.

    Raises:
        ConfigError: There is no such file, or the folder has it already.
    """
    file = find_file(name)
    base = next(base for base in config_folders(CONF) if file.path.is_relative_to(base))
    target = folder / file.path.relative_to(base)
    if target.exists():
        raise ConfigError(f"{target} is there already: change it, or remove it first")
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(file.path, target)
    return target
