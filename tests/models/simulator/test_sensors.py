"""The sensors' tables and the order in which they fire."""

import numpy as np
import pytest

from warploom.models.simulator.sensors import LIDARS, lidar_model


@pytest.mark.parametrize("name", list(LIDARS))
def test_beams_follow_the_tables(name):
    lidar = lidar_model(name)
    directions, ring, fraction = lidar.beams
    assert lidar.lines in (16, 32, 40, 64, 90, 128)
    assert len(directions) == lidar.lines * lidar.columns
    assert np.allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-6)
    assert np.allclose(np.rad2deg(np.arcsin(directions[:, 2])), lidar.elevation[ring], atol=1e-3)
    assert np.all(np.diff(lidar.elevation) > 0)
    assert fraction.min() == 0
    assert fraction.max() < 1
    assert np.array_equal(np.bincount(ring), np.full(lidar.lines, lidar.columns))


@pytest.mark.parametrize("name", list(LIDARS))
def test_the_sensor_turns_clockwise_from_behind(name):
    lidar = lidar_model(name)
    directions, ring, fraction = lidar.beams
    one = ring == lidar.lines // 2
    azimuth = np.unwrap(np.arctan2(directions[one, 1], directions[one, 0])[np.argsort(fraction[one])])
    steps = np.rad2deg(np.diff(azimuth))
    assert np.allclose(steps, -360.0 / lidar.columns, atol=1e-3)
    assert abs(abs(np.rad2deg(azimuth[0])) - 180) <= lidar.azimuth_offset + 1e-3


def test_the_hdl64_has_two_blocks():
    steps = np.diff(lidar_model("hdl64").elevation)
    assert np.allclose(steps[:31], 0.51, atol=0.02)
    assert np.allclose(steps[32:], 0.34, atol=0.02)


def test_an_unknown_sensor_is_refused_with_those_there_are():
    with pytest.raises(ValueError, match="vlp16"):
        lidar_model("none")
