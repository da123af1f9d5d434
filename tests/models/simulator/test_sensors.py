"""The sensors' tables and the order in which they fire."""

from dataclasses import fields

import numpy as np
import pytest
import yaml

from warploom.models.simulator import Camera, CameraDetector, GnssModel, ImuModel, Radar, WheelSpeedModel
from warploom.models.simulator.sensors import LIDARS, Lidar, lidar_model


@pytest.mark.parametrize("name", list(LIDARS))
def test_beams_follow_the_tables(name):
    lidar = lidar_model(name)
    directions, ring, fraction = lidar.beams
    assert lidar.lines in (16, 32, 40, 64, 90, 128)
    assert len(directions) == lidar.lines * lidar.columns
    assert np.allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-6)
    assert np.allclose(np.rad2deg(np.arcsin(directions[:, 2])), lidar.elevation[ring], atol=2e-3)
    assert np.all(np.diff(lidar.elevation) > 0)
    assert fraction.min() == 0
    assert fraction.max() < 1
    assert np.array_equal(np.bincount(ring), np.full(lidar.lines, lidar.columns))


@pytest.mark.parametrize("name", list(LIDARS))
def test_the_sensor_turns_clockwise_from_behind(name):
    lidar = lidar_model(name)
    directions, ring, fraction = lidar.beams
    offsets = np.broadcast_to(lidar.azimuth_offset, lidar.lines)
    for line in (0, lidar.lines // 2, lidar.lines - 1):
        one = ring == line
        assert np.all(np.diff(fraction[one]) > 0)
        azimuth = np.unwrap(np.arctan2(directions[one, 1], directions[one, 0]))
        steps = np.rad2deg(np.diff(azimuth))
        assert np.allclose(steps, -360.0 / lidar.columns, atol=1e-3)
        behind = (np.rad2deg(azimuth[0]) - offsets[line] + 360.0) % 360.0
        assert behind == pytest.approx(180.0, abs=1e-3)


@pytest.mark.parametrize(
    ("file", "name", "elevation", "azimuth"),
    [
        ("VLP16.yaml", "vlp16", 1e-6, 1e-6), ("VLP32.yaml", "vlp32", 1e-3, 1e-3), ("VLS128.yaml", "vls128", 1e-3, 1e-3),
        # Of one device each: off their nominal ones by up to a tenth of a degree.
        ("Pandar64.csv", "pandar64", 0.15, 1e-3), ("PandarXT32.csv", "xt32", 0.1, 0.15),
        ("PandarQT64.csv", "qt64", 0.02, None),
    ],
)  # fmt: skip
def test_tables_are_those_of_devices(shared_data, file, name, elevation, azimuth):
    path = shared_data / "packets" / "calibration" / file
    if path.suffix == ".yaml":
        lasers = yaml.safe_load(path.read_text())["lasers"]
        rows = np.rad2deg([[laser["vert_correction"], laser["rot_correction"]] for laser in lasers])
    else:
        lines = [line.split(",") for line in path.read_text().splitlines()[1:]]
        rows = np.array([[float(line[1]), -float(line[2])] for line in lines if len(line) >= 3])  # clockwise
    rows = rows[np.argsort(rows[:, 0])]
    lidar = lidar_model(name)
    assert np.allclose(lidar.elevation, rows[:, 0], atol=elevation)
    if azimuth is not None:
        assert np.allclose(lidar.azimuth_offset, rows[:, 1], atol=azimuth)


def test_a_footprint_reaches_its_neighbour_by_divergence_and_step():
    lidar = lidar_model("hdl64")
    assert lidar.edge_share == pytest.approx(2e-3 / np.deg2rad(0.167))
    assert all(0 < other.edge_share <= 1 for other in LIDARS.values())


def test_the_hdl64_has_two_blocks():
    steps = np.diff(lidar_model("hdl64").elevation)
    assert np.allclose(steps[:31], 0.51, atol=0.02)
    assert np.allclose(steps[32:], 0.34, atol=0.02)


def test_an_unknown_sensor_is_refused_with_those_there_are():
    with pytest.raises(ValueError, match="vlp16"):
        lidar_model("none")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"elevation": np.zeros(0)}, "elevation must be finite, of shape"), ({"elevation": [np.nan]}, "elevation must"),
        ({"azimuth_step": 0}, "azimuth_step must be a number above 0"), ({"azimuth_step": 400}, "at most 360"),
        ({"azimuth_offset": np.zeros(3)}, "azimuth_offset must be"), ({"min_range": -1}, "min_range must be"),
        ({"max_range": 0.5}, "min_range must be below max_range"), ({"reach": np.nan}, "reach must be"),
        ({"range_noise": -1}, "range_noise"), ({"drop_out": 2}, "drop_out must be a number from 0 to 1, not 2"),
        ({"divergence": -1}, "divergence must be"), ({"pulse": np.inf}, "pulse must be"),
    ],
)  # fmt: skip
def test_sensors_that_cannot_be_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Lidar(**{"name": "own", "elevation": np.linspace(-10, 10, 4), "azimuth_step": 1.0} | options)


@pytest.mark.parametrize("made", [Camera, CameraDetector, GnssModel, ImuModel, Radar, WheelSpeedModel])
def test_no_model_takes_a_number_that_is_none(made):
    """Every number of each: neither nan nor below 0, nor a word."""
    numbers = [field.name for field in fields(made) if isinstance(field.default, int | float)]
    assert len(numbers) > 3
    for name in numbers:
        for value in (np.nan, -1, "many"):
            with pytest.raises((TypeError, ValueError), match=f"{name} must be"):
                made(**{name: value})


@pytest.mark.parametrize(("made", "name"), [(Camera, "lidar_from_body"), (Radar, "lidar_from_radar")])
def test_poses_of_sensors_are_rigid(made, name):
    for pose in (np.full((4, 4), np.nan), np.zeros((4, 4)), 2 * np.eye(4)):
        with pytest.raises(ValueError, match=f"{name} must be a rigid motion"):
            made(**{name: pose})
    with pytest.raises(ValueError, match=rf"{name} must have shape \(4, 4\), not \(\)"):
        made(**{name: None})
