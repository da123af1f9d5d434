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


def test_boxes_hold_the_points_that_the_truth_says(frames):
    truth = frames[0].truth
    held = points_in_boxes(frames[0].points, truth.boxes, margin=0.05).sum(axis=1)
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
