"""What is no point goes, the rest stays in its order with all that belongs to it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from warploom.components.execution import ExecutionContext
from warploom.components.messages import SensorFrame, Truth
from warploom.components.node.ego_poses import odometry_matrix
from warploom.components.node.lidar_preprocess import LidarPreprocess, LidarPreprocessConfig, usable_points
from warploom.components.profile import SensorSpec
from warploom.dag import Trigger
from warploom.datamesh import CommitPolicy, DataMesh, Output, Status
from warploom.datamesh.messages.geometry import Point, Pose, PoseWithCovariance, Quaternion
from warploom.datamesh.messages.nav import Odometry

EGO = (-2.0, -1.0, -2.0, 2.0, 1.0, 0.5)


def reference(points, config):
    """Point by point, in plain Python."""
    kept, dropped = [], {"non_finite": 0, "near": 0, "ego": 0}
    for x, y, z in points[:, :3].astype(np.float64):
        if not all(np.isfinite([x, y, z])):
            reason = "non_finite"
        elif config.min_range > 0 and x * x + y * y + z * z < config.min_range**2:
            reason = "near"
        elif config.ego_box and all(
            low <= value < high
            for low, value, high in zip(config.ego_box[:3], (x, y, z), config.ego_box[3:], strict=True)
        ):
            reason = "ego"
        else:
            reason = None
        kept.append(reason is None)
        if reason is not None:
            dropped[reason] += 1
    return np.array(kept, bool), dropped


values = st.one_of(
    st.integers(-40, 40).map(lambda k: k / 8), st.sampled_from([np.nan, np.inf, -np.inf, 1e15, -2.0, 2.0, 0.5])
)


@given(arrays(np.float32, st.tuples(st.integers(0, 30), st.just(4)), elements=values.map(np.float32)))
def test_it_keeps_what_a_plain_loop_keeps(points):
    """Eighths are exact in float32, so that both decide on the same numbers."""
    for config in (
        LidarPreprocessConfig(),
        LidarPreprocessConfig(ego_box=EGO),
        LidarPreprocessConfig(ego_box=EGO, min_range=1.0),
    ):
        kept, dropped = usable_points(points, config)
        expected, counts = reference(points, config)
        np.testing.assert_array_equal(kept, expected)
        assert dropped == counts
        assert int(kept.sum()) + sum(dropped.values()) == len(points)


def component(config):
    mesh = DataMesh()
    one = LidarPreprocess("preprocess")
    one.bind(mesh, {"raw": "raw", "points": "points", "odometry": "preprocess/odometry"})
    one.init(LidarPreprocessConfig.model_validate(config))
    raw = Output()
    raw.bind("raw", mesh.window("raw"))
    return one, mesh, raw


def commit(raw, frame):
    with raw.allocate_change() as change:
        change.set_version(frame.version)
        change.value = frame
        raw.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)


def frame_of(points):
    n = len(points)
    truth = Truth(
        boxes=np.zeros((0, 7), np.float32),
        classes=np.zeros(0, np.int32),
        ids=np.zeros(0, np.int64),
        velocities=np.zeros((0, 2), np.float32),
        points=np.zeros(0, np.int32),
        ground=np.arange(n) % 2 == 0,
        ground_scored=np.arange(n) % 3 == 0,
    )
    return SensorFrame(
        version=5,
        index=0,
        points=points,
        ring=np.arange(n, dtype=np.uint16),
        t=np.arange(n, dtype=np.float32),
        truth=truth,
    )


def test_what_belongs_to_the_points_stays_with_them():
    points = np.array([[9, 0, 0, 1], [np.nan, 0, 0, 2], [0, 0, 0, 3], [0, 9, 0, 4]], np.float32)
    one, mesh, raw = component({"ego_box": EGO})
    commit(raw, frame_of(points))
    assert one.process(Trigger(5, 123)) is Status.OK
    out = mesh.window("points").snapshot().last()
    np.testing.assert_array_equal(out.points, points[[0, 3]])
    np.testing.assert_array_equal(out.ring, [0, 3])
    np.testing.assert_array_equal(out.t, [0, 3])
    np.testing.assert_array_equal(out.truth.ground, [True, False])
    np.testing.assert_array_equal(out.truth.ground_scored, [True, True])
    entry = mesh.window("points").snapshot().entry(0)
    assert (entry.version, entry.received_ns) == (5, 123), "latency counts from the reception of the sweep"
    assert one.state() == {"sweeps": 1, "points non_finite": 1, "points near": 0, "points ego": 1}


def test_a_sweep_of_which_nothing_goes_is_not_copied():
    one, mesh, raw = component({"ego_box": EGO, "min_range": 0.1})
    frame = frame_of(np.full((6, 4), 9, np.float32))
    commit(raw, frame)
    one.process(Trigger(5))
    assert mesh.window("points").snapshot().last() is frame


def test_a_sweep_that_is_gone_is_a_miss():
    one, _, _ = component({})
    assert one.process(Trigger(77)) is Status.MISS


def test_a_box_whose_bounds_are_swapped_is_refused():
    with pytest.raises(ValueError, match="ego_box must be xmin ymin zmin xmax ymax zmax"):
        LidarPreprocessConfig(ego_box=(1, 0, 0, -1, 1, 1))


# ---- poses of the odometry


def odometry_at(x, yaw):
    half = 0.5 * yaw
    pose = Pose(position=Point(x, 0.0, 0.0), orientation=Quaternion(0.0, 0.0, np.sin(half), np.cos(half)))
    return Odometry(pose=PoseWithCovariance(pose=pose))


def with_odometry(stamps, **config):
    """A component whose odometry says 10 m/s along x and 0.5 rad/s to the left at some times [s]."""
    mesh = DataMesh()
    one = LidarPreprocess("preprocess", ExecutionContext(sensors={"top": SensorSpec.model_validate(TOP)}))
    one.bind(mesh, {"raw": "raw", "points": "points", "odometry": "odometry"})
    one.init(LidarPreprocessConfig.model_validate(config))
    raw, odometry = Output(), Output()
    raw.bind("raw", mesh.window("raw"))
    odometry.bind("odometry", mesh.window("odometry"))
    for stamp in stamps:
        with odometry.allocate_change() as change:
            change.set_version(round(stamp * 1e9))
            change.value = odometry_at(10.0 * stamp, 0.5 * stamp)
            odometry.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)
    return one, mesh, raw


TOP = {"name": "top", "mounting": {"xyz": [1.0, 0.0, 2.0], "rpy_deg": [0, 0, 90]}}


def sweep(**more):
    t = np.linspace(-0.05, 0.05, 9, dtype=np.float32)
    return SensorFrame(version=5_000_000_000, index=0, points=np.full((9, 4), 9, np.float32), t=t, **more)


def expected_pose(stamp, mounting=None):
    yaw = 0.5 * stamp
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[0, 3] = 10.0 * stamp
    return pose if mounting is None else pose @ mounting


@pytest.mark.parametrize(
    "stamps",
    [
        [4.8, 4.9, 4.96, 4.98, 5.0, 5.02, 5.04, 5.06, 5.2],
        [4.8, 4.9, 5.0],  # none for the second half yet
        [4.7, 4.9],  # none since its beginning
        [5.1, 5.2],  # a late start
    ],
)
def test_a_sweep_gets_the_poses_of_the_odometry_and_of_going_on_like_that(stamps):
    """Of a motion at constant rates, which going on like that is equal to; chords for arcs, within 2 mm."""
    one, mesh, raw = with_odometry(stamps)
    commit(raw, sweep())
    assert one.process(Trigger(5_000_000_000)) is Status.OK
    out = mesh.window("points").snapshot().last()
    assert out.pose_times[0] <= -0.05 + 1e-6
    assert out.pose_times[-1] >= 0.05 - 1e-6
    assert len(out.poses) == len(out.pose_times) < 9
    for pose, time in zip([*out.poses, out.pose], [*out.pose_times, 0.0], strict=True):
        np.testing.assert_allclose(pose, expected_pose(5.0 + time), atol=2e-3)


def test_the_mounting_takes_the_vehicles_poses_to_the_sensors():
    one, mesh, raw = with_odometry([4.9, 5.0, 5.1], sensor="top")
    commit(raw, sweep())
    one.process(Trigger(5_000_000_000))
    mounting = np.array([[0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]], float)
    np.testing.assert_allclose(mesh.window("points").snapshot().last().pose, expected_pose(5.0, mounting), atol=1e-9)
    with pytest.raises(ValueError, match="'bottom' has no mounting"):
        one.init(LidarPreprocessConfig(sensor="bottom"))


@pytest.mark.parametrize("stamps", [[], [4.9], [4.0, 4.1], [5.5, 5.6]])
def test_without_odometry_near_by_a_sweep_goes_on_without_poses_and_is_counted(stamps):
    one, mesh, raw = with_odometry(stamps)
    frame = sweep()
    commit(raw, frame)
    assert one.process(Trigger(5_000_000_000)) is Status.OK
    assert mesh.window("points").snapshot().last() is frame
    assert one.state().get("sweeps without poses", 0) == (len(stamps) > 0)
    assert mesh.losses.as_dict().get("preprocess", {}).get("no_odometry", 0) == (len(stamps) > 0)


def test_poses_of_the_source_stay():
    one, mesh, raw = with_odometry([4.9, 5.0, 5.1])
    frame = sweep(poses=np.stack([np.eye(4)] * 2), pose_times=np.array([-0.1, 0.1]))
    commit(raw, frame)
    one.process(Trigger(5_000_000_000))
    assert mesh.window("points").snapshot().last() is frame


def test_an_orientation_that_is_none_is_refused():
    bad = Odometry(pose=PoseWithCovariance(pose=Pose(orientation=Quaternion(0, 0, 0, 0))))
    with pytest.raises(ValueError, match="orientation of length 1"):
        odometry_matrix(bad)
