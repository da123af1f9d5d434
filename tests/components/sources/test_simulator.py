import numpy as np
import pytest

from warploom.components.sources import SimulatorSource, open_source
from warploom.errors import ConfigError
from warploom.models.geometry import points_in_boxes

URI = "sim:street?seed=3&duration=0.2&lidar=vlp16"


@pytest.fixture(scope="module")
def source():
    return open_source(URI)


@pytest.fixture(scope="module")
def frames(source):
    return list(source)


def test_the_keys_reach_the_simulator(source, frames):
    assert isinstance(source, SimulatorSource)
    assert len(source) == len(frames) == 2
    assert frames[0].ring.max() == 15
    assert source.name == "sim:street?seed=3&duration=0.2&lidar=vlp16"
    assert frames[1].version - frames[0].version == 100_000_000


def test_a_frame_has_everything_a_real_one_can_have_and_the_truth(frames):
    for frame in frames:
        n, k = len(frame.points), len(frame.truth.boxes)
        assert frame.points.shape == (n, 4)
        assert frame.points.dtype == np.float32
        assert frame.ring.shape == frame.t.shape == frame.truth.ground.shape == (n,)
        assert frame.pose.shape == (4, 4)
        truth = frame.truth
        assert truth.boxes.shape == (k, 7)
        assert truth.velocities.shape == (k, 2)
        assert len(truth.classes) == len(truth.ids) == len(truth.points) == k > 0


def test_sweeps_take_their_time_and_say_where_the_sensor_was(frames):
    """At 10 Hz from half a turn before the version to half a turn after it, at some 8 m/s."""
    for frame in frames:
        assert frame.t.min() == pytest.approx(-0.05, abs=2e-3)
        assert frame.t.max() == pytest.approx(0.05, abs=2e-3)
        np.testing.assert_allclose(frame.pose_times, [-0.05, 0.0, 0.05], atol=1e-9)
        np.testing.assert_array_equal(frame.poses[1], frame.pose)
        assert 0.5 < np.linalg.norm(frame.poses[2, :3, 3] - frame.poses[0, :3, 3]) < 1.2
    # One sweep ends where the next begins.
    np.testing.assert_allclose(frames[0].poses[2], frames[1].poses[0], atol=1e-6)


@pytest.fixture(scope="module")
def instant():
    return next(open_source(f"{URI}&turning=0"))


def test_sweeps_of_an_instant_need_no_poses(instant):
    assert not instant.t.any()
    assert instant.poses is None
    assert instant.pose is not None


def test_boxes_hold_the_points_that_the_truth_says(instant):
    truth = instant.truth
    held = points_in_boxes(instant.points, truth.boxes, margin=0.05).sum(axis=1)
    # What else stands in a box, such as the road below a car, comes on top.
    # Noise along the ray takes single points out, so a few points on an object say nothing: all together do.
    many = truth.points >= 50
    assert (held[many] >= 0.95 * truth.points[many]).all()
    assert np.minimum(held, truth.points).sum() >= 0.98 * truth.points.sum()


def test_iterating_again_gives_the_same_frames(source, frames):
    again = list(source)
    for one, other in zip(frames, again, strict=True):
        assert one.version == other.version
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_array_equal(one.truth.boxes, other.truth.boxes)


@pytest.mark.parametrize("uri", ["sim:moon", "sim:street?lidar=nothing", "sim:street?duration=0"])
def test_what_the_simulator_does_not_know_is_a_bad_configuration(uri):
    with pytest.raises(ConfigError, match="sim:"):
        open_source(uri)
