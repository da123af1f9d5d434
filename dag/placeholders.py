"""Placeholders for sensors in module files: `{camera}` stands for each camera of the profile in turn.

- A component whose name holds a placeholder is made once for each sensor, and everywhere in it the placeholder becomes
  the sensor's name: `{camera}_image_feature_service` with the input `{image: "camera/{camera}"}`.
- In any other component a vertex, an input, an output or an item of a list that holds one is repeated for each sensor:
  `inputs: {"{camera}": "features/{camera}"}` is an input per camera.

`{lidar}`, `{camera}`, `{radar}`, `{gnss}`, `{imu}` and `{wheel}` stand for the sensors of their kind, `{sensor}` for
all. Where nobody says which sensors there are, each placeholder stands for one of its own name, so that a module can be
checked and drawn by itself.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from .configuration import nearest

__all__ = ["SENSOR_KINDS", "expand_sensors"]

SENSOR_KINDS = ("lidar", "camera", "radar", "gnss", "imu", "wheel")

_PLACEHOLDER = re.compile(r"\{(" + "|".join((*SENSOR_KINDS, "sensor")) + r")\}")
_ANY = re.compile(r"\{(\w+)\}")

Place = tuple[str | int, ...]


def expand_sensors(
    data: dict[str, Any], sensors: Mapping[str, Sequence[str]] | None
) -> tuple[dict[str, Any], dict[Place, str | int]]:
    """Puts sensors in the place of placeholders.

    Args:
        data: A module file as YAML reads it.
        sensors: Names by kind; None: each kind has one sensor of its own name.

    Returns:
        The module without placeholders; and for what stands elsewhere now: its path → its key or number in the file.

    Raises:
        ValueError: A component's name holds placeholders of several kinds; or a name or a topic one that stands for
            nothing. The message begins with the keys of its place.
    """
    if sensors is None:
        names = {kind: (kind,) for kind in (*SENSOR_KINDS, "sensor")}
    else:
        names = {kind: tuple(sensors.get(kind, ())) for kind in SENSOR_KINDS}
        names["sensor"] = tuple(name for kind in SENSOR_KINDS for name in names[kind])
    origins: dict[Place, str | int] = {}
    components = data.get("components")
    if not isinstance(components, list):
        return data, origins
    expanded: list[Any] = []
    for index, component in enumerate(components):
        kinds = _kinds(component.get("name")) if isinstance(component, dict) else []
        if isinstance(component, dict):
            _check(component, f"components.{index}", kinds)
        copies = [_replaced(component, kinds[0], name) for name in names[kinds[0]]] if kinds else [component]
        for copy in copies:
            place = ("components", len(expanded))
            origins[place] = index
            expanded.append(_repeated(copy, names, place, origins))
            _keep_origins(component, copy, place, origins)
    return {**data, "components": expanded}, origins


def _check(component: Mapping[str, Any], place: str, kinds: Sequence[str]) -> None:
    """The placeholders in a component's name and topics must stand for something."""
    if len(kinds) > 1:
        raise ValueError(
            f"{place}.name: {component['name']!r} holds placeholders of several kinds: "
            "a component is made for each sensor of one"
        )
    texts = [(f"{place}.name", component.get("name"), set(kinds))]
    for direction in ("inputs", "outputs"):
        mapping = component.get(direction)
        for key, topic in mapping.items() if isinstance(mapping, dict) else ():
            texts.append((f"{place}.{direction}.{key}", topic, {*kinds, *_kinds(key)}))
    for where, text, known in texts:
        for name in _ANY.findall(text) if isinstance(text, str) else ():
            if name not in (*SENSOR_KINDS, "sensor"):
                raise ValueError(f"{where}: no placeholder {{{name}}}; {nearest(name, (*SENSOR_KINDS, 'sensor'))}")
            if name not in known:
                raise ValueError(
                    f"{where}: {{{name}}} in {text!r} stands for nothing here: put it into the component's name, "
                    "so that it is made for each, or into the key, so that this is"
                )


def _kinds(text: Any) -> list[str]:
    return list(dict.fromkeys(_PLACEHOLDER.findall(text))) if isinstance(text, str) else []


def _replaced(value: Any, kind: str, name: str) -> Any:
    """A value with the sensor's name in the place of one kind of placeholder, keys included."""
    if isinstance(value, str):
        return value.replace(f"{{{kind}}}", name)
    if isinstance(value, dict):
        return {_replaced(key, kind, name): _replaced(item, kind, name) for key, item in value.items()}
    if isinstance(value, list):
        return [_replaced(item, kind, name) for item in value]
    return value


def _keep_origins(original: Any, copy: Any, place: Place, origins: dict[Place, str | int]) -> None:
    """Remembers how the keys of a copy are called in the file."""
    if isinstance(original, dict) and isinstance(copy, dict) and len(original) == len(copy):
        for (before, inner), (after, other) in zip(original.items(), copy.items(), strict=True):
            if before != after:
                origins.setdefault((*place, after), before)
            _keep_origins(inner, other, (*place, after), origins)


def _repeated(value: Any, names: Mapping[str, Sequence[str]], place: Place, origins: dict[Place, str | int]) -> Any:
    """A value in which every entry of a mapping and every item of a list stands once for each sensor that it names."""
    if isinstance(value, dict):
        result = {}
        for key, item in value.items():
            for kind, name in _sensors_of(key, item if isinstance(item, str) else None, names):
                new = _replaced(key, kind, name) if kind else key
                if new != key:
                    origins[(*place, new)] = key
                inner = _replaced(item, kind, name) if kind else item
                result[new] = _repeated(inner, names, (*place, new), origins)
        return result
    if isinstance(value, list):
        items: list[Any] = []
        for index, item in enumerate(value):
            for kind, name in _sensors_of(item if isinstance(item, str) else None, None, names):
                at = (*place, len(items))
                if len(items) != index:
                    origins[at] = index
                items.append(_repeated(_replaced(item, kind, name) if kind else item, names, at, origins))
        return items
    return value


def _sensors_of(key: Any, item: str | None, names: Mapping[str, Sequence[str]]) -> list[tuple[str, str]]:
    """The sensors for which an entry is repeated: (kind, name); one empty pair where it holds no placeholder."""
    kinds = _kinds(key)
    if not kinds:
        return [("", "")]
    return [(kinds[0], name) for name in names[kinds[0]]]
