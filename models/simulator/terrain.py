"""The ground of a street: carriageways, curbs, sidewalks and what lies beyond, on a grid that follows their edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .labels import Material, PointClass, face_label

__all__ = ["Ground", "street_ground"]

_ROAD = face_label(Material.ASPHALT, PointClass.ROAD)
_MARKING = face_label(Material.MARKING, PointClass.ROAD)
_SIDEWALK = face_label(Material.PAVING, PointClass.SIDEWALK)


@dataclass(frozen=True, eq=False, kw_only=True)
class Ground:
    """A height field over street coordinates: s along the street, d to its left [m], bent into the world's plane."""

    s: np.ndarray
    """Grid lines along the street, shape (n,)."""
    d: np.ndarray
    """Grid lines across, shape (m,)."""
    z: np.ndarray
    """Heights at the grid's corners, shape (n, m)."""
    labels: np.ndarray
    """Label of each cell, shape (n − 1, m − 1)."""
    curvature: float
    """Of the street's centre line, positive to the left [1/m]."""

    def height(self, s: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Height at street coordinates, as the triangles have it."""
        i = np.clip(np.searchsorted(self.s, s, side="right") - 1, 0, len(self.s) - 2)
        j = np.clip(np.searchsorted(self.d, d, side="right") - 1, 0, len(self.d) - 2)
        u = np.clip((s - self.s[i]) / (self.s[i + 1] - self.s[i]), 0, 1)
        v = np.clip((d - self.d[j]) / (self.d[j + 1] - self.d[j]), 0, 1)
        a, b, c, e = self.z[i, j], self.z[i + 1, j], self.z[i + 1, j + 1], self.z[i, j + 1]
        return np.where(u >= v, a + u * (b - a) + v * (c - b), a + v * (e - a) + u * (c - e))

    def slope(self, s: np.ndarray, d: np.ndarray, reach: float = 1.2) -> tuple[np.ndarray, np.ndarray]:
        """Rise along s and along d over ± `reach` metres."""
        along = self.height(s + reach, d) - self.height(s - reach, d)
        across = self.height(s, d + reach) - self.height(s, d - reach)
        return along / (2 * reach), across / (2 * reach)

    def to_world(self, s: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """World x and y of street coordinates, and the street's heading there [rad]."""
        k = self.curvature
        if abs(k) < 1e-6:
            return s, d, 0.0 * s
        return (1 / k - d) * np.sin(k * s), 1 / k - (1 / k - d) * np.cos(k * s), k * s

    def to_street(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Street coordinates of world x and y: the inverse of `to_world`."""
        k = self.curvature
        if abs(k) < 1e-6:
            return x, y
        sign = np.sign(k)
        radius = np.hypot(x, 1 / k - y)
        return np.arctan2(sign * x, sign * (1 / k - y)) / k, 1 / k - sign * radius

    def mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices (v, 3), faces (f, 3) and labels (f,) of its triangles in the world."""
        n, m = self.z.shape
        s, d = np.meshgrid(self.s, self.d, indexing="ij")
        x, y, _ = self.to_world(s, d)
        vertices = np.stack([x, y, self.z], -1).reshape(-1, 3)
        index = np.arange(n * m).reshape(n, m)
        a, b, c, e = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
        faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, e], -1)], 2).reshape(-1, 3)
        return vertices, faces, np.repeat(self.labels.ravel(), 2)


def _lines(low: float, high: float, step: float, *edges: float) -> np.ndarray:
    """Grid lines every `step`, and at the edges; none closer to an edge than a third of a step."""
    even = np.arange(low, high + 0.5 * step, step)
    marks = np.unique(np.round([e for e in edges if low < e < high], 3))
    if len(marks):
        even = even[np.min(np.abs(even[:, None] - marks), axis=1) > step / 3]
    return np.unique(np.concatenate([even, marks]))


def street_ground(
    random: np.random.Generator,
    *,
    extent: tuple[float, float],
    half_width: float,
    sidewalk: float,
    crossings: list[tuple[float, float]],
    reach: float = 75.0,
    hilly: float = 1.0,
    curvature: float = 0.0,
    banks: bool = False,
) -> Ground:
    """The ground of a street with side streets.

    Args:
        random: Source of heights.
        extent: Where it begins and ends along s [m].
        half_width: Of the carriageway, to the curb [m].
        sidewalk: Width of the sidewalks [m].
        crossings: Position along s and half width of each side street [m].
        reach: How far it goes to either side [m].
        hilly: Factor on slopes and bumps.
        curvature: Of the centre line [1/m].
        banks: Whether the land beside the street may rise and fall in embankments and mounds.
    """
    ramp = 0.03
    across = [
        e * k for e in (half_width, half_width + ramp, half_width + sidewalk, 0.06, half_width - 0.12) for k in (-1, 1)
    ]
    along = [
        at + k * e for at, half in crossings for e in (half, half + ramp, half + sidewalk) for k in (-1, 1)
    ]  # fmt: skip
    s = _lines(*extent, 3.0, *along)
    d = _lines(-reach, reach, 3.0, *across)
    S, D = np.meshgrid(s, d, indexing="ij")
    # Long waves make hills of up to a few per cent, the same for all; short ones make the rough of the verges.
    z = np.zeros_like(S)
    for _ in range(3):
        length, heading, phase = random.uniform(60, 220), random.uniform(0, np.pi), random.uniform(0, 2 * np.pi)
        steep = hilly * random.uniform(0.0, 0.022)
        z += (
            steep
            * length
            / (2 * np.pi)
            * np.sin(2 * np.pi / length * (S * np.cos(heading) + D * np.sin(heading)) + phase)
        )
    lift = np.clip((np.abs(D) - half_width) / ramp, 0, 1)
    outside = np.clip(np.abs(D) - half_width - sidewalk, 0, None)
    crown = 0.02 * (half_width - np.minimum(np.abs(D), half_width))
    for at, half in crossings:
        lift = np.minimum(lift, np.clip((np.abs(S - at) - half) / ramp, 0, 1))
        outside = np.minimum(outside, np.clip(np.abs(S - at) - half - sidewalk, 0, None))
    curb = random.uniform(0.06, 0.16)
    bank = hilly * random.normal(0.0, 0.025, 2)
    z += crown + curb * lift + np.where(D > 0, bank[0], bank[1]) * np.minimum(outside, 25.0)
    z += random.normal(0, 0.035, z.shape) * (outside > 0.3)
    z += random.normal(0, 0.004, z.shape)

    if banks:
        z += _banks(random, S, D, outside)

    sc, dc = 0.5 * (s[1:] + s[:-1]), 0.5 * (d[1:] + d[:-1])
    SC, DC = np.meshgrid(sc, dc, indexing="ij")
    road, walk = np.abs(DC) < half_width + ramp, np.abs(DC) < half_width + sidewalk
    marking = (np.abs(DC) < 0.06) & (np.floor(SC / 6.0) % 2 == 0) | (np.abs(np.abs(DC) - half_width + 0.06) < 0.06)
    for at, half in crossings:
        near = np.abs(SC - at)
        road, walk = road | (near < half + ramp), walk | (near < half + sidewalk)
        marking &= near > half
    beyond = [face_label(m, PointClass.TERRAIN) for m in (Material.GRASS, Material.SOIL, Material.GRASS)]
    beyond.append(face_label(Material.PAVING, PointClass.SIDEWALK))
    plots = np.array(beyond)[random.integers(0, 4, (64, 2))]
    labels = plots[(np.floor((SC - extent[0]) / 14.0).astype(int)) % 64, (DC > 0).astype(int)]
    labels = np.where(walk, _SIDEWALK, labels)
    labels = np.where(road, np.where(marking & (np.abs(DC) < half_width), _MARKING, _ROAD), labels)
    return Ground(s=s, d=d, z=z, labels=labels.astype(np.int32), curvature=curvature)


def _banks(random: np.random.Generator, s: np.ndarray, d: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """Heights to add beside the street: on each side perhaps an embankment, and mounds further out [m].

    Args:
        random: Source of chance.
        s: Of the grid's corners, along the street [m].
        d: Across [m].
        outside: Distance of the corners from sidewalks and side streets [m].
    """
    z = np.zeros_like(s)
    for side in (1, -1):
        foot, rise = (
            random.uniform(0.3, 10.0),
            random.choice([0.0, random.uniform(-1.2, 0.0), random.uniform(0.2, 2.4)]),
        )
        width = 0.8 + abs(rise) * random.uniform(2.0, 6.0)
        climbed = np.clip((outside - foot) / width, 0.0, 1.0)
        z += (side * d > 0) * rise * climbed * climbed * (3.0 - 2.0 * climbed)
    for _ in range(4):
        length, heading, phase = random.uniform(9, 30), random.uniform(0, np.pi), random.uniform(0, 2 * np.pi)
        height = random.uniform(0.0, 0.012) * length
        wave = np.sin(2 * np.pi / length * (s * np.cos(heading) + d * np.sin(heading)) + phase)
        z += height * wave * np.clip(outside / 6.0, 0.0, 1.0)
    return z
