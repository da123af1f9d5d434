"""IMU, GNSS and wheels: integrated without errors they give the ride back; with errors, the errors of the model."""

from dataclasses import replace

import numpy as np
import pytest

from warploom.models.simulator import GnssModel, ImuModel, Simulator, WheelSpeedModel, local_from_geodetic

PERFECT = ImuModel(
    rate=400.0, acceleration_noise=0, angular_rate_noise=0, acceleration_bias=0, angular_rate_bias=0,
    acceleration_walk=0, angular_rate_walk=0,
)  # fmt: skip


@pytest.fixture(scope="module")
def drive() -> Simulator:
    return Simulator(seed=11, lidar="vlp16", duration=6.0, turning=False)


def test_a_perfect_imu_integrates_to_the_drive(drive):
    """Strapdown integration by the midpoint rule: within 5 cm and 0.05° after 6 s and 48 m."""
    imu = drive.imu(PERFECT)
    h = 1.0 / PERFECT.rate
    start = drive.vehicle_pose(0.0)
    turn, position = start[:3, :3].copy(), start[:3, 3].copy()
    velocity = (drive.vehicle_pose(1e-3)[:3, 3] - drive.vehicle_pose(-1e-3)[:3, 3]) / 2e-3
    for force, rate in zip(imu.acceleration, imu.angular_rate, strict=True):
        x, y, z = rate * h
        acceleration = turn @ force - [0, 0, 9.80665]
        position = position + velocity * h + 0.5 * acceleration * h * h
        velocity = velocity + acceleration * h
        turn = turn @ (np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
        turn, _ = np.linalg.qr(turn)
        turn *= np.sign(np.diag(turn))
    end = drive.vehicle_pose(6.0)
    assert np.linalg.norm(position - end[:3, 3]) < 0.05
    assert np.arccos(np.clip((np.trace(turn.T @ end[:3, :3]) - 1) / 2, -1, 1)) < np.deg2rad(0.05)
    assert np.linalg.norm(end[:3, 3] - start[:3, 3]) > 40


def test_a_standing_imu_feels_gravity_and_nothing_else():
    pose = np.eye(4)
    imu = PERFECT.measure(lambda t: pose, 1.0, 0)
    assert np.allclose(imu.acceleration, [0, 0, 9.80665], atol=1e-6)
    assert np.allclose(imu.angular_rate, 0, atol=1e-9)


def test_a_turn_has_the_rate_and_the_force_of_the_circle():
    def circle(t):
        pose = np.eye(4)
        c, s = np.cos(0.4 * t), np.sin(0.4 * t)
        pose[:2, :2] = [[c, -s], [s, c]]
        pose[:2, 3] = 20 * s, 20 * (1 - c)
        return pose

    imu = PERFECT.measure(circle, 2.0, 0)
    assert np.allclose(imu.angular_rate, [0, 0, 0.4], atol=1e-5)
    assert np.allclose(imu.acceleration, [0, 20 * 0.4**2, 9.80665], atol=1e-4)


def test_noise_and_biases_are_those_of_the_model():
    pose = np.eye(4)
    model = ImuModel()
    imu = model.measure(lambda t: pose, 60.0, 5)
    noise = imu.acceleration - imu.acceleration_bias - [0, 0, 9.80665]
    assert noise.std() == pytest.approx(model.acceleration_noise * np.sqrt(model.rate), rel=0.05)
    noise = imu.angular_rate - imu.angular_rate_bias
    assert noise.std() == pytest.approx(model.angular_rate_noise * np.sqrt(model.rate), rel=0.05)
    biases = [ImuModel(rate=1.0).measure(lambda t: pose, 1.0, seed).acceleration_bias[0] for seed in range(200)]
    assert np.std(biases) == pytest.approx(model.acceleration_bias, rel=0.15)


def test_gnss_without_errors_is_where_the_vehicle_is(drive):
    gnss = drive.gnss(GnssModel(noise=0, drift=0, velocity_noise=0))
    position = local_from_geodetic(gnss.latitude, gnss.longitude, gnss.altitude)
    truth = np.array([drive.vehicle_pose(t)[:3, 3] for t in gnss.t])
    assert np.allclose(position, truth, atol=1e-4)
    step = np.diff(truth, axis=0) / np.diff(gnss.t)[:, None]
    assert np.allclose(0.5 * (gnss.velocity[1:] + gnss.velocity[:-1]), step, atol=0.02)


def test_degrees_are_those_of_the_ellipsoid():
    """A degree at 48° north on WGS 84: 111.2 km of latitude and 74.6 km of longitude, at sea level."""
    north = local_from_geodetic(np.array([48.001]), np.array([11.5]), np.array([500.0]))[0]
    east = local_from_geodetic(np.array([48.0]), np.array([11.501]), np.array([500.0]))[0]
    assert north[1] == pytest.approx(111.2, rel=1e-3)
    assert east[0] == pytest.approx(74.63, rel=1e-3)


def test_gnss_errs_as_much_as_it_says_and_is_silent_in_a_tunnel():
    pose = np.eye(4)
    model = GnssModel(rate=1.0)
    off = []
    for seed in range(40):
        gnss = model.measure(lambda t: pose, 120.0, seed)
        off.append(local_from_geodetic(gnss.latitude, gnss.longitude, gnss.altitude))
    assert np.std([o[:, :2] for o in off]) == pytest.approx(gnss.accuracy, rel=0.15)
    # The slow part stays: one second later it is nearly the same.
    wander = np.array([np.corrcoef(o[1:, 0], o[:-1, 0])[0, 1] for o in off])
    assert np.median(wander) > 0.5
    tunnel = model.measure(lambda t: pose, 60.0, 0, outages=[(10.0, 20.0)])
    assert not ((tunnel.t >= 10) & (tunnel.t <= 20)).any()
    assert len(tunnel.t) == 49


def test_wheels_tell_the_speed_within_their_errors(drive):
    model = WheelSpeedModel(scale=0.0, noise=0.0)
    wheels = drive.wheel_speed(model)
    truth = [np.linalg.norm(drive.vehicle_pose(t + 1e-3)[:3, 3] - drive.vehicle_pose(t - 1e-3)[:3, 3]) / 2e-3
             for t in wheels.t]  # fmt: skip
    assert np.allclose(wheels.speed, truth, atol=0.5 * model.step + 1e-3)
    assert np.allclose(np.round(wheels.speed / model.step) * model.step, wheels.speed)
    factor = [replace(WheelSpeedModel(), noise=0.0).measure(drive.vehicle_pose, 0.1, s).speed[0] for s in range(60)]
    assert np.std(factor) / truth[0] == pytest.approx(0.01, rel=0.35)


def test_the_same_seed_gives_the_same_measurements(drive):
    assert drive.imu().acceleration.tobytes() == drive.imu().acceleration.tobytes()
    assert drive.gnss().latitude.tobytes() == drive.gnss().latitude.tobytes()
    with pytest.raises(ValueError, match="rate must be a number above 0"):
        ImuModel(rate=0.0).measure(drive.vehicle_pose, 1.0, 0)
