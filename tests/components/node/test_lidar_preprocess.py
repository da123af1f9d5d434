"""What is no point goes, the rest stays in its order with all that belongs to it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from warploom.components.messages import SensorFrame, Truth
from warploom.components.node.lidar_preprocess import LidarPreprocess, LidarPreprocessConfig, usable_points
from warploom.dag import Trigger
from warploom.datamesh import CommitPolicy, DataMesh, Output, Status

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
    one.bind(mesh, {"raw": "raw", "points": "points"})
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
