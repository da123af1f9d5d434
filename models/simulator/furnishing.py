"""What fills a street: plots and their houses, furniture along the curb, parked cars, people and traffic."""

from __future__ import annotations

import numpy as np

from .library import KINDS, prototype
from .street import Street, StreetPlan
from .vehicles import VEHICLE_KINDS

__all__ = ["furnish", "grow", "populate"]

_PLOTS = {  # facade, house, green, lot, wall, field
    "urban": (0.62, 0.06, 0.10, 0.06, 0.12, 0.04),
    "residential": (0.10, 0.52, 0.20, 0.04, 0.10, 0.04),
    "green": (0.03, 0.15, 0.55, 0.07, 0.08, 0.12),
    "commercial": (0.25, 0.05, 0.15, 0.38, 0.10, 0.07),
}


def _plots(street: Street, plan: StreetPlan, side: int) -> None:
    """Fills what lies behind the sidewalk of one side, plot by plot."""
    random, add = street.random, street.add
    shares = np.array(_PLOTS[plan.style])
    line = plan.half_width + plan.sidewalk
    yaw = 0.0 if side > 0 else np.pi
    s = plan.extent[0] + random.uniform(0, 6)
    kind = int(random.choice(6, p=shares))
    while s < plan.extent[1]:
        if not plan.open_at(s, plan.sidewalk + 0.5):
            s += 1.0
            continue
        if kind == 3 or random.random() < 0.45:
            kind = int(random.choice(6, p=shares))
        if kind == 0:
            variant = int(random.integers(KINDS["facade"]))
            width = float(prototype("facade", variant).size[0])
            if plan.open_at(s + width, plan.sidewalk) and plan.open_at(s + width / 2, plan.sidewalk + width / 2):
                back = random.choice([0.0, 0.0, random.uniform(0.5, 3.0)])
                add(
                    "facade",
                    s + width / 2,
                    side * (line + 0.15 + back),
                    yaw,
                    variant=variant,
                    scale=(1, 1, 1),
                    force=True,
                )
                for x in np.arange(s, s + width, 1.5):
                    street.block(x, side * (line + back + 1.6), 1.3)
                if random.random() < 0.3:
                    add("table", s + random.uniform(1, width - 1), side * (line - 0.7))
            s += width + (random.uniform(1.5, 5) if random.random() < 0.2 else 0.02)
        elif kind == 1:
            variant = int(random.integers(KINDS["facade"]))
            width = float(prototype("facade", variant).size[0])
            garden = random.uniform(3.5, 9)
            plot = width + random.uniform(1, 6)
            if plan.open_at(s + plot / 2, plan.sidewalk + plot / 2):
                add("facade", s + plot / 2, side * (line + garden), yaw, variant=variant, scale=(1, 1, 1), force=True)
                for x in np.arange(s + (plot - width) / 2, s + (plot + width) / 2, 1.5):
                    street.block(x, side * (line + garden + 1.6), 1.3)
                boundary = ("hedge", "wall", "fence", "fence", "")[random.integers(5)]
                if random.random() < 0.5:
                    drive = s + random.uniform(1.5, 2.5)
                    add(street.car_kind(heavy=0.0), drive, side * (line + random.uniform(2.6, 3.4)),
                        random.choice([-1, 1]) * np.pi / 2 + random.normal(0, 0.06))  # fmt: skip
                x = s + 4.0
                while boundary and x < s + plot - 2:
                    variant = int(random.integers(KINDS[boundary]))
                    length = float(prototype(boundary, variant).size[0])
                    add(
                        boundary,
                        x + length / 2,
                        side * (line + 0.45),
                        yaw,
                        variant=variant,
                        scale=(1, 1, random.uniform(0.7, 1.1)),
                        margin=-0.2,
                    )
                    x += length
                for _ in range(random.integers(2, 7)):
                    add(
                        "bush",
                        s + random.uniform(0, plot),
                        side * (line + random.uniform(0.8, max(1.0, garden - 1))),
                        random.uniform(0, 6.3),
                    )
                if random.random() < 0.6:
                    add(
                        "tree",
                        s + random.uniform(0, plot),
                        side * (line + random.uniform(1.2, max(1.3, garden - 1))),
                        random.uniform(0, 6.3),
                    )
                if random.random() < 0.35:
                    add("bin", s + random.uniform(0, plot), side * (line - 0.4), yaw - np.pi / 2)
            s += plot
        elif kind == 2:
            plot = random.uniform(10, 22)
            for _ in range(random.integers(2, 6)):
                add(
                    "tree", s + random.uniform(0, plot), side * (line + random.uniform(0.5, 22)), random.uniform(0, 6.3)
                )
            for _ in range(random.integers(5, 15)):
                add(
                    "bush",
                    s + random.uniform(0, plot),
                    side * (line + random.gamma(1.5, 3.0) + 0.4),
                    random.uniform(0, 6.3),
                )
            if random.random() < 0.5:
                x = s
                while x < s + plot - 4:
                    if random.random() < 0.8:
                        add("hedge", x + 3, side * (line + 0.8), yaw, margin=-0.2)
                    x += random.uniform(6, 9)
            s += plot
        elif kind == 3:
            plot, angle = random.uniform(16, 32), random.choice([0.0, np.pi / 2, np.pi / 2, np.pi / 3, -np.pi / 3])
            pitch = 5.6 if angle == 0.0 else 2.6
            for row in range(random.integers(1, 4)):
                depth = line + 3.2 + 6.2 * row
                for x in np.arange(s + 1.5, s + plot - 1, pitch):
                    if plan.open_at(x, plan.sidewalk + 2) and random.random() < 0.65:
                        heading = angle + random.choice([0, np.pi]) + random.normal(0, 0.04)
                        add(street.car_kind(), x, side * depth + random.normal(0, 0.2), heading)
            if random.random() < 0.7:
                x = s
                while x < s + plot - 8:
                    variant = int(random.integers(KINDS["facade"]))
                    width = float(prototype("facade", variant).size[0])
                    add("facade", x + width / 2, side * (line + 24), yaw, variant=variant, scale=(1, 1, 1), force=True)
                    x += width
            for _ in range(random.integers(1, 5)):
                add("lamp_post", s + random.uniform(0, plot), side * (line + random.uniform(0.6, 18)))
            s += plot
        elif kind == 4:
            name = ("wall", "fence", "hedge")[random.integers(3)]
            stop = s + random.uniform(10, 25)
            while s < stop and plan.open_at(s + 4, plan.sidewalk + 3):
                variant = int(random.integers(KINDS[name]))
                length = float(prototype(name, variant).size[0])
                add(name, s + length / 2, side * (line + 0.35), yaw, variant=variant, scale=(1, 1, 1), margin=-0.2)
                if random.random() < 0.5:
                    add("bush", s + random.uniform(0, length), side * (line + random.uniform(1.5, 3)))
                if random.random() < 0.35:
                    add("tree", s + random.uniform(0, length), side * (line + random.uniform(2, 8)))
                s += length
            s += random.uniform(1, 4)
        else:
            plot = random.uniform(8, 16)
            for _ in range(random.integers(0, 4)):
                name = ("bush", "tree", "stairs", "cabinet")[random.integers(4)]
                add(name, s + random.uniform(0, plot), side * (line + random.uniform(1, 25)), random.uniform(0, 6.3))
            s += plot


def _backdrop(street: Street, plan: StreetPlan, side: int) -> None:
    """Closes the view behind the plots with houses, trees and thickets, and down the side streets."""
    random, add = street.random, street.add
    line = plan.half_width + plan.sidewalk
    s = plan.extent[0]
    while s < plan.extent[1]:
        depth = random.uniform(13, 34)
        draw = random.random()
        if not plan.open_at(s, plan.sidewalk + 1.0) or draw > 0.85:
            s += random.uniform(2, 6)
        elif draw < 0.3:
            variant = int(random.integers(KINDS["facade"]))
            width = float(prototype("facade", variant).size[0])
            if plan.open_at(s + width / 2, plan.sidewalk + width / 2):
                add(
                    "facade",
                    s + width / 2,
                    side * (line + depth + 6),
                    0.0 if side > 0 else np.pi,
                    variant=variant,
                    margin=-0.5,
                )
            s += width
        else:
            add("thicket" if draw < 0.68 else "tree", s + 3, side * (line + depth), random.normal(0, 0.3))
            s += random.uniform(3, 7)
    for at, half in plan.crossings:
        for k in (-1, 1):
            yaw = -k * np.pi / 2
            d = line + random.uniform(1, 8)
            while d < 60:
                name = ("facade", "facade", "thicket", "hedge", "wall", "fence", "tree")[random.integers(7)]
                variant = int(random.integers(KINDS[name]))
                length = float(prototype(name, variant).size[0])
                away = half + plan.sidewalk + (random.uniform(0.2, 1.0) if name != "thicket" else 2.0)
                add(name, at + k * away, side * (d + length / 2), yaw, variant=variant, margin=-0.3)
                d += length + random.choice([0.0, random.uniform(1, 5)])


def _furniture(street: Street, plan: StreetPlan, side: int) -> None:
    """Sets lamps, trees, signs and small things along the curb of one side."""
    random, add = street.random, street.add
    curb, line = plan.half_width + 0.45, plan.half_width + plan.sidewalk
    low, high = plan.extent
    yaw = 0.0 if side > 0 else np.pi
    for s in np.arange(low + random.uniform(0, 20), high, random.uniform(18, 32)):
        if plan.open_at(s, 1.5):
            add("lamp_post", s, side * curb, yaw)
    if random.random() < 0.6:
        step = random.uniform(6, 13)
        for s in np.arange(low + random.uniform(0, 8), high, step):
            if plan.open_at(s, 2.5) and random.random() < 0.85:
                add("tree", s, side * (curb + 0.15), random.uniform(0, 6.3))
    count = int((high - low) / 5)
    names = ("sign", "sign", "sign", "bin", "cabinet", "hydrant", "bike_rack", "bike_rack", "motorbike", "bollard",
             "table", "stairs", "bush", "bus_stop")  # fmt: skip
    for _ in range(count):
        name = names[random.integers(len(names))]
        s = random.uniform(low, high)
        if not plan.open_at(s, 1.5):
            continue
        inner = random.random() < 0.45
        d = random.uniform(line - 0.7, line - 0.3) if inner else curb + random.uniform(0, 0.35)
        if name in ("bike_rack", "motorbike"):
            heading = np.pi / 2 + random.normal(0, 0.3) if random.random() < 0.6 else random.normal(0, 0.2)
        elif name == "sign":
            heading = random.choice([0.0, np.pi]) + random.normal(0, 0.2)
        else:
            heading = yaw + random.normal(0, 0.05)
        if name == "bollard":
            for k in range(random.integers(2, 7)):
                add(name, s + 1.5 * k, side * (plan.half_width + 0.3))
        else:
            add(name, s, side * d, heading)
    for at, half in plan.crossings:
        for k in (-1, 1):
            add(
                "lamp_post" if random.random() < 0.4 else "sign",
                at + k * (half + 0.6),
                side * curb,
                random.uniform(-0.3, 0.3),
            )


def _parked(street: Street, plan: StreetPlan, share: float) -> None:
    """Parks cars along the curbs, and in the side streets."""
    random = street.random
    low, high = plan.extent
    for side, parking in zip((1, -1), plan.parking, strict=True):
        if not parking:
            continue
        s = low + random.uniform(0, 8)
        dense = share * random.uniform(0.6, 1.3)
        while s < high:
            kind = street.car_kind(heavy=0.03)
            variant = int(random.integers(KINDS[kind]))
            length, width = prototype(kind, variant).size[:2]
            at = s + length / 2
            if plan.open_at(at, 5.0) and random.random() < dense:
                heading = (0.0 if (side < 0) == (random.random() < 0.9) else np.pi) + random.normal(0, 0.025)
                d = side * (plan.half_width - 0.18 - width / 2 - abs(random.normal(0, 0.1)))
                street.add(kind, at, d, heading, variant=variant)
            s += length + random.uniform(0.6, 1.8)
    for at, half in plan.crossings:
        for side in (1, -1):
            for lane in (1, -1):
                d = plan.half_width + plan.sidewalk + 4
                while d < 60:
                    if random.random() < 0.4 * share:
                        street.add(
                            street.car_kind(), at + lane * (half - 1.0), side * d, np.pi / 2 + random.choice([0, np.pi])
                        )
                    d += random.uniform(5.3, 8)


def furnish(street: Street, plan: StreetPlan, parked: float) -> None:
    """Puts everything on the street that stands still."""
    _parked(street, plan, parked)
    for side in (1, -1):
        _furniture(street, plan, side)
        _plots(street, plan, side)
        _backdrop(street, plan, side)


def grow(street: Street, plan: StreetPlan, density: float) -> None:
    """Lets hedges, thickets, bushes and trees grow where there is room beside the street.

    Real suburbs have three times as many points on plants as streets without it (`bench/simulator_realism.py`). Scrub,
    sheds and heaps stand among them, and plants that touch parked cars: what is easily taken for a car, or hides one.

    Args:
        street: As furnished so far.
        plan: Its measures.
        density: From 0, nothing, to 1.5: green walls on both sides.
    """
    random, add = street.random, street.add
    low, high = plan.extent
    line = plan.half_width + plan.sidewalk
    for side in (1, -1):
        yaw = 0.0 if side > 0 else np.pi
        for _ in range(int(2.5 * density * (high - low))):
            s = random.uniform(low, high)
            if not plan.open_at(s, plan.sidewalk + 2.0):
                continue
            back = random.gamma(1.1, 2.2)
            draw = random.random()
            if draw < 0.36:
                tall = random.uniform(0.9, 1.7)
                add("hedge", s, side * (line + 0.7 + 0.4 * back), yaw, scale=(1.0, 1.0, tall), margin=-0.35)
            elif draw < 0.66:
                scale = random.uniform(0.6, 1.1)
                add("thicket", s, side * (line + 1.6 + back), yaw + random.normal(0, 0.1),
                    scale=(scale, scale, random.uniform(0.6, 1.0)), margin=-0.8)  # fmt: skip
            elif draw < 0.9:
                grown = random.uniform(1.0, 1.7)
                add("bush", s, side * (line + 0.6 + back), random.uniform(0, 6.3), scale=(grown, grown, grown),
                    margin=-0.3)  # fmt: skip
            else:
                add("tree", s, side * (line + 0.8 + back), random.uniform(0, 6.3))
        for _ in range(int(density * random.uniform(0.0, 0.5) * (high - low))):
            s, d = random.uniform(low, high), line + random.uniform(0.3, 6.0) * random.choice([1.0, 1.0, 6.0])
            if plan.open_at(s, plan.sidewalk + 2.0):
                add("scrub", s, side * d, random.uniform(0, 6.3), margin=-0.3)
        for _ in range(random.integers(0, 6)):
            s, d = random.uniform(low, high), line + random.uniform(1.0, 6.0) * random.choice([1.0, 4.0])
            if plan.open_at(s, plan.sidewalk + 3.0):
                turned = random.choice([0.0, np.pi / 2]) + random.normal(0, 0.2)
                add(("shed", "heap")[random.integers(2)], s, side * d, turned)
    _overgrow(street, plan)


def clutter(street: Street, plan: StreetPlan) -> None:
    """Adds what a head that had not seen it took for a car or missed: columns, gates, dense shrubs, beds, cars of 3 m.

    Args:
        street: As furnished so far, before it is grown over; some of its small parked cars become smaller.
        plan: Its measures.
    """
    random, add, things = street.random, street.add, street.things
    low, high = plan.extent
    line = plan.half_width + plan.sidewalk
    for kind, most in (("column", 9), ("gate", 8), ("topiary", 24)):
        for _ in range(random.integers(0, most)):
            s, side = random.uniform(low, high), random.choice([-1, 1])
            near = plan.half_width + random.uniform(0.9, max(1.0, plan.sidewalk - 0.3))
            d = near if kind == "column" and random.random() < 0.5 else line + random.gamma(1.1, 2.5)
            if plan.open_at(s, plan.sidewalk + 2.0):
                add(kind, s, side * d, random.choice([0.0, 0.5 * np.pi]) + random.normal(0, 0.15), margin=0.0)
    for k in range(len(things)):
        if things.kind[k] in ("mini", "hatch", "coupe") and random.random() < 0.2:
            things.kind[k] = "micro"
    # Beds lie along the curb and in front gardens, bastions hold up gardens above the sidewalk.
    for kind, most, deep in (("flower_bed", 40, 2.0), ("bastion", 40, None), ("panel", 16, 3.0)):
        for _ in range(random.integers(0, most)):
            s, side = random.uniform(low, high), random.choice([-1, 1])
            d = line + (random.gamma(1.1, deep) if deep else random.uniform(0.8, 7.0))
            turned = (0.0 if side > 0 else np.pi) + random.normal(0, 0.1)
            if kind != "bastion" and random.random() < 0.4:
                turned = random.uniform(0.0, 2.0 * np.pi)
            if plan.open_at(s, plan.sidewalk + 2.0):
                add(kind, s, side * d, turned, margin=0.0)


def _overgrow(street: Street, plan: StreetPlan) -> None:
    """Lets a plant touch some of the vehicles that stand beside the street or at its edge."""
    random, things = street.random, street.things
    parked = [
        k
        for k in range(len(things))
        if things.kind[k] in VEHICLE_KINDS
        and not things.motion[k][0]
        and abs(things.pose[k][1]) > plan.half_width - 2.5
    ]
    for k in random.permutation(parked)[: random.integers(0, 1 + len(parked) // 3 + 1)]:
        s, d, yaw, _ = things.pose[k]
        width = float(prototype(things.kind[k], things.variant[k]).size[1])
        kind = ("bush", "scrub", "hedge")[random.integers(3)]
        variant = int(random.integers(KINDS[kind]))
        away = 0.5 * width + 0.5 * float(prototype(kind, variant).size[1]) + random.uniform(-0.15, 0.4)
        away *= 1.0 if np.cos(yaw) * d > 0 else -1.0  # behind it, as seen from the street
        street.add(kind, s - away * np.sin(yaw) + random.uniform(-1, 1) * np.cos(yaw), d + away * np.cos(yaw), yaw,
                   variant=variant, force=True)  # fmt: skip


def populate(street: Street, plan: StreetPlan, *, walkers: int, riders: int, cars: int, works: int) -> None:
    """Puts people, riders, traffic and road works on the street."""
    random, add = street.random, street.add
    low, high = plan.extent
    lane = 1.7
    for _ in range(works):
        s, side = random.uniform(low, high), random.choice([-1, 1])
        d = side * (plan.half_width - random.uniform(0.5, 2.0))
        for k in range(random.integers(3, 9)):
            add(
                "cone",
                s + 2.0 * k + random.normal(0, 0.2),
                d + random.normal(0, 0.15),
                random.uniform(0, 6.3),
                margin=0.0,
            )
        for _ in range(random.integers(1, 4)):
            add(
                "barrier",
                s + random.uniform(-2, 14),
                d + side * random.uniform(0.6, 1.8),
                random.choice([0, np.pi / 2]) + random.normal(0, 0.2),
            )
        street_kind = "pedestrian" if random.random() < 0.5 else "stander"
        add(street_kind, s + random.uniform(0, 8), d + side * 1.0, random.uniform(0, 6.3))
    for k in range(cars):
        side = -1 if k % 2 else 1
        speed = random.uniform(5, 11)
        add(street.car_kind(heavy=0.1), random.uniform(low, high), side * lane + random.normal(0, 0.15),
            0.0 if side < 0 else np.pi, motion=(speed, random.uniform(0, 1), 0.6, random.uniform(0, 6.3)))  # fmt: skip
    for _ in range(riders):
        side = random.choice([-1, 1])
        d = side * (
            lane + 1.3
            if random.random() < 0.6
            else plan.half_width + random.uniform(0.8, max(1.0, plan.sidewalk - 0.5))
        )
        heading = (0.0 if (side < 0) == (random.random() < 0.85) else np.pi) + random.normal(0, 0.03)
        add(
            "cyclist",
            random.uniform(low, high),
            d,
            heading,
            motion=(random.uniform(2.5, 6.5), 0.3, 1.0, random.uniform(0, 6.3)),
        )
    for _ in range(walkers):
        side = random.choice([-1, 1])
        # Between lamp posts at the curb and what leans on the houses.
        strip = (1.0, plan.sidewalk - 0.9) if plan.sidewalk > 2.2 else (0.7, max(0.8, plan.sidewalk - 0.5))
        s, d = random.uniform(low, high), side * (plan.half_width + random.uniform(*strip))
        draw = random.random()
        if draw < 0.22:
            add("stander", s, d, random.uniform(0, 6.3), margin=0.05)
            continue
        heading = random.choice([0.0, np.pi]) + random.normal(0, 0.05)
        if draw > 0.9:
            d, heading = side * random.uniform(0, plan.half_width), -side * np.pi / 2 + random.normal(0, 0.2)
        speed = random.uniform(0.8, 1.7)
        add("pedestrian", s, d, heading, motion=(speed, 0.05, 2.0, random.uniform(0, 6.3)), margin=0.05)
        if random.random() < 0.25:
            add("pedestrian", s, d + 0.65, heading, motion=(speed, 0.05, 2.0, random.uniform(0, 6.3)), margin=-0.15)
