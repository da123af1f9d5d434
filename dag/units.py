"""Units in configuration files: values are plain numbers, their units are in the schema; a mistake is told in those."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Iterable
from typing import Any

__all__ = ["field_unit", "hint_for_key", "hint_for_value"]

_UNITS = {
    "nm": ("length", 1e-9), "um": ("length", 1e-6), "µm": ("length", 1e-6), "mm": ("length", 1e-3),
    "cm": ("length", 1e-2), "dm": ("length", 1e-1), "m": ("length", 1.0), "km": ("length", 1e3),
    "ns": ("time", 1e-9), "us": ("time", 1e-6), "µs": ("time", 1e-6), "ms": ("time", 1e-3), "s": ("time", 1.0),
    "sec": ("time", 1.0), "min": ("time", 60.0), "h": ("time", 3600.0),
    "rad": ("angle", 1.0), "deg": ("angle", 0.017453292519943295), "°": ("angle", 0.017453292519943295),
    "m/s": ("speed", 1.0), "mps": ("speed", 1.0), "km/h": ("speed", 1 / 3.6), "kmh": ("speed", 1 / 3.6),
    "Hz": ("rate", 1.0), "hz": ("rate", 1.0), "kHz": ("rate", 1e3),
}  # fmt: skip
"""Symbol → what it measures, and how much of the SI unit it is."""

_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([A-Za-zµ°][A-Za-zµ°/]*)\s*")
_IN_TEXT = re.compile(r"\[([^\]\s,]+)\]")


def field_unit(model: Any, field: str) -> str | None:
    """The unit of a field: the ending of its name (`_ms`), or what stands in brackets in its docstring (`[m]`)."""
    ending = field.rpartition("_")[2]
    if "_" in field and ending in _UNITS:
        return ending
    for cls in _classes(model):
        unit = _IN_TEXT.search(_docstrings(cls).get(field, ""))
        if unit is not None and unit[1] in _UNITS:
            return unit[1]
    return None


def _classes(annotation: Any) -> list[type]:
    """A class and its bases; or those of the classes within an annotation, such as `Model | None`."""
    if isinstance(annotation, type):
        return list(annotation.__mro__)
    return [cls for argument in getattr(annotation, "__args__", ()) for cls in _classes(argument)]


def _docstrings(cls: type) -> dict[str, str]:
    """The texts below the fields of a class, where its source is at hand."""
    try:
        (body,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    except (OSError, TypeError, SyntaxError, ValueError):
        return {}
    texts: dict[str, str] = {}
    name = None
    for statement in getattr(body, "body", ()):
        is_text = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
        if name is not None and is_text and isinstance(statement.value.value, str):
            texts[name] = statement.value.value
        is_field = isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name)
        name = statement.target.id if is_field else None
    return texts


def hint_for_value(value: Any, unit: str | None) -> str | None:
    """What to write in place of a number with a unit, such as `50 cm`; None where the value is no such thing.

    Args:
        value: What stands in the file.
        unit: Of the field; None where that is not known.
    """
    quantity = _QUANTITY.fullmatch(value) if isinstance(value, str) else None
    if quantity is None or quantity[2] not in _UNITS:
        return None
    number, (kind, factor) = float(quantity[1]), _UNITS[quantity[2]]
    if unit is None:
        return "write the number alone, in the unit that this key has"
    wanted, own = _UNITS[unit]
    if wanted != kind:
        return f"this is in {unit} ({wanted}), and {value!r} is not ({kind})"
    return f"this is in {unit}, so write {number * factor / own:.10g}"


def hint_for_key(key: str, value: Any, known: Iterable[str], model: Any) -> str | None:
    """What to write in place of a key with another unit in its name, such as `timeout_s` for `timeout_ms`.

    Args:
        key: What stands in the file.
        value: Its value.
        known: The keys that there are.
        model: The class that has them as fields.
    """
    stem, _, ending = key.rpartition("_")
    if ending not in _UNITS or not stem:
        return None
    kind, factor = _UNITS[ending]
    for other in known:
        unit = field_unit(model, other)
        if unit is None or _UNITS[unit][0] != kind or other not in (stem, f"{stem}_{unit}"):
            continue
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            return f"{other!r} is in {unit}: write {other}: {value * factor / _UNITS[unit][1]:.10g}"
        return f"{other!r} is in {unit}"
    return None
