"""Turning motions against filterpy: an extended and an unscented filter, and the interacting multiple model."""

import dataclasses

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter, IMMEstimator, MerweScaledSigmaPoints, UnscentedKalmanFilter

from warploom.models.classes import VEHICLE
from warploom.models.geometry import invert, rigid, transform_boxes, wrap_angle
from warploom.models.tracker import ClassConfig, Tracker, TrackerConfig

NS = 100_000_000
DT = 0.1


def vehicles(**changes):
    classes = list(TrackerConfig().classes)
    classes[VEHICLE] = dataclasses.replace(classes[VEHICLE], **changes)
    return TrackerConfig(classes=tuple(classes))


def moved(x, dt, *, turns=True):
    """Constant turn rate and velocity, by the circle's formula."""
    px, py, yaw, v, rate = x
    if not turns:
        return np.array([px + v * dt * np.cos(yaw), py + v * dt * np.sin(yaw), yaw, v, 0.0])
    if abs(rate) < 1e-4:  # beyond it the formula loses digits; here the series has them
        middle = yaw + 0.5 * rate * dt
        return np.array([px + v * dt * np.cos(middle), py + v * dt * np.sin(middle), yaw + rate * dt, v, rate])
    r = v / rate
    return np.array([
        px + r * (np.sin(yaw + rate * dt) - np.sin(yaw)),
        py - r * (np.cos(yaw + rate * dt) - np.cos(yaw)),
        yaw + rate * dt, v, rate,
    ])  # fmt: skip


def jacobian(f, x, step=1e-5):
    return np.stack([(f(x + step * e) - f(x - step * e)) / (2 * step) for e in np.eye(len(x))], axis=1)


def wander(x, c: ClassConfig, dt, *, turns=True):
    """Process noise: speed along the chord, turn rate about the vertical."""
    middle = x[2] + (0.5 * x[4] * dt if turns else 0.0)
    along = np.array([np.cos(middle), np.sin(middle), 0, 0, 0])
    speed, q = np.array([0, 0, 0, 1.0, 0]), c.acceleration_std**2
    pair = np.outer(along, speed)
    Q = q * (dt**3 / 3 * np.outer(along, along) + dt**2 / 2 * (pair + pair.T) + dt * np.outer(speed, speed))
    Q += dt * np.diag([c.slip_std**2, c.slip_std**2, c.yaw_drift**2, 0, 0])
    if turns:
        Q[np.ix_([2, 4], [2, 4])] += c.turn_acceleration_std**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    else:
        Q[4, 4] = 1e-4
    return Q


class Extended(ExtendedKalmanFilter):
    """filterpy's extended filter with the motion put in; straight on, the turn rate is forgotten."""

    def __init__(self, box, c: ClassConfig, *, turns=True):
        super().__init__(dim_x=5, dim_z=3)
        self.c, self.turns, self.step = c, turns, DT
        self.x = np.array([box[0], box[1], box[6], 0.0, 0.0])
        self.P = np.diag([c.position_std**2] * 2 + [c.yaw_std**2, c.speed_std**2, c.turn_rate_std**2])
        self.R = np.diag([c.position_std**2] * 2 + [c.yaw_std**2])

    def predict(self, u=None):
        def motion(x):
            return moved(x, self.step, turns=self.turns)

        F = jacobian(motion, self.x)
        Q = wander(self.x, self.c, self.step, turns=self.turns)
        self.x, self.P = motion(self.x), F @ self.P @ F.T + Q

    def update(self, z):
        z = z.copy()
        z[2] = self.x[2] + wrap_angle(z[2] - self.x[2])
        super().update(z, lambda x: np.eye(3, 5), lambda x: x[:3])


def cartesian(x, P):
    """Velocity, and covariance of x y vx vy."""

    def f(x):
        return np.array([x[0], x[1], x[3] * np.cos(x[2]), x[3] * np.sin(x[2])])

    J = jacobian(f, x)
    return f(x)[2:], J @ P @ J.T


def drive(rng, frames, turning):
    """Boxes of a car that goes straight and, in `turning`, turns."""
    x = np.array([5.0, -3.0, 0.4, 8.0, 0.0])
    for frame in range(frames):
        x[4] = 0.6 if frame in turning else 0.0
        x = moved(x, DT)
        box = np.array([x[0], x[1], 0.8, 4.2, 1.8, 1.6, x[2]])
        yield x, box + rng.normal(0, [0.08, 0.08, 0.02, 0.02, 0.02, 0.02, 0.03])


def test_ctrv_is_filterpys_extended_filter():
    config = vehicles(motion="ctrv", report=0.5, slip_std=0.2)
    tracker, reference = Tracker(config), None
    for frame, (_, box) in enumerate(drive(np.random.default_rng(0), 60, range(20, 45))):
        seen = frame % 9 != 7
        if reference is None:
            reference = Extended(box, config.classes[VEHICLE])
        else:
            reference.predict()
            if seen:
                reference.update(box[[0, 1, 6]])
        boxes = box[None] if seen else np.empty((0, 7))
        tracks = tracker.update(frame * NS, boxes, [0.9] * seen, [VEHICLE] * seen, pose=np.eye(4))
        velocity, covariance = cartesian(reference.x, reference.P)
        # 1e-6: the reference's Jacobians are differences
        np.testing.assert_allclose(tracks.boxes[0, [0, 1]], reference.x[:2], atol=1e-6)
        np.testing.assert_allclose(wrap_angle(tracks.boxes[0, 6] - reference.x[2]), 0.0, atol=1e-6)
        np.testing.assert_allclose(tracks.velocities[0], velocity, atol=1e-5)
        np.testing.assert_allclose(tracks.turn_rates[0], reference.x[4], atol=1e-5)
        np.testing.assert_allclose(tracks.covariances[0], covariance, atol=1e-4)
    assert abs(reference.x[4]) < 0.3


def test_ctrv_is_near_an_unscented_filter():
    config = vehicles(motion="ctrv", yaw_std=0.05, yaw_drift=0.1)
    c = config.classes[VEHICLE]
    points = MerweScaledSigmaPoints(5, alpha=0.1, beta=2.0, kappa=0.0)
    unscented = UnscentedKalmanFilter(5, 3, DT, hx=lambda x: x[:3], fx=moved, points=points)
    tracker = Tracker(config)
    for frame, (_, box) in enumerate(drive(np.random.default_rng(1), 50, range(15, 50))):
        z = box[[0, 1, 6]]
        if frame == 0:
            start = Extended(box, c)
            unscented.x, unscented.P, unscented.R = start.x, start.P, start.R
        else:
            unscented.Q = wander(unscented.x, c, DT)
            unscented.predict()
            unscented.update(z)
        tracks = tracker.update(frame * NS, box[None], [0.9], [VEHICLE], pose=np.eye(4))
        if frame > 20:
            # The two take the bend of the motion into account in different orders: a third of the standard
            # deviation, which is 1 m/s.
            np.testing.assert_allclose(tracks.boxes[0, :2], unscented.x[:2], atol=0.02)
            np.testing.assert_allclose(tracks.velocities[0], cartesian(unscented.x, unscented.P)[0], atol=0.3)
            np.testing.assert_allclose(tracks.turn_rates[0], unscented.x[4], atol=0.06)
    assert tracks.turn_rates[0] == pytest.approx(0.6, abs=0.15)


def test_imm_is_filterpys():
    config = vehicles(motion="imm", switch_rate=1.0, yaw_std=0.05, yaw_drift=0.1, slip_std=0.1)
    c = config.classes[VEHICLE]
    switch = 0.5 * (1.0 - np.exp(-2.0 * c.switch_rate * DT))
    tracker, reference = Tracker(config), None
    for frame, (_, box) in enumerate(drive(np.random.default_rng(2), 50, range(18, 40))):
        if reference is None:
            filters = [Extended(box, c, turns=False), Extended(box, c)]
            reference = IMMEstimator(filters, (0.8, 0.2), np.array([[1 - switch, switch], [switch, 1 - switch]]))
        else:
            reference.predict()
            reference.update(box[[0, 1, 6]])
        tracks = tracker.update(frame * NS, box[None], [0.9], [VEHICLE], pose=np.eye(4))
        straight, turning = (cartesian(f.x, f.P)[0] for f in reference.filters)
        mu = reference.mu
        # 1e-5: the reference's Jacobians are differences
        np.testing.assert_allclose(tracks.boxes[0, [0, 1, 6]], reference.x[:3], atol=1e-5)
        np.testing.assert_allclose(tracks.velocities[0], mu[0] * straight + mu[1] * turning, atol=1e-4)
        np.testing.assert_allclose(tracks.turn_rates[0], mu[1] * reference.filters[1].x[4], atol=1e-4)
        np.testing.assert_allclose(tracks.covariances[0, :2, :2], reference.P[:2, :2], atol=1e-5)
        if frame == 35:
            assert mu[1] > 0.6  # it has been turning for long


def test_imm_turns_where_cv_cuts_the_corner():
    errors = {}
    for motion in ("cv", "ctrv", "imm"):
        tracker, off = Tracker(vehicles(motion=motion, yaw_std=0.05)), []
        for frame, (x, box) in enumerate(drive(np.random.default_rng(3), 80, range(20, 60))):
            tracks = tracker.update(frame * NS, box[None], [0.9], [VEHICLE], pose=np.eye(4))
            if frame > 25:
                true = x[3] * np.array([np.cos(x[2]), np.sin(x[2])])
                off.append(np.linalg.norm(tracks.velocities[0] - true))
        errors[motion] = np.median(off)
    assert errors["imm"] < errors["cv"]
    assert errors["ctrv"] < errors["cv"]


@pytest.mark.parametrize("motion", ["cv", "ctrv", "imm"])
def test_a_radial_speed_is_taken_up_as_in_the_textbook(motion):
    config = vehicles(motion=motion)
    c, direction = config.classes[VEHICLE], np.array([0.6, 0.8])
    box = np.array([30.0, 40, 0.8, 4.2, 1.8, 1.6, 0.3])
    tracks = Tracker(config).update(
        0, box[None], [0.9], [VEHICLE], radial=np.array([[*direction, 7.0, 0.2]]), pose=np.eye(4)
    )
    x, P = np.zeros(2), c.speed_std**2 * np.eye(2)
    if motion != "cv":  # all speed is along the heading
        heading = np.array([np.cos(0.3), np.sin(0.3)])
        P = c.speed_std**2 * np.outer(heading, heading)
    K = P @ direction / (direction @ P @ direction + 0.2**2)
    x, P = x + K * 7.0, P - np.outer(K, direction @ P)
    np.testing.assert_allclose(tracks.velocities[0], x, atol=1e-9)
    if motion == "cv":
        np.testing.assert_allclose(tracks.covariances[0, 2:, 2:], P, atol=1e-9)


@pytest.mark.parametrize("motion", ["ctrv", "imm"])
def test_a_heading_that_was_wrong_at_first_leaves_the_velocity_as_it_is(motion):
    tracker = Tracker(vehicles(motion=motion))
    for frame in range(20):
        box = np.array([0.8 * frame, 0, 0.8, 4.2, 1.8, 1.6, np.pi if frame < 2 else 0.0])
        tracks = tracker.update(frame * NS, box[None], [0.9], [VEHICLE], pose=np.eye(4))
    np.testing.assert_allclose(tracks.velocities[0], [8.0, 0.0], atol=0.2)
    assert abs(wrap_angle(tracks.boxes[0, 6])) < 0.01


@pytest.mark.parametrize("motion", ["cv", "ctrv", "imm"])
def test_covariances_turn_with_the_sensor_and_stay_covariances(motion):
    """The same drive seen by a sensor that turns and moves is the same in the world."""
    still, moving = Tracker(vehicles(motion=motion)), Tracker(vehicles(motion=motion))
    for frame, (_, box) in enumerate(drive(np.random.default_rng(4), 40, range(10, 30))):
        pose = rigid((0.5 * frame, 0.1 * frame, 0.0), yaw=0.05 * frame)
        a = still.update(frame * NS, box[None], [0.9], [VEHICLE], pose=np.eye(4))
        b = moving.update(frame * NS, transform_boxes(box[None], invert(pose)), [0.9], [VEHICLE], pose=pose)
        np.testing.assert_allclose(transform_boxes(b.boxes, pose)[:, :6], a.boxes[:, :6], atol=1e-9)
        R = np.kron(np.eye(2), pose[:2, :2])
        np.testing.assert_allclose(R @ b.covariances[0] @ R.T, a.covariances[0], atol=1e-9)
        np.testing.assert_allclose(b.covariances[0], b.covariances[0].T, atol=1e-12)
        assert np.linalg.eigvalsh(b.covariances[0]).min() > -1e-9


def test_what_is_no_motion_or_cost_is_refused():
    with pytest.raises(ValueError, match="vehicle: motion must be one of cv, ctrv, imm, not 'ca'"):
        vehicles(motion="ca")
    with pytest.raises(ValueError, match="vehicle: cost must be one of"):
        vehicles(cost="iou")
    with pytest.raises(ValueError, match="gate_giou must be above"):
        vehicles(gate_giou=-1.0)
