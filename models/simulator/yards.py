"""What stands about in gardens, yards and on building sites, as large as cars and in no way alike."""

from __future__ import annotations

import numpy as np

from .labels import Material, PointClass, face_label
from .mesh import Shape, box, ellipsoid, join, leaves, loft, quad, tube

__all__ = ["column", "gate", "heap", "shed", "topiary"]


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


def column(random: np.random.Generator) -> Shape:
    """An advertising column, a broad trunk or pillar, a tank: 0.5 to 1.7 m thick, 1.5 to 3.8 m high."""
    radius, height = random.uniform(0.25, 0.85), random.uniform(1.5, 3.8)
    material = (Material.CONCRETE, Material.PLASTER, Material.BARK, Material.METAL)[random.integers(4)]
    label = face_label(material, PointClass.OTHER)
    z = np.array([-0.2, 0.0, 0.25, height])
    path = np.stack([0 * z, 0 * z, z], 1)
    path[:, :2] += random.normal(0, 0.03, (4, 2))
    sides = 4 if random.random() < 0.25 else 12
    parts = [tube(path, radius * np.array([1.1, 1.1, 1.0, random.uniform(0.8, 1.0)]), label, sides)]
    if random.random() < 0.4:
        brim = radius * random.uniform(1.05, 1.25)
        parts.append(tube(np.array([[0, 0, height], [0, 0, height + random.uniform(0.1, 0.4)]]), brim, label, sides))
    return join(*parts)


def gate(random: np.random.Generator) -> Shape:
    """A gate between two posts along x, 1.5 to 5 m wide, of boards or wire; things may lean on it."""
    width, height, thick = random.uniform(1.5, 5.0), random.uniform(0.9, 2.0), random.uniform(0.1, 0.3)
    stone = face_label((Material.BRICK, Material.CONCRETE, Material.WOOD)[random.integers(3)], PointClass.FENCE)
    leaf = face_label((Material.MESH, Material.WOOD, Material.METAL)[random.integers(3)], PointClass.FENCE)
    parts = []
    for x in (-0.5 * width, 0.5 * width):
        parts.append(box((x - thick, -thick, -0.2), (x + thick, thick, height + random.uniform(0, 0.4)), stone))
    low = random.uniform(0.02, 0.2)
    for x in (-0.5 * width, 0.0):
        corners = [[x, 0, low], [x + 0.5 * width, 0, low], [x + 0.5 * width, 0, height], [x, 0, height]]
        parts.append(quad(np.array(corners), leaf))
        parts.append(box((x, -0.03, height - 0.06), (x + 0.5 * width, 0.03, height), stone))
    return join(*parts)


def topiary(random: np.random.Generator) -> Shape:
    """A clipped or dense shrub without gaps: 1 to 4.5 m long, 0.8 to 2 m high, rounded or like a block."""
    length, depth, height = random.uniform(1.0, 4.5), random.uniform(0.8, 2.0), random.uniform(0.8, 2.0)
    label = face_label(Material.LEAVES, PointClass.VEGETATION)
    if random.random() < 0.5:
        core = box((-0.5 * length, -0.5 * depth, 0.0), (0.5 * length, 0.5 * depth, height - 0.08), label)
    else:
        core = ellipsoid((0.0, 0.0, 0.45 * height), (0.5 * length, 0.5 * depth, 0.55 * height), label, 7)
    count = int(min(22 * (2 * height * (length + depth) + length * depth), 500))
    a, b = random.uniform(0, 2 * np.pi, count), np.arcsin(random.uniform(-0.3, 1.0, count))
    way = np.stack([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)], 1)
    # From the middle out to the surface of the ellipsoid, or of the block.
    if len(core.vertices) == 8:
        way /= np.abs(way).max(1, keepdims=True)
    points = way * np.array([0.5 * length, 0.5 * depth, 0.55 * height]) + np.array([0.0, 0.0, 0.45 * height])
    points += random.normal(0, 0.04, (count, 3))
    points[:, 2] = np.clip(points[:, 2], 0.02, height + 0.05)
    return join(core, leaves(points, random.uniform(0.07, 0.14), label, random))
