"""Motion compensation against SciPy's Slerp in float64."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from warploom.kernels.motion import MotionCompensation, compensate_motion

TOLERANCE = 2e-6  # of the distances involved


def reference(points, t, poses, times, reference_time):
    """The pose of each point and of the reference time by SciPy; then out to the world and back."""
    turn, times = Slerp(times, Rotation.from_matrix(poses[:, :3, :3])), np.asarray(times, np.float64)
    t = np.clip(t.astype(np.float64), times[0], times[-1])
    position = np.stack([np.interp(t, times, poses[:, i, 3]) for i in range(3)], -1)
    origin = np.array([np.interp(reference_time, times, poses[:, i, 3]) for i in range(3)])
    world = turn(t).apply(points[:, :3].astype(np.float64)) + position
    return turn(reference_time).inv().apply(world - origin)


def drive(m, seed, turn=0.3, origin=0.0):
    """Poses of a sensor that moves and turns, and their times."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (m, 1, 1))
    turns, turning = Rotation.random(rng=rng), rng.normal(0, turn, (m, 3))
    for k in range(m):
        turns = turns * Rotation.from_rotvec(turning[k])
        poses[k, :3, :3] = turns.as_matrix()
    poses[:, :3, 3] = origin + rng.normal(0, 1.0, (m, 3)).cumsum(axis=0)
    return poses, 100.0 + rng.uniform(0.01, 0.1, m).cumsum()


def cloud(n, times, seed, reach=0.0):
    rng = np.random.default_rng(seed)
    points = rng.normal(0, [30, 30, 3, 1], (n, 4)).astype(np.float32)
    return points, rng.uniform(times[0] - reach, times[-1] + reach, n)


def assert_near(moved, points, expected, path=5.0):
    limit = TOLERANCE * (np.abs(points[:, :3]).max(axis=1) + path)
    assert (np.abs(moved[:, :3] - expected).max(axis=1) <= limit).all()
    assert np.array_equal(moved[:, 3:], points[:, 3:], equal_nan=True)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 20), st.floats(0, 1), st.sampled_from([0.0, 1e-9, 0.01, 0.5, 1.5]))
def test_equals_slerp(seed, m, share, turn):
    """Within 2e-6 of the distances involved; also for times past the ends, which take the end's pose."""
    poses, times = drive(m, seed, turn)
    points, t = cloud(500, times, seed, reach=0.01)
    reference_time = times[0] + share * (times[-1] - times[0])
    moved = compensate_motion(points, t, poses, times, reference_time)
    assert moved.dtype == np.float32
    assert_near(moved, points, reference(points, t, poses, times, reference_time), path=2.0 * m)


def test_a_half_turn_between_two_poses():
    """Turns of almost π about any axis, where the quaternion's w vanishes."""
    for seed in range(20):
        axis = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()[0]
        poses = np.tile(np.eye(4), (2, 1, 1))
        poses[1, :3, :3] = Rotation.from_rotvec(axis * (np.pi - 1e-3)).as_matrix()
        points, t = cloud(200, (0.0, 1.0), seed)
        assert_near(
            compensate_motion(points, t, poses, (0, 1), 0.25), points, reference(points, t, poses, (0, 1), 0.25)
        )


def test_a_far_origin_of_the_map_costs_nothing():
    poses, times = drive(5, 1, origin=5e6)
    points, t = cloud(500, times, 2)
    assert_near(
        compensate_motion(points, t, poses, times, times[2]), points, reference(points, t, poses, times, times[2])
    )


def test_float32_times_of_a_sweep():
    poses, times = drive(3, 4)
    times = np.array([0.0, 0.05, 0.1])
    points, t = cloud(500, times, 5)
    t = t.astype(np.float32)
    assert_near(compensate_motion(points, t, poses, times, 0.0), points, reference(points, t, poses, times, 0.0))


def test_a_wall_seen_on_the_move_is_straight_again():
    """The sensor drives 2 m forward and turns 10° while it sees a fixed wall."""
    wall = np.column_stack([np.full(300, 20.0), np.linspace(-15, 15, 300), np.zeros(300)])
    t = np.linspace(0, 0.1, 300)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, :3] = Rotation.from_euler("z", 10, degrees=True).as_matrix()
    poses[1, 0, 3] = 2.0
    turn = Slerp([0, 0.1], Rotation.from_matrix(poses[:, :3, :3]))(t)
    seen = turn.inv().apply(wall - np.outer(t / 0.1, poses[1, :3, 3])).astype(np.float32)
    np.testing.assert_allclose(compensate_motion(seen, t, poses, (0, 0.1), 0.0), wall, atol=1e-4)


@pytest.mark.parametrize("scale", [1e-45, 1e5, 1e30])
def test_far_and_tiny_coordinates(scale):
    poses, times = drive(3, 6)
    points, t = cloud(200, times, 7)
    points = (points * np.float32(scale)).astype(np.float32)
    assert_near(
        compensate_motion(points, t, poses, times, times[0]), points, reference(points, t, poses, times, times[0])
    )


def test_what_is_not_finite_stays_so_and_harms_no_other():
    poses, times = drive(3, 8)
    points, t = cloud(100, times, 9)
    points[3, 0], points[5, 2], t[7] = np.nan, np.inf, np.nan
    moved = compensate_motion(points, t, poses, times, times[1])
    assert not np.isfinite(moved[[3, 5], :3]).all(axis=1).any()
    others = np.delete(np.arange(100), [3, 5, 7])
    assert_near(moved[others], points[others], reference(points[others], t[others], poses, times, times[1]))
    t[7] = times[0]  # the pose that a time of NaN takes
    assert_near(moved[7:8], points[7:8], reference(points[7:8], t[7:8], poses, times, times[1]))


def test_no_point_and_any_layout():
    poses, times = drive(3, 10)
    assert compensate_motion(np.zeros((0, 5), np.float32), np.zeros(0), poses, times, times[0]).shape == (0, 5)
    points, t = cloud(100, times, 11)
    expected = compensate_motion(points, t, poses, times, times[0])
    frozen = points.copy()
    frozen.setflags(write=False)
    for given_points in (frozen, np.asfortranarray(points), points.astype(np.float64), np.repeat(points, 2, 0)[::2]):
        before = given_points.copy()
        assert np.array_equal(compensate_motion(given_points, t, poses, times, times[0]), expected)
        assert np.array_equal(given_points, before)
    assert np.array_equal(compensate_motion(points, np.repeat(t, 2)[::2], poses, times, times[0]), expected)


def test_arrays_of_other_families():
    import torch

    poses, times = drive(3, 12)
    points, t = cloud(100, times, 13)
    expected = compensate_motion(points, t, poses, times, times[0])
    moved = compensate_motion(torch.from_numpy(points), torch.from_numpy(t), poses, times, times[0])
    assert isinstance(moved, torch.Tensor)
    assert np.array_equal(moved.numpy(), expected)
    moved = compensate_motion(wp.array(points, dtype=wp.float32, device="cpu"), t, poses, times, times[0])
    assert np.array_equal(moved.numpy(), expected)


def test_the_plan_reads_its_count_and_counts_what_is_outside(device):
    poses, times = drive(4, 14)
    points, t = cloud(1000, times, 15, reach=0.02)
    plan = MotionCompensation(capacity=1024, max_poses=8, device=device)
    xyz = wp.array(points[:, :3].copy(), dtype=wp.vec3, device=device)
    stamps = wp.array(t, dtype=wp.float64, device=device)
    for m, n in ((4, 1000), (2, 300)):
        plan.set_poses(poses[:m], times[:m], times[1])
        plan.launch(xyz, stamps, wp.array([n], dtype=wp.int32, device=device))
        expected = reference(points[:n], t[:n], poses[:m], times[:m], times[1])
        assert_near(plan.xyz.numpy()[:n], points[:n, :3], expected)
        assert plan.outside.numpy()[0] == ((t[:n] < times[0]) | (t[:n] > times[m - 1])).sum()


def test_a_new_plan_leaves_the_points_where_they_are():
    plan = MotionCompensation(capacity=16)
    xyz = wp.array(np.eye(3, dtype=np.float32), dtype=wp.vec3, device="cpu")
    plan.launch(xyz, wp.array([0.0, 0.5, 1.0], dtype=wp.float32, device="cpu"), wp.array([3], dtype=wp.int32))
    assert np.array_equal(plan.xyz.numpy()[:3], np.eye(3))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"t": np.zeros(3)}, "t must have shape"),
        ({"poses": np.eye(4)}, "poses must have shape"),
        ({"poses": np.eye(4)[None]}, "poses must have shape"),
        ({"poses": np.full((2, 4, 4), np.nan)}, "poses must be rigid"),
        ({"poses": np.stack([2 * np.eye(4)] * 2)}, "poses must be rigid"),
        ({"poses": np.stack([np.diag([1.0, 1, -1, 1])] * 2)}, "poses must be rigid"),
        ({"times": (0, 1, 2)}, "times must be 2 rising"),
        ({"times": (1, 0)}, "times must be 2 rising"),
        ({"times": (0, np.inf)}, "times must be 2 rising"),
        ({"reference_time": 2.0}, "reference_time must be within"),
        ({"reference_time": np.nan}, "reference_time must be within"),
    ],
)
def test_wrong_arguments_are_refused(change, message):
    arguments = {"t": np.zeros(5), "poses": np.stack([np.eye(4)] * 2), "times": (0.0, 1.0), "reference_time": 0.0}
    with pytest.raises(ValueError, match=message):
        compensate_motion(np.zeros((5, 3), np.float32), **{**arguments, **change})


def test_more_poses_than_the_plan_takes_are_refused():
    poses, times = drive(3, 16)
    with pytest.raises(ValueError, match="max_poses"):
        MotionCompensation(capacity=16).set_poses(poses, times, times[0])


def test_parts_give_the_bytes_of_the_kernel_for_gpus(monkeypatch):
    """Points in the order of time and in none, of few poses and of many, each at a row of its own among the times."""
    from warploom.kernels import motion

    rng = np.random.default_rng(17)
    for m, n in ((2, 1), (3, 5000), (12, 700), (40, 3000)):
        poses, times = drive(m, 18 + m)
        points, t = cloud(n, times, 19, reach=0.01)
        rows = rng.permutation(n)
        t = t.astype(np.float32) if m % 2 else t
        xyz, stamps = wp.array(points[:, :3].copy(), dtype=wp.vec3, device="cpu"), wp.array(t, device="cpu")
        index, count = wp.array(rows.astype(np.int32), device="cpu"), wp.array([n], dtype=wp.int32, device="cpu")
        plan = MotionCompensation(capacity=n, max_poses=m)
        plan.set_poses(poses, times, times[1])
        expected, outside = wp.zeros(n, dtype=wp.vec3, device="cpu"), wp.zeros(1, dtype=wp.int32, device="cpu")
        given = [xyz, stamps, index, count, plan._times, plan._segments, plan._pose_count, outside]
        wp.launch(motion._move_points, n, inputs=given, outputs=[expected], device="cpu")
        for parts in (1, 2, 3, 7):
            monkeypatch.setattr(motion, "parts_for", lambda n, least, parts=parts: parts)
            plan.launch(xyz, stamps, count, rows=index)
            assert plan.xyz.numpy().tobytes() == expected.numpy().tobytes()
            assert plan.outside.numpy()[0] == outside.numpy()[0] > (0 if n > 100 else -1)
        plan.launch(xyz, stamps, count, rows=index, moved=xyz)  # in place
        assert xyz.numpy().tobytes() == expected.numpy().tobytes()
        plan.stand_still()
        plan.launch(xyz, stamps, count, rows=index)
        assert plan.xyz.numpy().tobytes() == expected.numpy().tobytes()
