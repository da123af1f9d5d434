"""Configuration files: YAML, validated by a pydantic model, with errors that say where and what to do."""

from __future__ import annotations

import difflib
import importlib
import os
import pkgutil
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar, get_args, get_origin

import yaml
from pydantic import BaseModel, ValidationError

from ..errors import ConfigError
from .units import field_unit, hint_for_key, hint_for_value

__all__ = ["ConfigFile", "find_config", "import_class", "nearest", "override", "parse_overrides"]

M = TypeVar("M", bound=BaseModel)
Expand = Callable[[dict[str, Any]], tuple[dict[str, Any], Mapping[tuple[str | int, ...], str | int]]]

_FAST_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_DEPTH = 100
_ENVIRONMENT_PREFIX = "WARPLOOM__"


def nearest(name: str, known: Iterable[str]) -> str:
    """A hint for a message: the known name most like `name`, and all that are known."""
    known = sorted(str(k) for k in known)
    hint = _closest(name, known)
    return f"{hint + ' ' if hint else ''}known: {', '.join(known) or 'none'}"


def _closest(name: str, known: Iterable[str], cutoff: float = 0.5) -> str:
    """A question after the known name most like one; nothing where none is."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=cutoff)
    return f"did you mean {close[0]!r}?" if close else ""


def _read(text: str) -> tuple[yaml.Node | None, Any]:
    """The nodes of a YAML text, which know their lines, and its values.

    Raises:
        YAMLError: It is none.
    """
    # libyaml is ten times as fast, but says less of a mistake.
    try:
        too_deep = _nested_too_deep(text)
        if too_deep is None:
            return yaml.compose(text, Loader=_FAST_LOADER), yaml.load(text, Loader=_FAST_LOADER)
    except yaml.YAMLError:
        return yaml.compose(text, Loader=yaml.SafeLoader), yaml.safe_load(text)
    raise yaml.MarkedYAMLError(problem=f"more than {_DEPTH} levels in each other", problem_mark=too_deep)


def _nested_too_deep(text: str) -> yaml.Mark | None:
    """Where a text has too many levels, of which libyaml's recursion would end the process; None: nowhere."""
    depth = 0
    for event in yaml.parse(text, Loader=_FAST_LOADER):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > _DEPTH:
                return event.start_mark
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
    return None


def _unique_keys(node: yaml.Node | None, path: Path, visited: set[int]) -> None:
    """Refuses a key that stands twice in one mapping, which YAML would resolve in silence."""
    if id(node) in visited:  # an alias
        return
    visited.add(id(node))
    if isinstance(node, yaml.MappingNode):
        seen: set[str] = set()
        for key, value in node.value:
            if key.value in seen:
                raise ConfigError(f"{path}:{key.start_mark.line + 1}: key {key.value!r} stands twice in one mapping")
            seen.add(key.value)
            _unique_keys(value, path, visited)
    elif isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _unique_keys(item, path, visited)


class ConfigFile(Generic[M]):
    """One configuration file: its model, and for messages the lines on which its keys stand."""

    part_name: ClassVar[str] = "key"
    """What a part of such a file is called in messages."""

    def __init__(
        self,
        path: str | Path,
        model: type[M],
        changes: Mapping[tuple[str | int, ...], Any] | None = None,
        *,
        expand: Expand | None = None,
    ) -> None:
        """Reads and validates a file.

        Args:
            path: The YAML file.
            model: What it must fit.
            changes: Values that replace those of the file, by the path of their keys.
            expand: What is done to the file's values first: gives the values, and for each that stands elsewhere now
                its path → its key in the file. A ValueError of it is told as one of the file.

        Raises:
            ConfigError: It cannot be read, is not YAML, or does not fit the model; the message names the file, the
                line, the key, what was expected and the nearest known key.
        """
        self.path = Path(path)
        try:
            text = self.path.read_text(encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"{self.path}: cannot be read: {error.strerror}") from error
        except UnicodeDecodeError as error:
            raise ConfigError(f"{self.path}: is not UTF-8 text: {error}") from error
        try:
            self._root, data = _read(text)
        except yaml.YAMLError as error:
            mark = getattr(error, "problem_mark", None)
            where = f":{mark.line + 1}" if mark is not None else ""
            problem = getattr(error, "problem", None) or str(error)
            raise ConfigError(f"{self.path}{where}: is not YAML: {problem}") from error
        _unique_keys(self._root, self.path, set())
        if not isinstance(data, dict):
            raise ConfigError(f"{self.path}:1: expected a mapping of keys to values, found {type(data).__name__}")
        self._origins: Mapping[tuple[str | int, ...], str | int] = {}
        if expand is not None:
            try:
                data, self._origins = expand(data)
            except ValueError as error:
                raise self._told(str(error)) from error
        self._changes = tuple(changes or {})
        for keys, value in (changes or {}).items():
            override(data, keys, value)
        try:
            self.content: M = model.model_validate(data)
        except ValidationError as error:
            raise ConfigError("\n".join(self._explain(error, model))) from error

    def line(self, keys: Sequence[str | int]) -> int:
        """The line, from 1, on which a key stands; that of its nearest parent where it is not in the file."""
        node, line = self._root, 1
        for depth, key in enumerate(keys):
            key = self._origins.get(tuple(keys[: depth + 1]), key)
            if isinstance(node, yaml.MappingNode):
                pair = next(((k, v) for k, v in node.value if k.value == str(key)), None)
                if pair is None:
                    return line
                line, node = pair[0].start_mark.line + 1, pair[1]
            elif isinstance(node, yaml.SequenceNode) and isinstance(key, int) and key < len(node.value):
                node = node.value[key]
                line = node.start_mark.line + 1
            else:
                return line
        return line

    def place(self, keys: Sequence[str | int]) -> str:
        """How a message calls a place in the file."""
        return ".".join(map(str, keys)) or "file"

    def _told(self, message: str) -> ConfigError:
        """An error whose message begins with the keys that it is about."""
        keys, _, what = message.partition(": ")
        return self.error([int(key) if key.isdecimal() else key for key in keys.split(".")], what)

    def error(self, keys: Sequence[str | int], message: str) -> ConfigError:
        """An error about a key of this file."""
        return ConfigError(f"{self.path}:{self.line(keys)}: {self.place(keys)}: {message}")

    def validate(self, keys: Sequence[str | int], model: type[BaseModel], data: Mapping[str, Any]) -> BaseModel:
        """Validates a part of this file, at `keys`, by a model of its own.

        Raises:
            ConfigError: It does not fit.
        """
        try:
            return model.model_validate(dict(data))
        except ValidationError as error:
            raise ConfigError("\n".join(self._explain(error, model, keys))) from error

    def _explain(self, error: ValidationError, model: type[BaseModel], prefix: Sequence[str | int] = ()) -> list[str]:
        lines = []
        for problem in error.errors():
            keys = [*prefix, *(key for key in problem["loc"] if key != "[key]")]
            where = f"{self.path}:{self.line(keys)}: {self.place(keys)}"
            if any(tuple(keys[: len(change)]) == change for change in self._changes):
                where += " (as set from outside the file)"
            if problem["type"] == "extra_forbidden":
                owner = _model_at(model, problem["loc"][:-1])
                known = list(_fields(owner))
                hint = hint_for_key(str(keys[-1]), problem["input"], known, owner)
                lines.append(
                    f"{where}: unknown {self.part_name}; "
                    + (f"{hint}; " if hint else "")
                    + nearest(str(keys[-1]), known)
                )
            elif problem["type"] == "missing":
                lines.append(f"{where}: this {self.part_name} is missing")
            else:
                expected = problem["msg"].removeprefix("Value error, ")
                found = problem["input"]
                unit = field_unit(_model_at(model, problem["loc"][:-1]), str(keys[-1])) if keys else None
                hint = hint_for_value(found, unit)
                if unit is not None and isinstance(found, (int, float)):
                    expected += f" [{unit}]"
                if problem["type"] == "literal_error" and isinstance(found, str):
                    hint = _closest(found, re.findall(r"'([^']*)'", expected))
                found = type(found).__name__ if isinstance(found, (dict, list)) else repr(found)
                told = f", found {found}" if problem["type"] != "value_error" else ""
                lines.append(f"{where}: {expected}{told}" + (f"; {hint}" if hint else ""))
        return lines


def _model_at(model: Any, keys: Sequence[str | int]) -> Any:
    """What a model takes at a place within it."""
    for key in keys:
        if get_origin(model) in (list, dict):
            model = get_args(model)[-1]
        else:
            model = _fields(model).get(str(key), model)
    return model


def _fields(annotation: Any) -> dict[str, Any]:
    """Key → type of the model found in an annotation, however deep in lists, dicts and unions."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return {field.alias or name: field.annotation for name, field in annotation.model_fields.items()}
    fields: dict[str, Any] = {}
    for argument in getattr(annotation, "__args__", ()):
        fields.update(_fields(argument))
    return fields


def override(data: dict[str, Any], keys: Sequence[str | int], value: Any) -> None:
    """Sets a value deep in mappings and lists, making the mappings on the way.

    Raises:
        ConfigError: A key for a list is not the number of one of its items.
    """
    place: Any = data
    for depth, key in enumerate(keys):
        if isinstance(place, list):
            if not str(key).isdecimal() or int(key) >= len(place):
                where = ".".join(map(str, keys[: depth + 1]))
                raise ConfigError(f"setting {where}: {key!r} is not the number of an item, 0 to {len(place) - 1}")
            key = int(key)
        if depth == len(keys) - 1:
            place[key] = value
        elif isinstance(place, dict) and not isinstance(place.get(key), (dict, list)):
            place[key] = {}
        place = place[key]


def parse_overrides(settings: Iterable[str] = (), environment: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Dotted keys and their values, from `key=value` texts and the environment; the texts win.

    Args:
        settings: Such as `perception.cluster.radius=0.6`; the value is read as YAML.
        environment: By default `os.environ`; `WARPLOOM__perception__cluster__radius` stands for the same key.

    Raises:
        ConfigError: A text has no `=`, or its value is not YAML.
    """
    environment = os.environ if environment is None else environment
    texts = [
        (name.removeprefix(_ENVIRONMENT_PREFIX).replace("__", "."), value)
        for name, value in environment.items()
        if name.startswith(_ENVIRONMENT_PREFIX)
    ]
    for text in settings:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"--set {text!r}: expected key=value, such as perception.cluster.radius=0.6")
        texts.append((key.strip(), value))
    overrides: dict[str, Any] = {}
    for key, value in texts:
        try:
            overrides[key] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise ConfigError(f"setting {key}={value}: the value is not YAML: {error}") from error
    return overrides


def find_config(name: str, kind: str, shipped: Path) -> Path:
    """Finds a configuration file by its name.

    Args:
        name: A path, or a name with or without `.yaml`.
        kind: Its folder within a conf folder: `profiles`, `modules` …
        shipped: The conf folder of the package, searched last, after `./conf` and `$WARPLOOM_CONF`.

    Raises:
        ConfigError: It is nowhere; the message lists the names that are.
    """
    direct = Path(name)
    if direct.suffix in (".yaml", ".yml") and os.path.isfile(direct):  # false also of what can name no file
        return direct
    own = os.environ.get("WARPLOOM_CONF")
    folders = [Path("conf"), *([Path(own)] if own else []), shipped]
    file_name = name if direct.suffix in (".yaml", ".yml") else f"{name}.yaml"
    for folder in folders:
        candidate = folder / kind / file_name
        if os.path.isfile(candidate):
            return candidate
    names = {path.stem for folder in folders for path in (folder / kind).glob("*.yaml")}
    raise ConfigError(f"no {kind.removesuffix('s')} {name!r}: neither a file nor a name; {nearest(name, names)}")


def import_class(dotted: str) -> type:
    """The class of a dotted name, from warploom or from a package of the user's own.

    Raises:
        ConfigError: The module cannot be imported, or has no such class.
    """
    module_name, dot, class_name = dotted.rpartition(".")
    if not dot:
        raise ConfigError(f"{dotted!r} is not a dotted name: write package.module.Class")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        missing = isinstance(error, ModuleNotFoundError) and f"{module_name}.".startswith(f"{error.name}.")
        hint = _closest(module_name, _modules_beside(module_name), cutoff=0.65) if missing else ""
        way_out = f"{hint} or " if hint else ""
        raise ConfigError(f"cannot import {module_name!r}: {error}; {way_out}is its folder on PYTHONPATH?") from error
    except Exception as error:
        raise ConfigError(f"cannot import {module_name!r}: {type(error).__name__}: {error}") from error
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        known = {name: value for name, value in vars(module).items() if isinstance(value, type)}
        classes = [name for name, value in known.items() if value.__module__.startswith(module_name)] or list(known)
        raise ConfigError(f"module {module_name!r} has no class {class_name!r}; {nearest(class_name, classes)}")
    return found


def _modules_beside(dotted: str) -> list[str]:
    """Dotted names of the modules in the package that a module would be in; of all there are where that is none.

    Those that begin with an underscore are nobody's to name.
    """
    package, _, _ = dotted.rpartition(".")
    try:
        path = importlib.import_module(package).__path__ if package else None
    except (ImportError, AttributeError):
        return []
    names = [one.name for one in pkgutil.iter_modules(path) if not one.name.startswith("_")]
    return [f"{package}.{name}" if package else name for name in names]
