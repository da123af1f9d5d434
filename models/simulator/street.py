"""Procedural streets: the ground, what stands along it, and who moves on it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from .library import KINDS, prototype
from .people import PHASES
from .terrain import Ground, street_ground

__all__ = ["STYLES", "Street", "StreetPlan", "Things", "phase_of", "random_street", "travelled"]

STYLES = ("urban", "residential", "green", "commercial")
"""What lines a street: house fronts, houses behind gardens, trees and hedges, or car parks and large buildings."""

_CARS = {"hatch": 26, "mini": 11, "sedan": 14, "wagon": 14, "suv": 12, "mpv": 9, "coupe": 4, "small_van": 5, "van": 6,
         "minibus": 4, "pickup": 2}  # fmt: skip
_CAR_NAMES, _CAR_SHARES = tuple(_CARS), np.array(list(_CARS.values())) / sum(_CARS.values())


# What counts of a thing that others may stand under, or grow into.
_TRUNKS = {"tree": np.array([0.7, 0.7]), "lamp_post": np.array([0.4, 0.4]), "sign": np.array([0.4, 0.4])}
_SHARES = {"bush": 0.7, "thicket": 0.75, "hedge": 0.95, "scrub": 0.6}
_CELL = 5.0  # [m] edge of a cell of the map of what is taken; no circle in it is wider


@dataclass(eq=False)
class Things:
    """Everything placed on a street, as growing columns; motion is straight in street coordinates."""

    kind: list[str] = field(default_factory=list)
    variant: list[int] = field(default_factory=list)
    pose: list[tuple[float, float, float, float]] = field(default_factory=list)
    """s, d, yaw against the street [rad], height above ground [m] at time 0."""
    scale: list[tuple[float, float, float]] = field(default_factory=list)
    motion: list[tuple[float, float, float, float]] = field(default_factory=list)
    """Speed [m/s], and amplitude [m], angular rate [rad/s] and phase [rad] of its variation."""

    def __len__(self) -> int:
        return len(self.kind)


def travelled(motion: np.ndarray, t: float) -> np.ndarray:
    """Distance that things have gone at time t [m], from rows of `Things.motion`."""
    speed, amplitude, rate, phase = np.moveaxis(np.asarray(motion, np.float64), -1, 0)
    return speed * t + amplitude * (np.sin(rate * t + phase) - np.sin(phase))


class Street:
    """A street being furnished; nothing is placed where something else is, or will be while it moves."""

    def __init__(self, ground: Ground, random: np.random.Generator, duration: float = 0.0):
        self.ground = ground
        self.random = random
        self.things = Things()
        self.times = np.linspace(0.0, duration, max(1, int(duration / 0.25) + 1))
        self._cells: dict[tuple[int, int], list[tuple[float, float, float]]] = {}
        self._movers: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    @staticmethod
    def _footprint(size: np.ndarray, s: float, d: float, yaw: float, margin: float) -> list[tuple[float, float, float]]:
        """Circles that cover a box in plan: s, d, radius."""
        length, width = float(size[0]), float(size[1])
        if width > length:
            length, width, yaw = width, length, yaw + 0.5 * math.pi
        n = max(1, math.ceil(length / max(width, 0.5)))
        radius = min(0.465 * math.hypot(length / n, width) + margin, 0.5 * _CELL)
        c, sn = math.cos(yaw), math.sin(yaw)
        along = [((k + 0.5) / n - 0.5) * length for k in range(n)]
        return [(s + a * c, d + a * sn, radius) for a in along]

    def _free(self, circles: list[tuple[float, float, float]]) -> bool:
        for s, d, radius in circles:
            i, j = math.floor(s / _CELL), math.floor(d / _CELL)
            for cell in ((i + u, j + v) for u in (-1, 0, 1) for v in (-1, 0, 1)):
                for s1, d1, r1 in self._cells.get(cell, ()):
                    if (s - s1) ** 2 + (d - d1) ** 2 < (radius + r1) ** 2:
                        return False
        return True

    def free(self, s: float, d: float, radius: float) -> bool:
        """Whether nothing stands within a radius of at most 2.5 m of a place."""
        return self._free([(s, d, radius)])

    def block(self, s: float, d: float, radius: float) -> None:
        """Keeps a place of at most 2.5 m radius free [m]."""
        cell = (math.floor(s / _CELL), math.floor(d / _CELL))
        self._cells.setdefault(cell, []).append((s, d, min(radius, 0.5 * _CELL)))

    def track(
        self, size: np.ndarray, s: float, d: float, yaw: float, motion: tuple[float, float, float, float], margin: float
    ) -> np.ndarray:
        """The circles that a moving box covers at each of `times`, shape (times, n, 3)."""
        gone = np.array([travelled(np.array(motion), t) for t in self.times])
        circles = np.tile(np.array(self._footprint(size, s, d, yaw, margin)), (len(gone), 1, 1))
        circles[:, :, 0] += (gone * np.cos(yaw))[:, None]
        circles[:, :, 1] += (gone * np.sin(yaw))[:, None]
        return circles

    def _meets(self, track: np.ndarray) -> bool:
        """Whether circles, shape (times or 1, n, 3), touch those of something that moves."""
        low, high = track[..., :2].min((0, 1)) - 6.0, track[..., :2].max((0, 1)) + 6.0
        for other, other_low, other_high in self._movers:
            if (other_low > high).any() or (other_high < low).any():
                continue
            apart = np.hypot(other[:, :, None, 0] - track[:, None, :, 0], other[:, :, None, 1] - track[:, None, :, 1])
            if (apart < other[:, :, None, 2] + track[:, None, :, 2]).any():
                return True
        return False

    def add(
        self,
        kind: str,
        s: float,
        d: float,
        yaw: float = 0.0,
        *,
        z: float = 0.0,
        variant: int | None = None,
        scale: tuple[float, float, float] | None = None,
        motion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
        margin: float = 0.12,
        force: bool = False,
    ) -> bool:
        """Places a thing unless its place is taken, and says whether it did."""
        random = self.random
        if variant is None:
            variant = int(random.integers(KINDS[kind]))
        if scale is None:
            k = random.uniform(0.94, 1.06)
            scale = (k * random.uniform(0.97, 1.03), k * random.uniform(0.97, 1.03), k * random.uniform(0.97, 1.03))
        size = prototype(kind, variant).size * scale
        footprint = _TRUNKS.get(kind, size * _SHARES.get(kind, 1.0))
        circles = self._footprint(footprint, s, d, yaw, margin)
        if motion[0] and len(self.times) > 1:
            track = self.track(size, s, d, yaw, motion, margin)
            if self._meets(track) or not all(self._free(row) for row in track.tolist()):
                return False
            self.keep_clear(track)
        else:
            if not force and (not self._free(circles) or (self._movers and self._meets(np.array(circles)[None]))):
                return False
            for circle in circles:
                self.block(*circle)
        things = self.things
        things.kind.append(kind)
        things.variant.append(variant)
        things.pose.append((s, d, yaw, z))
        things.scale.append(scale)
        things.motion.append(motion)
        return True

    def keep_clear(self, track: np.ndarray) -> None:
        """Keeps the way of something that moves free: circles as `track` makes them."""
        self._movers.append((track, track[..., :2].min((0, 1)), track[..., :2].max((0, 1))))

    def car_kind(self, *, heavy: float = 0.05) -> str:
        """A kind of vehicle as the streets have them, a truck or a bus in a share of `heavy`."""
        if self.random.random() < heavy:
            return "truck" if self.random.random() < 0.65 else "bus"
        return _CAR_NAMES[self.random.choice(len(_CAR_NAMES), p=_CAR_SHARES)]


@dataclass(frozen=True, kw_only=True)
class StreetPlan:
    """The measures of a street [m]."""

    extent: tuple[float, float]
    half_width: float
    sidewalk: float
    parking: tuple[bool, bool]
    crossings: list[tuple[float, float]]
    style: str

    def open_at(self, s: float, margin: float = 0.0) -> bool:
        """Whether a side street is not here."""
        return all(abs(s - at) > half + margin for at, half in self.crossings)


def random_street(
    random: np.random.Generator,
    *,
    style: str,
    extent: tuple[float, float],
    duration: float = 0.0,
    crossings: int | list[tuple[float, float]] = 1,
    hilly: float = 1.0,
    bend: float = 1.0,
    parking: tuple[bool, bool] | None = None,
    sidewalk: float | None = None,
    half_width: float | None = None,
    banks: bool = False,
) -> tuple[Street, StreetPlan]:
    """A street with everything that stands still, and its measures; traffic comes afterwards.

    Args:
        random: Source of all chance.
        style: One of `STYLES`.
        extent: Where it begins and ends [m].
        duration: For how long things will move [s].
        crossings: Number of side streets, or where along the street they are and half their width [m].
        hilly: Factor on slopes.
        bend: Factor on the curvature.
        parking: Whether cars park on the left and on the right; None draws it.
        sidewalk: Width of the sidewalks [m]; None draws it.
        half_width: Of the carriageway with its parking lanes [m]; None draws it.
        banks: Whether the land beside it may rise and fall in embankments.
    """
    parking = parking or (bool(random.random() < 0.7), bool(random.random() < 0.7))
    if sidewalk is None:
        sidewalk = random.uniform(1.6, 4.0) if style != "green" else random.uniform(1.2, 2.5)
    half_width = (
        half_width or random.uniform(3.0, 3.9) + (2.2 if any(parking) else 0.0) + (random.random() < 0.15) * 3.2
    )
    places = [] if isinstance(crossings, int) else list(crossings)
    for _ in range(crossings if isinstance(crossings, int) else 0):
        at = random.uniform(extent[0] + 25, extent[1] - 25)
        if all(abs(at - other) > 30 for other, _ in places):
            places.append((float(at), float(random.uniform(2.6, 4.5))))
    plan = StreetPlan(
        extent=extent,
        half_width=half_width,
        sidewalk=sidewalk,
        parking=parking,
        crossings=places,
        style=style,
    )
    ground = street_ground(
        random,
        extent=(extent[0] - 30, extent[1] + 30),
        half_width=half_width,
        sidewalk=plan.sidewalk,
        crossings=places,
        hilly=hilly,
        curvature=bend * random.choice([0.0, random.normal(0, 0.0025)]),
        banks=banks,
    )
    street = Street(ground, random, duration)
    return street, plan


def phase_of(kind: str, gone: float, start: float) -> int:
    """The pose of a walker or rider after `gone` metres, from a random start in [0, 1)."""
    if kind == "pedestrian":
        return int(np.floor((gone / 1.45 + start) * PHASES)) % PHASES
    if kind == "cyclist":
        return int(np.floor((gone / 4.5 + start) * PHASES)) % PHASES
    return 0
