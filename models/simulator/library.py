"""The prototypes that a simulated world is furnished with: built on first use, shared by all instances."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from ...kernels.meshes import MeshSet
from ..classes import BARRIER, CONE, CYCLIST, PEDESTRIAN, VEHICLE
from . import people, structures, vegetation, vehicles, yards
from .mesh import Shape

__all__ = ["KINDS", "VISIBILITY_RAYS", "Library", "Prototype", "object_class", "prototype"]

VISIBILITY_RAYS = 24
"""Points on an object that are looked at to tell how much of it is visible."""

_STRUCTURES: dict[str, Callable[[np.random.Generator], Shape]] = {
    "tree": vegetation.tree,
    "bush": vegetation.bush,
    "hedge": vegetation.hedge,
    "thicket": vegetation.thicket,
    "scrub": vegetation.scrub,
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
    "shed": yards.shed,
    "heap": yards.heap,
    "column": yards.column,
    "gate": yards.gate,
    "topiary": yards.topiary,
    "flower_bed": yards.flower_bed,
    "bastion": yards.bastion,
    "panel": yards.panel,
    "cone": structures.cone,
    "barrier": structures.barrier,
}
_VARIANTS = {
    "tree": 16, "bush": 24, "hedge": 10, "thicket": 14, "facade": 32, "wall": 14, "fence": 10, "lamp_post": 8,
    "sign": 8, "bollard": 4, "scrub": 18, "shed": 10, "heap": 10,
    "column": 12, "gate": 8, "topiary": 14, "flower_bed": 12, "bastion": 12, "panel": 10,
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
    """The corners that its bounding box can touch while it and the sensor lean by up to 0.25 rad, shape (h, 3)."""
    size: np.ndarray
    """Length, width, height of its bounding box [m], shape (3,)."""
    surface: np.ndarray
    """Points spread over its faces, shape (`VISIBILITY_RAYS`, 3); none of what is background."""


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
    nothing = np.empty((0, 3))
    if object_class(kind) < 0:
        return Prototype(shape, nothing, high - low, nothing)
    return Prototype(shape, _hull(shape.vertices[shape.boxed]), high - low, _surface(shape))


_LEAN = 0.25  # [rad] of a side of the box


def _hull(vertices: np.ndarray) -> np.ndarray:
    """The vertices that are the farthest in any of the directions that a side of the box can face."""
    lean = np.linspace(-_LEAN, _LEAN, 13)  # at 0.04 rad a corner in between stands out by less than a millimetre
    u, v = (grid.ravel() for grid in np.meshgrid(lean, lean))
    one, farthest = np.ones_like(u), []
    for axis in range(3):
        for sign in (1, -1):
            ways = np.roll(np.stack([sign * one, u, v], 1), axis, 1)
            # No lean brings a vertex before the first one that is farther behind it than beside it by this.
            behind = sign * vertices[:, axis]
            away = np.abs(vertices - vertices[behind.argmax()])
            may = np.flatnonzero(_LEAN * (away.sum(1) - away[:, axis]) >= behind.max() - behind - 1e-9)
            farthest.append(may[(vertices[may] @ ways.T).argmax(0)])
    return vertices[np.unique(farthest)]


def _surface(shape: Shape) -> np.ndarray:
    """Points at even steps of the area of all faces taken in turn."""
    a, b, c = shape.vertices[shape.faces].transpose(1, 0, 2)
    area = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    steps = (np.arange(VISIBILITY_RAYS) + 0.5) / VISIBILITY_RAYS * area[-1]
    face = np.searchsorted(area, steps)
    random = np.random.default_rng(0)
    u, v = np.sort(random.random((2, VISIBILITY_RAYS)), axis=0)[..., None]
    return u * a[face] + (v - u) * b[face] + (1 - v) * c[face]


class Library:
    """Prototypes as meshes on a device, and a place for the ground of each present scene."""

    def __init__(self, device: str = "cpu", grounds: int = 1, ground_faces: int = 40_000):
        """Reserves places for so many grounds of up to so many triangles each."""
        self.meshes = MeshSet(device, max_faces=(1 << 21) + grounds * ground_faces)
        self.grounds = [self.meshes.reserve(ground_faces) for _ in range(grounds)]
        self._numbers: dict[tuple[str, int, int], int] = {}

    def number(self, kind: str, variant: int, phase: int = 0) -> int:
        """The number in `meshes` of a prototype's mesh."""
        key = (kind, variant, phase)
        if key not in self._numbers:
            shape = prototype(*key).shape
            self._numbers[key] = self.meshes.add(shape.vertices, shape.faces, shape.labels)
        return self._numbers[key]
