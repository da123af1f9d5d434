"""The prototypes that a simulated world is furnished with: built on first use, shared by all instances."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from ...kernels.meshes import MeshSet
from ..classes import BARRIER, CONE, CYCLIST, PEDESTRIAN, VEHICLE
from . import people, structures, vegetation, vehicles
from .mesh import Shape

__all__ = ["KINDS", "Library", "Prototype", "object_class", "prototype"]

_STRUCTURES: dict[str, Callable[[np.random.Generator], Shape]] = {
    "tree": vegetation.tree,
    "bush": vegetation.bush,
    "hedge": vegetation.hedge,
    "thicket": vegetation.thicket,
    "facade": structures.facade,
    "wall": structures.wall,
    "fence": structures.fence,
    "lamp_post": structures.lamp_post,
    "sign": structures.sign,
    "bollard": structures.bollard,
    "bin": structures.bin_,
    "cabinet": structures.cabinet,
    "hydrant": structures.hydrant,
    "bike_rack": structures.bike_rack,
    "motorbike": structures.motorbike,
    "bus_stop": structures.bus_stop,
    "table": structures.table,
    "stairs": structures.stairs,
    "cone": structures.cone,
    "barrier": structures.barrier,
}
_VARIANTS = {
    "tree": 16, "bush": 24, "hedge": 10, "thicket": 14, "facade": 32, "wall": 14, "fence": 10, "lamp_post": 8,
    "sign": 8, "bollard": 4,
    "bin": 6, "cabinet": 8, "hydrant": 2, "bike_rack": 8, "motorbike": 5, "bus_stop": 3, "table": 6, "stairs": 6,
    "cone": 4, "barrier": 8, "pedestrian": 24, "stander": 8, "cyclist": 12,
}  # fmt: skip
KINDS: dict[str, int] = {**_VARIANTS, **dict.fromkeys(vehicles.VEHICLE_KINDS, 10)}
"""How many variants there are of each kind of thing."""


@dataclass(frozen=True, eq=False)
class Prototype:
    """One thing of one kind, in one pose."""

    shape: Shape
    hull: np.ndarray
    """The corners that its bounding box can touch, shape (h, 3)."""
    size: np.ndarray
    """Length, width, height of its bounding box [m], shape (3,)."""


def object_class(kind: str) -> int:
    """The class of objects of a kind, −1 for what is background."""
    if kind in vehicles.VEHICLE_KINDS:
        return VEHICLE
    classes = {"pedestrian": PEDESTRIAN, "stander": PEDESTRIAN, "cyclist": CYCLIST, "cone": CONE, "barrier": BARRIER}
    return classes.get(kind, -1)


@cache
def prototype(kind: str, variant: int, phase: int = 0) -> Prototype:
    """The prototype of a kind; the same arguments give the same one, in every process.

    Raises:
        ValueError: There is no such kind.
    """
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, not {kind!r}")
    random = np.random.default_rng([zlib.crc32(kind.encode()), variant])
    if kind in _STRUCTURES:
        shape = _STRUCTURES[kind](random)
    elif kind in vehicles.VEHICLE_KINDS:
        shape = vehicles.vehicle(kind, random)
    elif kind == "cyclist":
        shape = people.cyclist(phase, random)
    else:
        shape = people.pedestrian(phase, random, walking=kind == "pedestrian")
    low, high = shape.bounds()
    return Prototype(
        shape, _hull(shape.vertices[shape.boxed]) if object_class(kind) >= 0 else np.empty((0, 3)), high - low
    )


def _hull(vertices: np.ndarray) -> np.ndarray:
    from scipy.spatial import ConvexHull

    return vertices[ConvexHull(vertices).vertices]


class Library:
    """Prototypes as meshes on a device, and a place for the ground of the present scene."""

    max_ground_faces = 40_000
    """Triangles that a ground may have."""

    def __init__(self, device: str = "cpu"):
        self.meshes = MeshSet(device, max_faces=1 << 21)
        self.ground = self.meshes.reserve(self.max_ground_faces)
        self._numbers: dict[tuple[str, int, int], int] = {}

    def number(self, kind: str, variant: int, phase: int = 0) -> int:
        """The number in `meshes` of a prototype's mesh."""
        key = (kind, variant, phase)
        if key not in self._numbers:
            shape = prototype(*key).shape
            self._numbers[key] = self.meshes.add(shape.vertices, shape.faces, shape.labels)
        return self._numbers[key]
