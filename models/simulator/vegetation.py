"""Trees, bushes and hedges: trunks, branches and loose leaves that beams partly pass."""

from __future__ import annotations

import numpy as np

from .labels import Material, PointClass, face_label
from .mesh import Shape, box, join, leaves, tube

__all__ = ["bush", "hedge", "scrub", "thicket", "tree"]

_BARK = face_label(Material.BARK, PointClass.VEGETATION)
_LEAVES = face_label(Material.LEAVES, PointClass.VEGETATION)


def _cloud(count: int, radii: np.ndarray, random: np.random.Generator, hollow: float) -> np.ndarray:
    """Points in an ellipsoid with a lumpy surface, few of them inside `hollow` of the radius."""
    direction = random.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    lumps = random.normal(size=(6, 3))
    lumps /= np.linalg.norm(lumps, axis=1, keepdims=True)
    bump = 0.78 + 0.22 * np.max(direction @ lumps.T, axis=1)
    radius = random.uniform(hollow**3, 1.0, count) ** (1 / 3)
    return direction * (bump * radius)[:, None] * radii


def tree(random: np.random.Generator) -> Shape:
    """A street tree: bent trunk, some branches, a crown; some are young and thin, some conifers."""
    young = random.random() < 0.35
    trunk = random.uniform(1.4, 2.8)
    height = random.uniform(3.5, 6.0) if young else random.uniform(6.0, 12.0)
    radius = random.uniform(0.04, 0.09) if young else random.uniform(0.11, 0.32)
    z = np.array([-0.2, 0.0, 0.35, 0.5 * trunk, trunk, 0.75 * height])
    bend = np.cumsum(random.normal(0, 0.05, (6, 2)), axis=0) * (z > 0.3)[:, None]
    path = np.concatenate([bend, z[:, None]], 1)
    parts = [tube(path, radius * np.array([1.5, 1.4, 1.0, 0.92, 0.8, 0.2]), _BARK, 8)]
    crown_radius = height * (random.uniform(0.14, 0.22) if young else random.uniform(0.22, 0.36))
    centre = np.array([*bend[4], 0.5 * (trunk + height)])
    radii = np.array([crown_radius, crown_radius, 0.55 * (height - trunk) + 0.2])
    for _ in range(3 if young else 6):
        end = centre + _cloud(1, radii, random, 0.5)[0]
        start = path[4] * random.uniform(0.75, 1.0)
        parts.append(
            tube(
                np.array([start, 0.5 * (start + end) + [0, 0, 0.15], end]),
                radius * np.array([0.4, 0.25, 0.1]),
                _BARK,
                4,
            )
        )
    count = 260 if young else 700
    parts.append(leaves(centre + _cloud(count, radii, random, 0.35), 0.22 if young else 0.34, _LEAVES, random))
    return join(*parts)


def bush(random: np.random.Generator) -> Shape:
    """A bush of 0.6 to 3 m, dense or sparse, with bare stems below."""
    radii = np.array([random.uniform(0.4, 1.5), random.uniform(0.4, 1.5), random.uniform(0.35, 1.25)])
    centre = np.array([0.0, 0.0, radii[2] * random.uniform(0.75, 1.0)])
    size = random.uniform(0.08, 0.2)
    count = int(np.clip(random.uniform(0.4, 1.6) * 3.2 * radii.prod() ** (2 / 3) / size**2, 60, 480))
    points = centre + _cloud(count, radii, random, random.uniform(0.2, 0.7))
    points[:, 2] = np.abs(points[:, 2])
    parts = [leaves(points, size, _LEAVES, random)]
    for _ in range(random.integers(2, 6)):
        end = centre + _cloud(1, radii, random, 0.4)[0]
        parts.append(
            tube(
                np.array([[0.3 * end[0], 0.3 * end[1], -0.1], np.abs(end) * [0, 0, 1] + end * [1, 1, 0]]),
                0.018,
                _BARK,
                4,
            )
        )
    return join(*parts)


def hedge(random: np.random.Generator) -> Shape:
    """A clipped hedge along x of 4 to 9 m: a dark core and leaves over its lumpy surface."""
    length, depth, height = random.uniform(4, 9), random.uniform(0.5, 1.2), random.uniform(0.8, 2.2)
    parts = [
        box((-length / 2 + 0.1, -depth / 2 + 0.14, 0), (length / 2 - 0.1, depth / 2 - 0.14, height - 0.16), _LEAVES)
    ]
    area = 2 * length * height + length * depth
    count = int(min(30 * area, 900))
    side = random.random(count)
    points = np.stack([random.uniform(-length / 2, length / 2, count), random.uniform(-depth / 2, depth / 2, count),
                       random.uniform(0.02, height, count)], 1)  # fmt: skip
    share = length * height / area
    points[side < share, 1] = -depth / 2
    points[(side >= share) & (side < 2 * share), 1] = depth / 2
    points[side >= 2 * share, 2] = height
    wave = 0.07 * np.sin(points[:, 0] * random.uniform(1.5, 4) + random.uniform(0, 6))
    points[:, 1] += wave + random.normal(0, 0.05, count)
    points[:, 2] = np.maximum(points[:, 2] + wave * (points[:, 2] > 0.8 * height) + random.normal(0, 0.04, count), 0.02)
    parts.append(leaves(points, 0.13, _LEAVES, random))
    return join(*parts)


def thicket(random: np.random.Generator) -> Shape:
    """Bushes and young trees grown together along x: 5 to 9 m long, 2 to 6 m high, ragged in outline."""
    length, depth, height = random.uniform(5, 9), random.uniform(1.5, 4.0), random.uniform(2.0, 6.0)
    parts = []
    for _ in range(random.integers(4, 8)):
        radii = np.array(
            [random.uniform(0.8, 1.9), random.uniform(0.35, 0.5) * depth, height * random.uniform(0.3, 0.6)]
        )
        centre = np.array([random.uniform(-0.45, 0.45) * length, random.normal(0, 0.15 * depth), 0.9 * radii[2]])
        points = centre + _cloud(int(190 * random.uniform(0.7, 1.2)), radii, random, 0.75)
        points[:, 2] = np.abs(points[:, 2])
        parts.append(leaves(points, random.uniform(0.22, 0.36), _LEAVES, random))
        stem = np.array([centre * [1, 1, 0], centre + random.normal(0, 0.3, 3), centre + radii * [0, 0, 0.8]])
        parts.append(tube(stem, np.array([0.07, 0.05, 0.02]), _BARK, 5))
    return join(*parts)


def scrub(random: np.random.Generator) -> Shape:
    """Tall grass, brambles or seedlings: a ragged patch of 2 to 6 m, 0.2 to 1.4 m high, that most beams enter."""
    length, depth, height = random.uniform(2, 6), random.uniform(1, 4), random.uniform(0.2, 1.4)
    parts = []
    for _ in range(random.integers(3, 9)):
        radii = np.array([random.uniform(0.2, 0.9), random.uniform(0.2, 0.9), height * random.uniform(0.4, 1.0)])
        at = np.array([random.uniform(-0.5, 0.5) * length, random.uniform(-0.5, 0.5) * depth, 0.0])
        points = at + _cloud(int(random.uniform(25, 110)), radii, random, 0.1)
        points[:, 2] = np.abs(points[:, 2])
        parts.append(leaves(points, random.uniform(0.06, 0.2), _LEAVES, random))
    return join(*parts)
