"""Radar targets against the truth they were made from."""

import numpy as np
import pytest

from warploom.models.classes import PEDESTRIAN, VEHICLE
from warploom.models.geometry import rigid
from warploom.models.simulator import Radar, SimulatedFrame, Simulator

QUIET = {"range_noise": 0.0, "azimuth_noise": 0.0, "velocity_noise": 0.0, "false_targets": 0.0}


def frame_of(boxes, classes, velocities, visible=None):
    k = len(boxes)
    return SimulatedFrame(
        version=5, index=0, points=np.zeros((0, 4), np.float32), ring=np.zeros(0, np.uint16),
        t=np.zeros(0, np.float32), point_class=np.zeros(0, np.int32), instance=np.zeros(0, np.int64),
        ground=np.zeros(0, bool), boxes=np.array(boxes, np.float32), classes=np.array(classes, np.int32),
        ids=1 + np.arange(k), velocities=np.array(velocities, np.float32), counts=np.full(k, 10, np.int32),
        seen_at=np.zeros(k, np.float32), visible=None if visible is None else np.array(visible, np.float32),
        pose=np.eye(4), poses=np.stack([np.eye(4)] * 3), pose_times=np.zeros(3), speed=0.0, lidar="none",
    )  # fmt: skip


def test_a_car_ahead_is_where_its_rear_is_and_closes_in():
    frame = frame_of([[20, 0, 0, 4, 2, 1.5, 0]], [VEHICLE], [[5.0, 0.0]])
    radar = Radar(lidar_from_radar=rigid((2.0, 0.0, -1.0)), **QUIET)
    said = radar.measure(frame, velocity=np.array([8.0, 0, 0]), seed=1)
    assert said.ids.tolist() == [1]
    assert np.allclose(said.positions, [[20 - 2 - 2, 0, 0]], atol=1e-5)
    assert said.radial_velocities[0] == pytest.approx(-3.0, abs=1e-5)


def test_a_turned_radar_reports_in_its_own_frame():
    frame = frame_of([[0, 15, 0, 1, 1, 1.7, 0]], [VEHICLE], [[2.0, 3.0]])
    radar = Radar(lidar_from_radar=rigid(yaw=np.pi / 2), **QUIET)
    said = radar.measure(frame, velocity=np.zeros(3), seed=0)
    assert np.allclose(said.positions, [[14.5, 0, 0]], atol=1e-5)
    assert said.radial_velocities[0] == pytest.approx(3.0, abs=1e-5)
    assert len(Radar(**QUIET, field_of_view=60.0).measure(frame, velocity=np.zeros(3), seed=0).ids) == 0


def share_seen(kind, distance, visible=1.0, n=400):
    boxes = np.tile([distance, 0, 0, 1, 1, 1.5, 0], (n, 1))
    frame = frame_of(boxes, np.full(n, kind), np.zeros((n, 2)), np.full(n, visible))
    said = Radar(**QUIET).measure(frame, velocity=np.zeros(3), seed=3)
    return len(said.ids) / n, said


def test_far_small_and_hidden_targets_are_missed():
    assert share_seen(VEHICLE, 30)[0] > 0.97
    assert share_seen(PEDESTRIAN, 30)[0] > share_seen(PEDESTRIAN, 120)[0] + 0.3
    assert share_seen(VEHICLE, 100)[0] > share_seen(PEDESTRIAN, 100)[0]
    assert share_seen(VEHICLE, 30, visible=0.0)[0] == 0.0
    # Half of the targets of 0 dBm² are seen at `reach`; the cross section fluctuates by 4 dB.
    assert np.mean(share_seen(VEHICLE, 60)[1].cross_section) == pytest.approx(10.0, abs=1.0)


def test_noise_has_the_spread_of_the_model():
    n = 3000
    frame = frame_of(np.tile([30, 0, 0, 1, 1, 1.5, 0], (n, 1)), np.full(n, VEHICLE), np.zeros((n, 2)))
    said = Radar(false_targets=0.0).measure(frame, velocity=np.zeros(3), seed=8)
    assert np.hypot(*said.positions[:, :2].T).std() == pytest.approx(0.15, rel=0.1)
    assert np.rad2deg(np.arctan2(said.positions[:, 1], said.positions[:, 0])).std() == pytest.approx(0.6, rel=0.1)
    assert said.radial_velocities.std() == pytest.approx(0.1, rel=0.1)


def test_false_targets_come_at_their_rate_and_stand_on_the_ground():
    frame = frame_of(np.zeros((0, 7)), [], np.zeros((0, 2)))
    radar = Radar(false_targets=2.0)
    said = [radar.measure(frame, velocity=np.array([10.0, 0, 0]), seed=seed) for seed in range(300)]
    assert np.mean([len(one.ids) for one in said]) == pytest.approx(2.0, abs=0.3)
    ahead = [
        v for one in said for v, p in zip(one.radial_velocities, one.positions, strict=True) if p[0] > 5 * abs(p[1])
    ]
    assert np.median(ahead) == pytest.approx(-10.0, abs=0.5)
    assert all((one.ids == -1).all() for one in said)


def test_a_drive_gives_the_same_targets_again():
    simulator = Simulator(seed=7, lidar="vlp16", duration=0.5, turning=False, visibility=True)
    frame = simulator.frame(2)
    one, other = (simulator.radar(frame, Radar()) for _ in range(2))
    assert one.positions.tobytes() == other.positions.tobytes()
    assert (one.ids > 0).sum() >= 3
    assert simulator.velocity(2)[0] == pytest.approx(frame.speed, rel=0.01)
