"""Flag loaders: what runs before everything else, and says what the components can look up."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml

from ..errors import ConfigError
from .configuration import ConfigFile, import_class
from .schema import ModuleSpec

__all__ = ["YamlFlags", "load_flags"]


class YamlFlags:
    """Loads flags from a YAML file."""

    def __init__(self, path: str) -> None:
        """Names the file, whose top is a mapping."""
        self._path = Path(path)

    def load(self) -> Mapping[str, Any]:
        """Reads the file.

        Raises:
            ConfigError: It cannot be read, or is not a mapping.
        """
        try:
            flags = yaml.safe_load(self._path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as error:
            raise ConfigError(f"{self._path}: flags cannot be read: {error}") from error
        if not isinstance(flags, dict):
            raise ConfigError(f"{self._path}:1: expected a mapping of flags to values, found {type(flags).__name__}")
        return flags


def load_flags(modules: Iterable[ConfigFile[ModuleSpec]]) -> Mapping[str, Any]:
    """Runs the flag loaders of some modules, in their order; of a flag that several load, the last one stands.

    Raises:
        ConfigError: A loader cannot be made, or fails; the message names its place.
    """
    flags: dict[str, Any] = {}
    for file in modules:
        for index, spec in enumerate(file.content.flag_loaders):
            keys = ["flag_loaders", index]
            try:
                loaded = import_class(spec.class_name)(**spec.config).load()
            except Exception as error:
                told = str(error) if isinstance(error, ConfigError) else f"{type(error).__name__}: {error}"
                raise file.error(keys, f"{spec.class_name} cannot load flags: {told}") from error
            if not isinstance(loaded, Mapping):
                raise file.error(keys, f"{spec.class_name} loaded {type(loaded).__name__}, not a mapping of flags")
            flags.update(loaded)
    return MappingProxyType(flags)
