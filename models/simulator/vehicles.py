"""Vehicles: bodies lofted along a side profile, with wheels in arches, glass, seats, lamps, plates and mirrors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .labels import Material, PointClass, face_label
from .mesh import Shape, box, ellipsoid, join, loft, quad

__all__ = ["VEHICLE_KINDS", "vehicle"]


def _label(material: Material) -> int:
    return face_label(material, PointClass.VEHICLE)


@dataclass(frozen=True)
class _Body:
    """A type of car; lengths as fractions from the rear (0) to the front (1), heights as fractions of the height."""

    length: tuple[float, float]
    width: tuple[float, float]
    height: tuple[float, float]
    roof: tuple[tuple[float, float], ...]
    """Upper edge of the middle section: (fraction of length, fraction of height)."""
    belt: tuple[float, float]
    """Lower edge of the side windows at rear and front."""
    rear_glass: tuple[float, float]
    front_glass: tuple[float, float]
    pillars: tuple[float, ...]
    taper: float
    """By how much the roof is narrower than the belt, as a fraction of the width."""
    axles: tuple[float, ...]
    side_glass: tuple[float, float] = (0.0, 1.0)
    wheel: float = 0.31
    sill: float = 0.21


_BODIES = {
    "hatch": _Body(
        (3.75, 4.3), (1.64, 1.78), (1.43, 1.54),
        ((0, 0.44), (0.01, 0.58), (0.035, 0.66), (0.10, 0.88), (0.17, 0.955), (0.35, 1.0), (0.52, 0.985),
         (0.60, 0.94), (0.755, 0.665), (0.92, 0.56), (0.975, 0.49), (1, 0.38)),
        (0.65, 0.60), (0.045, 0.15), (0.60, 0.75), (0.13, 0.40, 0.66), 0.13, (0.17, 0.80),
    ),
    "mini": _Body(
        (3.3, 3.7), (1.55, 1.66), (1.44, 1.56),
        ((0, 0.42), (0.01, 0.60), (0.03, 0.68), (0.07, 0.88), (0.14, 0.965), (0.36, 1.0), (0.55, 0.98),
         (0.63, 0.93), (0.80, 0.66), (0.93, 0.57), (0.98, 0.48), (1, 0.36)),
        (0.66, 0.60), (0.04, 0.12), (0.63, 0.79), (0.12, 0.36, 0.70), 0.13, (0.14, 0.82), wheel=0.29,
    ),
    "micro": _Body(
        (2.5, 3.2), (1.48, 1.66), (1.46, 1.6),
        ((0, 0.42), (0.01, 0.60), (0.03, 0.70), (0.06, 0.90), (0.13, 0.97), (0.38, 1.0), (0.58, 0.97),
         (0.66, 0.91), (0.86, 0.64), (0.95, 0.54), (0.985, 0.46), (1, 0.34)),
        (0.66, 0.60), (0.035, 0.10), (0.66, 0.85), (0.14, 0.42, 0.74), 0.13, (0.15, 0.83), wheel=0.28,
    ),
    "sedan": _Body(
        (4.35, 4.95), (1.70, 1.86), (1.38, 1.49),
        ((0, 0.42), (0.01, 0.58), (0.03, 0.665), (0.14, 0.70), (0.19, 0.75), (0.30, 0.94), (0.36, 0.985),
         (0.46, 1.0), (0.55, 0.98), (0.60, 0.94), (0.73, 0.68), (0.93, 0.575), (0.98, 0.50), (1, 0.38)),
        (0.67, 0.63), (0.155, 0.31), (0.595, 0.725), (0.29, 0.46, 0.65), 0.14, (0.20, 0.81),
        side_glass=(0.2, 1.0), wheel=0.32,
    ),
    "coupe": _Body(
        (4.1, 4.5), (1.72, 1.82), (1.26, 1.36),
        ((0, 0.46), (0.01, 0.62), (0.03, 0.70), (0.10, 0.75), (0.24, 0.93), (0.34, 0.99), (0.42, 1.0), (0.50, 0.97),
         (0.66, 0.70), (0.90, 0.59), (0.98, 0.50), (1, 0.38)),
        (0.70, 0.66), (0.10, 0.25), (0.50, 0.65), (0.22, 0.38), 0.15, (0.19, 0.80), side_glass=(0.2, 1.0), wheel=0.32,
    ),
    "wagon": _Body(
        (4.4, 4.9), (1.72, 1.85), (1.43, 1.54),
        ((0, 0.42), (0.01, 0.58), (0.025, 0.66), (0.075, 0.90), (0.12, 0.965), (0.35, 1.0), (0.52, 0.99),
         (0.59, 0.94), (0.73, 0.665), (0.93, 0.56), (0.98, 0.49), (1, 0.38)),
        (0.65, 0.61), (0.035, 0.11), (0.59, 0.725), (0.10, 0.28, 0.46, 0.65), 0.13, (0.20, 0.81), wheel=0.32,
    ),
    "suv": _Body(
        (4.2, 4.85), (1.78, 1.95), (1.60, 1.82),
        ((0, 0.42), (0.01, 0.56), (0.025, 0.64), (0.075, 0.90), (0.12, 0.97), (0.35, 1.0), (0.56, 0.985),
         (0.62, 0.94), (0.745, 0.675), (0.94, 0.60), (0.985, 0.52), (1, 0.40)),
        (0.64, 0.61), (0.035, 0.11), (0.62, 0.74), (0.10, 0.28, 0.47, 0.66), 0.12, (0.19, 0.81),
        wheel=0.365, sill=0.28,
    ),
    "mpv": _Body(
        (4.2, 4.75), (1.72, 1.85), (1.58, 1.75),
        ((0, 0.40), (0.01, 0.55), (0.025, 0.62), (0.06, 0.88), (0.11, 0.97), (0.35, 1.0), (0.55, 0.98), (0.64, 0.92),
         (0.82, 0.63), (0.94, 0.54), (0.985, 0.46), (1, 0.34)),
        (0.60, 0.55), (0.03, 0.10), (0.64, 0.82), (0.10, 0.30, 0.48, 0.68), 0.12, (0.19, 0.81), wheel=0.32,
    ),
    "small_van": _Body(
        (4.0, 4.5), (1.70, 1.85), (1.78, 1.95),
        ((0, 0.40), (0.008, 0.70), (0.02, 0.92), (0.05, 0.985), (0.30, 1.0), (0.58, 0.985), (0.65, 0.93), (0.80, 0.60),
         (0.94, 0.51), (0.985, 0.44), (1, 0.33)),
        (0.57, 0.54), (0.012, 0.03), (0.645, 0.80), (0.44, 0.68), 0.07, (0.19, 0.80), side_glass=(0.44, 1.0),
    ),
    "van": _Body(
        (4.7, 5.6), (1.86, 2.03), (1.92, 2.5),
        ((0, 0.38), (0.006, 0.70), (0.015, 0.93), (0.04, 0.985), (0.35, 1.0), (0.68, 0.99), (0.75, 0.93), (0.885, 0.56),
         (0.97, 0.47), (0.99, 0.40), (1, 0.30)),
        (0.55, 0.51), (0.012, 0.03), (0.745, 0.88), (0.58, 0.78), 0.07, (0.19, 0.82), side_glass=(0.58, 1.0),
        wheel=0.335, sill=0.26,
    ),
    "minibus": _Body(
        (4.8, 5.4), (1.88, 2.0), (1.92, 2.05),
        ((0, 0.38), (0.008, 0.66), (0.02, 0.90), (0.05, 0.98), (0.35, 1.0), (0.68, 0.99), (0.75, 0.93), (0.89, 0.57),
         (0.97, 0.48), (0.99, 0.40), (1, 0.30)),
        (0.54, 0.51), (0.018, 0.04), (0.745, 0.885), (0.05, 0.33, 0.57, 0.78), 0.08, (0.2, 0.82),
        wheel=0.335, sill=0.25,
    ),
}  # fmt: skip
_PAINTS = (Material.DARK_PAINT, Material.PAINT, Material.PAINT, Material.BRIGHT_PAINT, Material.BRIGHT_PAINT)


def _wheels(axles: list[float], half_track: float, radius: float, width: float = 0.2) -> Shape:
    """Four or more wheels, their outer faces at ± half_track."""
    parts = []
    for x in axles:
        for side in (-1.0, 1.0):
            outer, inner = side * half_track, side * (half_track - width)
            angle = np.arange(14) * (2 * np.pi / 14)
            # Tread, then the shoulder, then the dish of the rim.
            rings = []
            for y, r in ((inner, radius), (outer - side * 0.015, radius), (outer, 0.93 * radius),
                         (outer, 0.66 * radius), (outer - side * 0.05, 0.6 * radius),
                         (outer - side * 0.03, 0.05)):  # fmt: skip
                rings.append(np.stack([x + r * np.cos(angle), np.full(14, y), radius + r * np.sin(angle)], 1))
            cells = np.array([Material.TYRE, Material.TYRE, Material.TYRE, Material.METAL, Material.METAL])
            labels = np.repeat((cells + 256 * PointClass.VEHICLE)[:, None], 14, 1)
            parts.append(loft(np.array(rings), labels, closed=True))
    return join(*parts)


def _car(body: _Body, random: np.random.Generator) -> Shape:
    length, width, height = (random.uniform(*limits) for limits in (body.length, body.width, body.height))
    paint = _label(_PAINTS[random.integers(len(_PAINTS))])
    knots = np.array(body.roof)
    jitter = random.uniform(-0.012, 0.012, (len(knots), 2)) * ((knots[:, :1] > 0.08) & (knots[:, :1] < 0.92))
    knots = knots + jitter
    wheel = body.wheel * random.uniform(0.94, 1.06)
    axles = [(a - 0.5) * length for a in body.axles]
    bows, power = random.uniform(0.06, 0.22, 2), random.uniform(2.2, 4.0)
    tinted = random.random() < 0.7
    arch = wheel + 0.05

    fractions = np.unique(
        np.round(
            np.concatenate([
                np.linspace(0, 1, 33), knots[:, 0], [0.004, 0.012, 0.985, 0.994], body.pillars,
                np.array(body.pillars) + 0.022, body.rear_glass, body.front_glass,
                *(np.array(a) + np.linspace(-1, 1, 7) * arch / length for a in body.axles),
            ]).clip(0, 1), 4,
        )
    )  # fmt: skip
    x = (fractions - 0.5) * length
    top = np.interp(fractions, knots[:, 0], knots[:, 1] * height / knots[:, 1].max())
    belt = np.interp(fractions, [0, 1], body.belt) * height
    cabin = top > belt + 0.03
    # In plan flanks are bowed, vans' less behind: full width amidships, narrower by some 0.3 m at the bumpers.
    end = np.abs(2 * fractions - 1)
    bow = np.where(fractions > 0.5, bows[0], bows[1] * (1.0 if body.taper > 0.1 else 0.3)) * end**power
    half = 0.5 * width * (1 - bow - 0.12 * np.clip((end - 0.86) / 0.14, 0, 1) ** 2.5)
    sill = np.interp(fractions, [0, 0.03, 0.08, 0.92, 0.97, 1], np.array([1.55, 1.2, 1, 1, 1.15, 1.35]) * body.sill)
    low = sill.copy()
    for axle in axles:
        inside = np.abs(x - axle) < arch
        low[inside] = np.maximum(low[inside], wheel + np.sqrt(arch**2 - (x[inside] - axle) ** 2))
    low = np.minimum(low, top - 0.16)
    edge = np.where(cabin, belt, np.maximum(top - 0.05, low + 0.1))
    taper = body.taper * width * np.clip((top - belt) / (height - belt), 0, 1)
    cant = np.where(cabin, half - taper, 0.88 * half)
    middle = np.maximum(0.55 * edge + 0.45 * low, low + 0.03)
    round_roof = np.where(cabin, np.minimum(0.06, 0.5 * (top - edge)), 0.012)

    zero = np.zeros_like(x)
    profile = [  # (y, z) from below the middle, up the side, to the middle of the roof
        (zero, sill * 0.9), (0.60 * half, sill * 0.9), (0.955 * half, low), (half, middle), (0.975 * half, edge),
        (cant, top - round_roof), (0.8 * cant, top - 0.15 * round_roof), (zero, top),
    ]  # fmt: skip
    right = np.stack([np.stack([x, -y, z], 1) for y, z in profile], 1)
    left = right[:, -2:0:-1] * np.array([1.0, -1.0, 1.0])
    sections = np.concatenate([right, left], 1)

    glass, interior = _label(Material.GLASS), _label(Material.INTERIOR)
    labels = np.full((len(x) - 1, sections.shape[1]), paint, np.int32)
    labels[:, [0, 13]] = interior
    labels[:, [1, 12]] = _label(Material.TYRE)
    mid = 0.5 * (fractions[1:] + fractions[:-1])
    cell_cabin = cabin[1:] & cabin[:-1]
    pillar = np.zeros(len(mid), bool)
    for p in body.pillars:
        pillar |= (mid > p) & (mid < p + 0.022)
    side = cell_cabin & ~pillar & (mid > max(body.side_glass[0], 0.05)) & (mid < body.front_glass[1] - 0.03)
    side &= mid < body.side_glass[1]
    rear_glass = _label(Material.TINTED) if tinted else glass
    labels[np.ix_(side, [4, 9])] = glass
    labels[np.ix_(side & (mid < body.pillars[max(len(body.pillars) - 2, 0)]), [4, 9])] = rear_glass
    for (start, stop), pane in ((body.rear_glass, rear_glass), (body.front_glass, glass)):
        screen = (mid > start) & (mid < stop)
        labels[np.ix_(screen, [5, 6, 7, 8])] = pane
    for ends in ((mid > 0.955) & (mid < 0.99), (mid < 0.02) & (mid > 0.004)):
        labels[np.ix_(ends, [3, 10])] = _label(Material.LAMP)
    shell = loft(sections, labels, closed=True, caps=paint)

    front, back = 0.5 * length, -0.5 * length
    parts = [shell, *(_wheels([axle], float(np.interp(axle, x, half)) - 0.015, wheel) for axle in axles)]
    floor, seat = 0.28 * height, 0.68 * height
    for fraction, reach in ((0.52, 1.0), (0.30, 1.0)):
        if fraction < body.side_glass[0]:
            continue
        at = (fraction - 0.5) * length
        for y in (-0.25 * width, 0.25 * width):
            parts.append(box((at - 0.1, y - 0.22, floor), (at + 0.02, y + 0.22, seat * reach), interior))
            parts.append(box((at, y - 0.22, floor), (at + 0.45, y + 0.22, 0.4 * height), interior))
            parts.append(box((at - 0.08, y - 0.13, seat), (at + 0.02, y + 0.13, 0.82 * height), interior))
    if body.side_glass[0] < 0.3:
        # The shelf behind the seats: beams that come in through a window do not meet the tailgate from within.
        shelf = (np.array([max(body.rear_glass[0], 0.015), 0.32]) - 0.5) * length
        parts.append(box((shelf[0], -0.4 * width, 0.54 * height), (shelf[1], 0.4 * width, 0.6 * height), interior))
    dash = (body.front_glass[1] - 0.5) * length
    parts.append(box((dash - 0.65, -0.42 * width, floor), (dash - 0.2, 0.42 * width, 0.58 * height), interior))
    plate, at = _label(Material.PLATE), 0.30 * height
    for end_x in (front - 0.004, back + 0.004):
        parts.append(
            quad(
                np.array([[end_x, -0.26, at], [end_x, 0.26, at], [end_x, 0.26, at + 0.11], [end_x, -0.26, at + 0.11]]),
                plate,
            )
        )
    mirror_x = (body.front_glass[1] - 0.055 - 0.5) * length
    mirror_z = float(np.interp(body.front_glass[1] - 0.05, [0, 1], body.belt)) * height + 0.07
    for side_y in (-1.0, 1.0):
        parts.append(
            ellipsoid((mirror_x, side_y * (0.5 * width + 0.05), mirror_z), (0.06, 0.11, 0.07), paint, 4).unboxed()
        )
    return join(*parts).centred()


def _truck(random: np.random.Generator) -> Shape:
    length, width, height = random.uniform(6.0, 10.0), random.uniform(2.2, 2.5), random.uniform(2.7, 3.6)
    cab = random.uniform(1.7, 2.1)
    paint = _label(_PAINTS[random.integers(len(_PAINTS))])
    load = _label(_PAINTS[random.integers(len(_PAINTS))])
    front, back = 0.5 * length, -0.5 * length
    glass, dark = _label(Material.GLASS), _label(Material.INTERIOR)
    cab_height = min(height, random.uniform(2.3, 2.9))
    x = front - np.array([cab, cab - 0.05, 0.35, 0.22, 0.1, 0.02, 0.0])
    top = cab_height * np.array([0.97, 1.0, 1.0, 0.97, 0.62, 0.5, 0.42])
    half = 0.5 * width * np.array([0.97, 0.99, 0.99, 0.97, 0.96, 0.93, 0.9])
    low, belt = np.full(7, 0.42), np.minimum(top - 0.05, 0.55 * cab_height)
    rows = [(half, low), (half, belt), (0.93 * half, top - 0.04), (0.0 * half, top)]
    right = np.stack([np.stack([x, -y, z], 1) for y, z in rows], 1)
    sections = np.concatenate([right, right[:, -2::-1] * np.array([1.0, -1.0, 1.0])], 1)
    labels = np.full((6, 7), paint, np.int32)
    labels[np.ix_([1], [1, 4])] = glass
    labels[np.ix_([3], [1, 2, 3, 4])] = glass
    parts = [loft(sections, labels, closed=True, caps=paint)]
    parts.append(box((front - cab + 0.15, -0.4 * width, 0.9), (front - cab + 0.5, 0.4 * width, 0.7 * cab_height), dark))
    bed = random.uniform(0.85, 1.15)
    if random.random() < 0.75:
        parts.append(box((back, -0.5 * width, bed), (front - cab - 0.12, 0.5 * width, height), load))
    else:
        rail = _label(Material.METAL)
        parts.append(box((back, -0.5 * width, bed), (front - cab - 0.12, 0.5 * width, bed + 0.12), rail))
        for y in (-0.5 * width, 0.5 * width - 0.05):
            parts.append(box((back, y, bed), (front - cab - 0.12, y + 0.05, bed + 0.5), rail))
        cargo = random.uniform(0.3, 1.2)
        parts.append(
            box((back + 0.3, -0.4 * width, bed), (front - cab - 1.0, 0.4 * width, bed + cargo), _label(Material.WOOD))
        )
    for y in (-0.38 * width, 0.28 * width):
        parts.append(box((back + 0.1, y, 0.6), (front - 0.3, y + 0.2, 0.85), dark))
    parts.append(box((back, -0.45 * width, 0.45), (back + 0.1, 0.45 * width, 0.58), _label(Material.METAL)))
    axles = [front - 0.75 * cab, back + 1.4] + ([back + 2.6] if length > 8 else [])
    parts.append(_wheels(axles, 0.48 * width, 0.46, 0.3))
    parts.append(quad(np.array([[back - 0.004, -0.26, 0.6], [back - 0.004, 0.26, 0.6],
                                [back - 0.004, 0.26, 0.72], [back - 0.004, -0.26, 0.72]]),
                      _label(Material.PLATE)))  # fmt: skip
    for side_y in (-1.0, 1.0):
        at = side_y * (0.5 * width + 0.15)
        parts.append(
            box((front - 0.25, at - 0.1, 1.6), (front - 0.15, at + 0.1, 2.1), dark).unboxed()
        )  # fmt: skip
    return join(*parts).centred()


def _bus(random: np.random.Generator) -> Shape:
    length, width, height = random.uniform(9.0, 12.2), random.uniform(2.45, 2.55), random.uniform(2.85, 3.2)
    paint = _label(_PAINTS[1 + random.integers(len(_PAINTS) - 1)])
    panes = np.linspace(0.015, 0.985, 20)
    fractions = np.unique(np.concatenate([panes, panes[1:-1] + 0.008, [0, 0.004, 0.995, 1]]))  # fmt: skip
    end = np.abs(2 * fractions - 1)
    x = (fractions - 0.5) * length
    half = 0.5 * width * (1 - 0.12 * np.clip((end - 0.97) / 0.03, 0, 1) ** 2)
    top = height * (1 - 0.1 * np.clip((end - 0.97) / 0.03, 0, 1) ** 2)
    rows = [(half * 0.97, np.full_like(x, 0.32)), (half, np.full_like(x, 0.6)), (half, np.full_like(x, 1.15)),
            (0.98 * half, top - 0.55), (0.95 * half, top - 0.06), (0.0 * half, top)]  # fmt: skip
    right = np.stack([np.stack([x, -y, z], 1) for y, z in rows], 1)
    sections = np.concatenate([right, right[:, -2::-1] * np.array([1.0, -1.0, 1.0])], 1)
    labels = np.full((len(x) - 1, sections.shape[1]), paint, np.int32)
    wide = np.diff(fractions) > 0.02
    labels[np.ix_(wide, [2, 7])] = _label(Material.GLASS)
    parts = [loft(sections, labels, closed=True, caps=_label(Material.GLASS))]
    seat = _label(Material.INTERIOR)
    for at in np.arange(-0.45 * length, 0.4 * length, 0.9):
        for y in (-0.28 * width, 0.28 * width):
            parts.append(box((at, y - 0.4, 0.5), (at + 0.1, y + 0.4, 1.5), seat))
    parts.append(_wheels([0.5 * length - 2.6, -0.5 * length + 3.0], 0.495 * width, 0.48, 0.3))
    return join(*parts).centred()


def _pickup(random: np.random.Generator) -> Shape:
    """The front half of a wagon with an open bed behind."""
    length, width, height = random.uniform(5.0, 5.6), random.uniform(1.85, 2.0), random.uniform(1.75, 1.9)
    cab = _Body(
        (0.62 * length,) * 2, (width,) * 2, (height,) * 2,
        ((0, 0.5), (0.01, 0.8), (0.04, 0.95), (0.15, 1.0), (0.38, 0.98), (0.45, 0.94), (0.60, 0.66), (0.94, 0.58),
         (0.98, 0.5), (1, 0.4)),
        (0.62, 0.6), (0.01, 0.03), (0.44, 0.6), (0.24, 0.5), 0.12, (0.74,), wheel=0.37, sill=0.32,
    )  # fmt: skip
    front = _car(cab, random).moved(x=0.19 * length)
    paint = front.labels[0] if front.labels[0] >> 8 == PointClass.VEHICLE else _label(Material.PAINT)
    back, seam = -0.5 * length, -0.12 * length
    parts = [front, box((back, -0.47 * width, 0.5), (seam, 0.47 * width, 0.62), paint)]
    for y in (-0.5 * width, 0.5 * width - 0.06):
        parts.append(box((back, y, 0.6), (seam, y + 0.06, 1.08), paint))
    parts.append(box((back, -0.48 * width, 0.6), (back + 0.06, 0.48 * width, 1.06), paint))
    parts.append(_wheels([back + 0.22 * length], 0.5 * width - 0.02, 0.37))
    return join(*parts).centred()


VEHICLE_KINDS = (*_BODIES, "pickup", "truck", "bus")
"""What `vehicle` can build."""


def vehicle(kind: str, random: np.random.Generator) -> Shape:
    """A vehicle of one of `VEHICLE_KINDS`, of random size and paint, facing +x, centred over the origin.

    Raises:
        ValueError: There is no such kind.
    """
    if kind in _BODIES:
        return _car(_BODIES[kind], random)
    builders = {"pickup": _pickup, "truck": _truck, "bus": _bus}
    if kind not in builders:
        raise ValueError(f"kind must be one of {', '.join(VEHICLE_KINDS)}, not {kind!r}")
    return builders[kind](random)
