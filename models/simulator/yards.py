"""What stands about in gardens, yards and on building sites, as large as cars and in no way alike."""

from __future__ import annotations

import numpy as np

from .labels import Material, PointClass, face_label
from .mesh import Shape, box, ellipsoid, join, loft

__all__ = ["heap", "shed"]


def shed(random: np.random.Generator) -> Shape:
    """A garden shed, a garage, a container or a skip: 2 to 6 m long, 1.1 to 2.8 m high, roof flat or sloping."""
    length, width, height = random.uniform(2.0, 6.0), random.uniform(1.4, 2.8), random.uniform(1.1, 2.6)
    material = (Material.WOOD, Material.METAL, Material.PLASTER, Material.CONCRETE)[random.integers(4)]
    label = face_label(material, PointClass.BUILDING)
    ridge, eaves = random.choice([0.0, random.uniform(0.1, 0.7)]), random.choice([0.0, 0.15])
    across = np.array([[-width / 2, -0.3], [-width / 2, height], [random.uniform(-0.5, 0.5) * width, height + ridge],
                       [width / 2, height], [width / 2, -0.3]])  # fmt: skip
    ends = [np.concatenate([np.full((5, 1), x), across], 1) for x in (-length / 2, length / 2)]
    parts = [loft(np.stack(ends), label, closed=True, caps=label)]
    if eaves:
        parts.append(
            box(
                (-length / 2 - eaves, -width / 2 - eaves, height - 0.1),
                (length / 2 + eaves, width / 2 + eaves, height),
                label,
            )
        )
    return join(*parts)


def heap(random: np.random.Generator) -> Shape:
    """A heap of soil, rubble, logs or bags, or a covered stack: 1.5 to 5 m long, 0.4 to 1.8 m high."""
    length, width, height = random.uniform(1.5, 5.0), random.uniform(1.0, 3.0), random.uniform(0.4, 1.8)
    material = (Material.SOIL, Material.WOOD, Material.CONCRETE, Material.CLOTH)[random.integers(4)]
    label = face_label(material, PointClass.OTHER)
    parts = []
    for _ in range(random.integers(1, 7)):
        x, y = random.uniform(-0.3, 0.3) * length, random.uniform(-0.3, 0.3) * width
        part = random.uniform(0.4, 1.0)
        if random.random() < 0.7:
            parts.append(ellipsoid((x, y, 0.0), (0.5 * part * length, 0.5 * part * width, part * height), label, 5))
        else:
            reach = 0.35 * part * np.array([length, width])
            parts.append(box((x - reach[0], y - reach[1], -0.2), (x + reach[0], y + reach[1], part * height), label))
    return join(*parts)
