"""The scripted scenes do what their descriptions say."""

import numpy as np
import pytest

from warploom.models.classes import CYCLIST, PEDESTRIAN, VEHICLE
from warploom.models.simulator import SCENARIOS, Simulator


def test_there_are_the_scenarios_that_are_documented():
    assert set(SCENARIOS) == {"street", "occlusion", "crossing"}


@pytest.mark.parametrize("seed", [0, 1])
def test_the_rider_is_hidden_for_about_a_second(seed):
    simulator = Simulator(seed=seed, scenario="occlusion", lidar="vlp16", duration=6.0, turning=False, visibility=True)
    shares = []
    for frame in map(simulator.frame, range(24, 56)):
        assert frame.speed == pytest.approx(0.0, abs=1e-6)
        (rider,) = np.flatnonzero((frame.classes == CYCLIST) & (np.linalg.norm(frame.velocities, axis=1) > 4))
        shares.append(frame.visible[rider])
        if shares[-1] == 0:
            assert frame.counts[rider] <= 2  # 24 rays may miss a hand
    hidden = np.flatnonzero(np.array(shares) < 0.05)
    assert 0.6 <= len(hidden) * 0.1 <= 1.4
    assert np.array_equal(hidden, np.arange(hidden[0], hidden[-1] + 1))  # once, and then it is there again
    assert min(shares[hidden[0] - 5], shares[hidden[-1] + 5]) > 0.6


def test_everybody_crosses():
    simulator = Simulator(seed=1, scenario="crossing", lidar="vlp16", duration=9.0, turning=False)
    world = simulator.world
    sides = []
    for k in np.flatnonzero(np.isin(world.classes, (VEHICLE, PEDESTRIAN, CYCLIST)) & (world.motion[:, 0] > 0)):
        d = [float(world.street_pose(np.array([k]), t)[1][0]) for t in (0.0, 9.0)]
        if abs(d[0] - d[1]) > 8:
            sides.append((int(world.classes[k]), np.sign(d[0]) != np.sign(d[1])))
    crossed = [kind for kind, done in sides if done]
    assert {VEHICLE, PEDESTRIAN, CYCLIST} <= set(crossed)
    assert crossed.count(VEHICLE) >= 3
    # Nobody is run over: the ego vehicle and what crosses keep their distance.
    for t in np.arange(0.0, 9.0, 0.1):
        ego = simulator.vehicle_pose(t)[:2, 3]
        moving = world.transforms(t)[0][world.moves][:, :2, 3]
        assert np.linalg.norm(moving - ego, axis=1).min() > 1.5
