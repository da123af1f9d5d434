"""The classes of objects, everywhere in warploom: an object's class is an index into `CLASSES`."""

from __future__ import annotations

__all__ = ["BARRIER", "CLASSES", "CONE", "CYCLIST", "PEDESTRIAN", "UNKNOWN", "VEHICLE", "class_index"]

CLASSES = ("vehicle", "pedestrian", "cyclist", "cone", "barrier", "unknown")
"""Vehicles are cars, vans, trucks and buses; a cyclist is bicycle and rider as one; unknown is any other obstacle."""

VEHICLE, PEDESTRIAN, CYCLIST, CONE, BARRIER, UNKNOWN = range(len(CLASSES))


def class_index(name: str) -> int:
    """The index of a class by its name.

    Raises:
        ValueError: There is no such class; the message lists those there are.
    """
    try:
        return CLASSES.index(name)
    except ValueError:
        raise ValueError(f"no class {name!r}; there are: {', '.join(CLASSES)}") from None
