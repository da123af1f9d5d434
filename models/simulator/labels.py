"""What the simulated world is made of: classes of points and materials of faces."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

__all__ = ["GROUND_CLASSES", "Material", "PointClass", "face_label", "material_table"]


class PointClass(IntEnum):
    """The class of a simulated point; finer than the classes of objects."""

    ROAD = 0
    SIDEWALK = 1
    TERRAIN = 2
    BUILDING = 3
    VEGETATION = 4
    POLE = 5
    FENCE = 6
    VEHICLE = 7
    PEDESTRIAN = 8
    CYCLIST = 9
    CONE = 10
    BARRIER = 11
    OTHER = 12
    NOISE = 13
    """An echo of no surface, as of a drop of rain."""


GROUND_CLASSES = (PointClass.ROAD, PointClass.SIDEWALK, PointClass.TERRAIN)


class Material(IntEnum):
    """What a face is made of, as far as a laser of 905 nm can tell."""

    ASPHALT = 0
    MARKING = 1
    PAVING = 2
    GRASS = 3
    BRICK = 4
    PLASTER = 5
    CONCRETE = 6
    WOOD = 7
    WINDOW = 8
    DARK_PAINT = 9
    PAINT = 10
    BRIGHT_PAINT = 11
    GLASS = 12
    TYRE = 13
    LAMP = 14
    PLATE = 15
    INTERIOR = 16
    BARK = 17
    LEAVES = 18
    METAL = 19
    SIGN = 20
    CLOTH = 21
    DARK_CLOTH = 22
    SKIN = 23
    SPOKES = 24
    MESH = 25
    PLASTIC = 26
    SOIL = 27
    TINTED = 28


# reflectivity, porosity (share of beams that pass), loss (share of echoes that are lost), gloss, roughness [m], and the
# cosine of incidence at which the best polished one mirrors half of the echoes away: of cars by comparison with KITTI
_PROPERTIES = {
    Material.ASPHALT: (0.22, 0.0, 0.01, 0.0, 0.0, 0.0),
    Material.MARKING: (0.75, 0.0, 0.0, 0.0, 0.0, 0.0),
    Material.PAVING: (0.35, 0.0, 0.0, 0.0, 0.0, 0.0),
    Material.GRASS: (0.45, 0.0, 0.01, 0.0, 0.012, 0.0),
    Material.BRICK: (0.35, 0.0, 0.0, 0.0, 0.006, 0.0),
    Material.PLASTER: (0.55, 0.0, 0.0, 0.0, 0.0, 0.0),
    Material.CONCRETE: (0.4, 0.0, 0.0, 0.0, 0.0, 0.0),
    Material.WOOD: (0.4, 0.0, 0.0, 0.0, 0.0, 0.0),
    Material.WINDOW: (0.2, 0.55, 0.35, 0.6, 0.0, 0.0),
    Material.DARK_PAINT: (0.12, 0.0, 0.04, 0.3, 0.0, 0.13),
    Material.PAINT: (0.35, 0.0, 0.02, 0.3, 0.0, 0.13),
    Material.BRIGHT_PAINT: (0.65, 0.0, 0.01, 0.3, 0.0, 0.13),
    Material.GLASS: (0.15, 0.6, 0.55, 0.6, 0.0, 0.25),
    Material.TYRE: (0.08, 0.0, 0.05, 0.0, 0.0, 0.0),
    Material.LAMP: (0.9, 0.0, 0.0, 0.0, 0.0, 0.0),
    Material.PLATE: (1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    Material.INTERIOR: (0.18, 0.0, 0.35, 0.0, 0.03, 0.3),
    Material.BARK: (0.25, 0.0, 0.0, 0.0, 0.0, 0.0),
    Material.LEAVES: (0.45, 0.15, 0.05, 0.0, 0.06, 0.0),
    Material.METAL: (0.4, 0.0, 0.0, 0.2, 0.0, 0.0),
    Material.SIGN: (1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    Material.CLOTH: (0.4, 0.0, 0.01, 0.0, 0.006, 0.0),
    Material.DARK_CLOTH: (0.15, 0.0, 0.02, 0.0, 0.006, 0.0),
    Material.SKIN: (0.5, 0.0, 0.0, 0.0, 0.0, 0.0),
    Material.SPOKES: (0.3, 0.85, 0.2, 0.0, 0.0, 0.0),
    Material.MESH: (0.35, 0.8, 0.1, 0.0, 0.0, 0.0),
    Material.PLASTIC: (0.5, 0.0, 0.0, 0.1, 0.0, 0.0),
    Material.TINTED: (0.1, 0.15, 0.8, 0.6, 0.0, 0.25),
    Material.SOIL: (0.3, 0.0, 0.01, 0.0, 0.008, 0.0),
}


# What a film of water does to surfaces that take it: they are darker, and more of the echo goes away from the sensor.
_WETTED = (Material.ASPHALT, Material.MARKING, Material.PAVING, Material.SOIL, Material.CONCRETE)
_WET_REFLECTIVITY, _WET_GLOSS = 0.45, 0.5


def material_table(wetness: float = 0.0) -> np.ndarray:
    """The properties of each material, as the ray caster takes them, shape (256, 6).

    Args:
        wetness: Of roads, pavings, soil and concrete, from 0, dry, to 1, under a film of water.
    """
    table = np.zeros((256, 6), np.float32)
    for material, row in _PROPERTIES.items():
        table[material] = row
    wetted = list(_WETTED)
    table[wetted, 0] *= 1.0 - (1.0 - _WET_REFLECTIVITY) * wetness
    table[wetted, 3] += (_WET_GLOSS - table[wetted, 3]) * wetness
    return table


def face_label(material: Material, point_class: PointClass) -> int:
    """The label of a face: its material and the class of its points."""
    return int(material) + 256 * int(point_class)
