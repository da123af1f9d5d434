"""Trajectory errors against evo's numbers, ORB-SLAM2's published ones, plain loops, and by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from warploom.models.evaluation.odometry import (
    absolute_trajectory_error,
    align_trajectory,
    kitti_odometry_error,
    path_length,
    relative_pose_error,
)


def motion(translation=(0, 0, 0), rotation=(0, 0, 0)):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    T[:3, 3] = translation
    return T


def wandering(seed, n=200):
    """A way with turns."""
    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for _ in range(n - 1):
        poses.append(poses[-1] @ motion(rng.normal([1.0, 0, 0], 0.1), rng.normal(0, 0.05, 3)))
    return np.array(poses)


def disturbed(poses, seed):
    rng = np.random.default_rng(seed)
    return np.array([pose @ motion(rng.normal(0, 0.05, 3), rng.normal(0, 0.01, 3)) for pose in poses])


def read(path):
    rows = np.loadtxt(path).reshape(-1, 3, 4)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows
    return poses


@pytest.fixture(scope="module")
def orb(shared_data):
    folder = shared_data / "trajectories"
    return read(folder / "KITTI_00_ORB.txt"), read(folder / "KITTI_00_gt.txt")


def test_absolute_errors_are_evos(orb):
    """As `evo_ape` 1.38 computes them, to nine digits."""
    aligned, raw = absolute_trajectory_error(*orb), absolute_trajectory_error(*orb, align=False)
    assert aligned.rmse == pytest.approx(1.303449714565, rel=1e-9)
    assert aligned.mean == pytest.approx(1.156997128539, rel=1e-9)
    assert aligned.median == pytest.approx(1.065624769556, rel=1e-9)
    assert aligned.max == pytest.approx(3.587949120679, rel=1e-9)
    assert raw.rmse == pytest.approx(7.790288882657, rel=1e-9)


def test_relative_errors_are_evos(orb):
    """As `evo_rpe` 1.38 computes them over all pairs: translations to nine digits, angles to seven."""
    one, ten = relative_pose_error(*orb), relative_pose_error(*orb, delta=10)
    assert one.translation_rmse == pytest.approx(0.028120377017, rel=1e-9)
    assert one.translation_mean == pytest.approx(0.019301310981, rel=1e-9)
    assert one.rotation_rmse == pytest.approx(0.0020066664986, rel=1e-7)
    assert one.rotation_mean == pytest.approx(0.0010399274681, rel=1e-7)
    assert ten.translation_rmse == pytest.approx(0.189348230386, rel=1e-9)
    assert ten.rotation_rmse == pytest.approx(0.0106721345578, rel=1e-7)


def test_kittis_errors_are_those_that_orb_slam2_published(orb):
    """Mur-Artal and Tardós (2017), table I, sequence 00, stereo: 0.70 % and 0.25° per 100 m."""
    error = kitti_odometry_error(*orb)
    assert round(error.translation, 2) == 0.70
    assert round(100 * error.rotation, 2) == 0.25
    assert sorted(error.by_length) == [100, 200, 300, 400, 500, 600, 700, 800]


def development_kit(estimate, truth, lengths):
    """KITTI's `evaluate_odometry.cpp`, line by line."""
    dist = [0.0]
    for i in range(1, len(truth)):
        dist.append(dist[-1] + np.linalg.norm(truth[i, :3, 3] - truth[i - 1, :3, 3]))
    errors = []
    for first in range(0, len(truth), 10):
        for length in lengths:
            last = next((i for i in range(first, len(truth)) if dist[i] > dist[first] + length), -1)
            if last == -1:
                continue
            delta_truth = np.linalg.inv(truth[first]) @ truth[last]
            delta_estimate = np.linalg.inv(estimate[first]) @ estimate[last]
            error = np.linalg.inv(delta_estimate) @ delta_truth
            angle = np.arccos(np.clip(0.5 * (np.trace(error[:3, :3]) - 1.0), -1.0, 1.0))
            errors.append((np.linalg.norm(error[:3, 3]) / length, angle / length))
    return np.mean(errors, axis=0), len(errors)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_kittis_errors_are_the_development_kits(seed):
    truth = wandering(seed)
    estimate = disturbed(truth, seed + 1)
    (translation, rotation), segments = development_kit(estimate, truth, (10, 50, 120))
    error = kitti_odometry_error(estimate, truth, lengths=(10, 50, 120))
    assert error.segments == segments
    assert error.translation == pytest.approx(100 * translation, rel=1e-9)
    assert error.rotation == pytest.approx(np.degrees(rotation), rel=1e-5)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_where_the_worlds_lie_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    truth = wandering(seed, 60)
    estimate = disturbed(truth, seed)
    elsewhere = motion(rng.uniform(-100, 100, 3), rng.uniform(-2, 2, 3)) @ estimate
    assert absolute_trajectory_error(elsewhere, truth).rmse == pytest.approx(
        absolute_trajectory_error(estimate, truth).rmse, abs=1e-9
    )
    there, here = relative_pose_error(elsewhere, truth, delta=5), relative_pose_error(estimate, truth, delta=5)
    assert there.translation_rmse == pytest.approx(here.translation_rmse, abs=1e-9)
    assert there.rotation_rmse == pytest.approx(here.rotation_rmse, abs=1e-9)
    assert (
        absolute_trajectory_error(elsewhere, truth).rmse
        <= absolute_trajectory_error(elsewhere, truth, align=False).rmse + 1e-9
    )


def test_the_alignment_undoes_a_motion():
    truth, away = wandering(3, 40), motion([5, -3, 2], [0.3, 0.2, -1.0])
    assert np.abs(align_trajectory(np.linalg.inv(away) @ truth, truth) - away).max() < 1e-9


def test_by_hand():
    truth = np.array([motion([i, 0, 0]) for i in range(11)], np.float64)
    estimate = np.array([motion([1.1 * i, 0, 0]) for i in range(11)])
    raw = absolute_trajectory_error(estimate, truth, align=False)
    assert (raw.mean, raw.median, raw.max) == pytest.approx((0.5, 0.5, 1.0))
    assert relative_pose_error(estimate, truth, delta=2).translation_rmse == pytest.approx(0.2)
    error = kitti_odometry_error(estimate, truth, lengths=(5,))
    # A segment ends at the first pose beyond its length: 6 m on, 0.6 m off.
    assert error.segments == 1
    assert error.translation == pytest.approx(100 * 0.6 / 5)
    assert path_length(estimate) == pytest.approx(11.0)


def test_a_short_way_has_no_segments():
    error = kitti_odometry_error(wandering(1, 20), wandering(1, 20))
    assert error.segments == 0
    assert np.isnan(error.translation)
    assert error.by_length == {}


def test_a_way_that_does_not_move_is_no_trouble():
    still = np.tile(np.eye(4), (5, 1, 1))
    assert absolute_trajectory_error(still, still).rmse == 0
    assert relative_pose_error(still, still).rotation_rmse == 0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda a: absolute_trajectory_error(a, a[:-1]), r"must both have shape \(n, 4, 4\)"),
        (lambda a: absolute_trajectory_error(a[:0], a[:0]), r"with n ≥ 1"),
        (lambda a: align_trajectory(a[:, :3], a[:, :3]), r"must both have shape"),
        (lambda a: relative_pose_error(a, a, delta=0), "delta must be 1 to 9 for 10 poses, not 0"),
        (lambda a: relative_pose_error(a, a, delta=10), "delta must be 1 to 9"),
        (lambda a: kitti_odometry_error(a, a, lengths=()), "lengths must be positive"),
        (
            lambda a: kitti_odometry_error(a, np.where(np.arange(10)[:, None, None] == 3, np.nan, a)),
            "truth .* number 3",
        ),
    ],
)
def test_refuses_what_does_not_fit(call, message):
    with pytest.raises(ValueError, match=message):
        call(wandering(1, 10))
