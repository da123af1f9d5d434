"""Streets: everything is placed, nothing stands in anything else's way."""

import numpy as np
import pytest

from warploom.models.simulator.furnishing import furnish, populate
from warploom.models.simulator.library import object_class, prototype
from warploom.models.simulator.street import STYLES, phase_of, random_street, travelled


def build(seed, style, duration=0.0):
    street, plan = random_street(np.random.default_rng(seed), style=style, extent=(-60.0, 60.0), duration=duration)
    populate(street, plan, walkers=10, riders=4, cars=6, works=1)
    furnish(street, plan, 0.7)
    return street, plan


@pytest.mark.parametrize("style", STYLES)
def test_a_street_is_furnished(style):
    street, _ = build(1, style)
    kinds = set(street.things.kind)
    assert len(street.things) > 60
    assert {"tree", "facade", "lamp_post"} <= kinds
    assert sum(object_class(k) >= 0 for k in street.things.kind) > 15


@pytest.mark.parametrize("style", STYLES)
def test_the_same_seed_furnishes_alike(style):
    one, other = build(2, style)[0].things, build(2, style)[0].things
    assert one.kind == other.kind
    assert one.pose == other.pose


def corners(things, k, t):
    s, d, yaw, _ = things.pose[k]
    gone = float(travelled(np.array(things.motion[k]), t))
    length, width = prototype(things.kind[k], things.variant[k]).size[:2] * things.scale[k][:2]
    c, n = np.cos(yaw), np.sin(yaw)
    unit = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2 * [length, width]
    return unit @ np.array([[c, n], [-n, c]]) + [s + gone * c, d + gone * n]


@pytest.mark.parametrize("seed", range(3))
def test_vehicles_never_meet(seed):
    polygon = pytest.importorskip("shapely").Polygon
    street, _ = build(seed, "urban", duration=4.0)
    things = street.things
    vehicles = [k for k, kind in enumerate(things.kind) if object_class(kind) == 0]
    for t in np.arange(0, 4.01, 0.5):
        boxes = [polygon(corners(things, k, t)) for k in vehicles]
        for i, one in enumerate(boxes):
            for other in boxes[:i]:
                # Footprints are covered by circles that leave out the corners: a touch of 0.2 m² at most.
                assert one.intersection(other).area < 0.2


def test_motion_starts_at_the_pose_and_goes_at_its_speed():
    motion = np.array([8.0, 1.0, 0.5, 1.2])
    assert travelled(motion, 0.0) == 0.0
    times = np.linspace(0, 50, 5001)
    gone = np.array([travelled(motion, t) for t in times])
    assert np.diff(gone).min() > 0
    assert gone[-1] / 50 == pytest.approx(8.0, abs=0.1)


def test_a_walker_goes_through_all_phases():
    phases = [phase_of("pedestrian", gone, 0.3) for gone in np.linspace(0, 1.45, 100)]
    assert set(phases) == set(range(8))
    assert phase_of("hatch", 12.0, 0.3) == 0
