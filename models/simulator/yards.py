"""What stands about in gardens, yards and on building sites, as large as cars and in no way alike."""

from __future__ import annotations

import numpy as np

from .labels import Material, PointClass, face_label
from .mesh import Shape, box, ellipsoid, join, leaves, loft, quad, tube

__all__ = ["bastion", "column", "flower_bed", "gate", "heap", "panel", "shed", "topiary"]


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


def flower_bed(random: np.random.Generator) -> Shape:
    """A bed of low plants or ground cover, as broad as a car: 2 to 6 m long, 0.3 to 0.9 m high, uneven on top."""
    length, depth, height = random.uniform(2.0, 6.0), random.uniform(1.0, 2.6), random.uniform(0.3, 0.9)
    label = face_label(Material.LEAVES, PointClass.VEGETATION)
    count = int(min(30 * length * depth, 420))
    x, y = random.uniform(-0.5, 0.5, (2, count)) * np.array([[length], [depth]])
    bumps = np.sin(x * random.uniform(1, 4) + random.uniform(0, 6)) * np.sin(y * random.uniform(1, 4))
    z = height * np.clip(random.uniform(0.55, 1.0, count) + 0.2 * bumps, 0.1, 1.0)
    parts = [leaves(np.stack([x, y, z], 1), random.uniform(0.06, 0.16), label, random)]
    if random.random() < 0.6:
        half = 0.46 * np.array([length, depth])
        parts.append(box((-half[0], -half[1], 0.0), (half[0], half[1], random.uniform(0.3, 0.7) * height), label))
    if random.random() < 0.3:
        stone = face_label(Material.CONCRETE, PointClass.OTHER)
        half = 0.5 * np.array([length, depth]) + 0.1
        parts.append(box((-half[0], -half[1], -0.2), (half[0], half[1], random.uniform(0.1, 0.45)), stone))
    return join(*parts)


def bastion(random: np.random.Generator) -> Shape:
    """A wall that bulges towards -y, 3 to 9 m along x and 0.5 to 1.6 m high, with plants on the ground behind it."""
    chord, height, bulge = random.uniform(3.0, 9.0), random.uniform(0.5, 1.6), random.uniform(0.4, 2.2)
    material = (Material.BRICK, Material.CONCRETE, Material.PLASTER)[random.integers(3)]
    label = face_label(material, PointClass.FENCE)
    t = np.linspace(-1.0, 1.0, 13)
    front = np.stack([0.5 * chord * t, -bulge * (1.0 - t * t)], 1)
    low, high = (np.concatenate([front, np.full((13, 1), z)], 1) for z in (-0.3, height))
    back = np.stack([0.5 * chord * t, np.full(13, 0.3), np.full(13, height)], 1)
    parts = [loft(np.stack([low, high, back]), label)]
    green = face_label(Material.LEAVES, PointClass.VEGETATION)
    for _ in range(random.integers(0, 6)):
        x = random.uniform(-0.4, 0.4) * chord
        radii = np.array([random.uniform(0.3, 1.1), random.uniform(0.25, 0.7), random.uniform(0.25, 0.8)])
        centre = np.array([x, random.uniform(-0.6, 0.4) * bulge, height + 0.6 * radii[2]])
        way = random.normal(size=(random.integers(60, 160), 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        points = centre + way * radii * random.uniform(0.7, 1.0, (len(way), 1))
        points[:, 2] = np.maximum(points[:, 2], height)
        parts.append(leaves(points, random.uniform(0.08, 0.18), green, random))
    return join(*parts)


def panel(random: np.random.Generator) -> Shape:
    """A hoarding, a billboard or a fence's end: flat, 2 to 5 m long, 1.2 to 2.4 m high, from the ground or not."""
    length, height, foot = random.uniform(2.0, 5.0), random.uniform(1.2, 2.4), random.choice([0.0, 0.1, 0.4, 0.8])
    label = face_label((Material.WOOD, Material.METAL, Material.PLASTER)[random.integers(3)], PointClass.FENCE)
    thick = random.uniform(0.02, 0.2)
    parts = [box((-0.5 * length, -thick, foot), (0.5 * length, thick, height), label)]
    for x in np.linspace(-0.5 * length, 0.5 * length, int(random.integers(2, 4))):
        parts.append(box((x - 0.06, -thick - 0.06, -0.2), (x + 0.06, thick + 0.06, height), label))
    if random.random() < 0.4:
        wing = random.uniform(0.5, 2.0) * random.choice([-1.0, 1.0])
        y = sorted((0.0, wing))
        parts.append(box((0.5 * length - 0.05, y[0], foot), (0.5 * length + 0.05, y[1], height), label))
    return join(*parts)
