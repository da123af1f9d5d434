"""What a drive of the simulator goes through: a busy street, and scripted scenes that try a tracker."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .furnishing import furnish, populate
from .street import STYLES, Street, StreetPlan, random_street

__all__ = ["SCENARIOS", "Drive", "build_drive"]

_LANE = 1.75  # [m] from the centre line to the middle of a lane


@dataclass(frozen=True, eq=False, kw_only=True)
class Drive:
    """A furnished street and the way of the ego vehicle along it."""

    street: Street
    lane: float
    """Of the ego vehicle, to the left of the centre line [m]."""
    motion: tuple[float, float, float, float]
    """Of the ego vehicle: speed [m/s], amplitude [m], angular rate [rad/s] and phase [rad] of its variation."""


def _begin(
    random: np.random.Generator,
    seed: int,
    duration: float,
    motion: tuple[float, float, float, float],
    crossings: int | list[tuple[float, float]],
    ahead: float,
) -> tuple[Street, StreetPlan]:
    """A street with the ego vehicle's way kept clear."""
    street, plan = random_street(
        random, style=STYLES[seed % 2], extent=(-90.0, ahead + 100.0), duration=duration, crossings=crossings,
        hilly=0.6, parking=(True, True), sidewalk=3.6, half_width=6.2,
    )  # fmt: skip
    street.keep_clear(street.track(np.array([4.8, 2.0, 1.7]), 0.0, -_LANE, 0.0, motion, 0.3))
    return street, plan


def _street(random: np.random.Generator, seed: int, duration: float) -> Drive:
    """A drive at 30 km/h with oncoming traffic, parked cars, people and riders on both sidewalks, and road works."""
    motion, ahead = (8.0, 1.2, 0.45, 0.0), 8.0 * duration
    street, plan = _begin(random, seed, duration, motion, 2, ahead)
    add = street.add
    for kind, s, d, yaw, speed in (
        ("sedan", 17.0, -_LANE, 0.0, 8.3), ("hatch", -16.0, -_LANE, 0.0, 7.8), ("van", 38.0, -_LANE, 0.0, 8.6),
        ("suv", 55.0, _LANE, np.pi, 8.5), ("wagon", 80.0, _LANE, np.pi, 8.0), ("hatch", 105.0, _LANE, np.pi, 8.4),
        ("truck", 135.0, _LANE, np.pi, 7.5), ("mini", 160.0, _LANE, np.pi, 8.2), ("bus", -45.0, -_LANE, 0.0, 7.5),
    ):  # fmt: skip
        add(kind, s, d, yaw, motion=(speed, 0.8, 0.5, random.uniform(0, 6.3)))
    for _ in range(6):
        add("pedestrian", ahead + random.uniform(12, 40), random.choice([-1, 1]) * plan.half_width,
            np.pi / 2 * random.choice([-1, 1]), motion=(random.uniform(0.9, 1.5), 0.05, 2.0, 0.0))  # fmt: skip
    populate(street, plan, walkers=60, riders=10, cars=0, works=2)
    furnish(street, plan, 0.75)
    populate(street, plan, walkers=30, riders=0, cars=0, works=0)
    return Drive(street=street, lane=-_LANE, motion=motion)


def _occlusion(random: np.random.Generator, seed: int, duration: float) -> Drive:
    """The sensor stands; on the left a rider passes behind a parked van, on the right a walker behind a parked car.

    The van's shadow on the rider's way is some 9 m long, so at 6.5 m/s the rider is hidden for about a second.
    """
    motion = (0.0, 0.0, 0.0, 0.0)
    street, plan = _begin(random, seed, duration, motion, [], 0.0)
    add = street.add
    far = plan.half_width + 1.6
    add("van", 4.0, 4.9, np.pi, variant=0, scale=(1, 1, 1))
    add("cyclist", 33.0, far, np.pi, motion=(6.5, 0.0, 0.0, 0.0), margin=0.05)
    add("suv", 6.0, -5.1, 0.0, variant=0, scale=(1, 1, 1))
    add("pedestrian", 0.5, -far, 0.0, motion=(1.4, 0.0, 0.0, 0.0), margin=0.05)
    # The rest of the side that the rider is seen on stays free of what would hide him too.
    for s in np.arange(-30.0, 40.0, 2.0):
        if abs(s - 4.0) > 4.0:
            street.block(s, 4.6, 1.6)
        street.block(s, far, 1.0)
    furnish(street, plan, 0.5)
    return Drive(street=street, lane=-_LANE, motion=motion)


def _crossing(random: np.random.Generator, seed: int, duration: float) -> Drive:
    """A slow approach to a junction: cars cross it from both sides, a walker and a rider cross the road before it."""
    motion = (3.0, 0.0, 0.0, 0.0)
    street, plan = _begin(random, seed, duration, motion, [(48.0, 4.5)], 3.0 * duration)
    add = street.add
    add("pedestrian", 24.0, -8.0, np.pi / 2, motion=(1.4, 0.0, 0.0, 0.0), margin=0.05)
    add("cyclist", 31.0, 14.0, -np.pi / 2, motion=(4.0, 0.0, 0.0, 0.0), margin=0.05)
    for kind, s, d, yaw, speed in (
        ("sedan", 46.0, 40.0, -np.pi / 2, 8.0), ("hatch", 50.0, -34.0, np.pi / 2, 7.0),
        ("van", 46.0, 62.0, -np.pi / 2, 7.5), ("suv", 50.0, -60.0, np.pi / 2, 8.0),
        ("wagon", 90.0, _LANE, np.pi, 4.0),
    ):  # fmt: skip
        add(kind, s, d, yaw, motion=(speed, 0.0, 0.0, 0.0))
    populate(street, plan, walkers=25, riders=3, cars=0, works=0)
    furnish(street, plan, 0.5)
    return Drive(street=street, lane=-_LANE, motion=motion)


_BUILDERS: dict[str, Callable[[np.random.Generator, int, float], Drive]] = {
    "street": _street,
    "occlusion": _occlusion,
    "crossing": _crossing,
}

SCENARIOS = tuple(_BUILDERS)
"""What `Simulator` can drive through."""


def build_drive(scenario: str, seed: int, duration: float) -> Drive:
    """The street of a scenario; the same arguments give the same one.

    Raises:
        ValueError: There is no such scenario.
    """
    if scenario not in _BUILDERS:
        raise ValueError(f"scenario must be one of {', '.join(SCENARIOS)}, not {scenario!r}")
    return _BUILDERS[scenario](np.random.default_rng([seed, 7]), seed, duration)
