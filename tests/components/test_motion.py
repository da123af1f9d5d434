"""What of a frame's poses is taken to undo the sensor's motion, and what is said where there are none."""

import dataclasses

import numpy as np
import pytest

import warploom as wl
from warploom.components.messages import PointLabels, SensorFrame
from warploom.components.motion import MAX_POSES, sweep_motion
from warploom.components.pipeline import Latency, PerceptionFrame
from warploom.datamesh import LossCounters
from warploom.datamesh.messages.codec import decode, encode

N = 400


def poses_at(times):
    """10 m/s along x."""
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3] = 10.0 * np.asarray(times)
    return poses


def sweep(times=(-0.05, 0.0, 0.05), t=None, **more):
    rng = np.random.default_rng(1)
    points = rng.normal(0, 20, (N, 4)).astype(np.float32)
    t = np.linspace(-0.05, 0.05, N, dtype=np.float32) if t is None else t
    given = {"poses": poses_at(times), "pose_times": np.array(times, np.float64)} | more
    return SensorFrame(version=7, index=0, points=points, t=t, **given)


def counted(frame):
    losses = LossCounters()
    motion = sweep_motion(frame, losses, "filter")
    return motion, losses.as_dict().get("filter", {})


def test_poses_and_times_are_taken_as_they_are():
    frame = sweep()
    motion, losses = counted(frame)
    assert motion.t is frame.t
    np.testing.assert_array_equal(motion.poses, frame.poses)
    np.testing.assert_array_equal(motion.times, frame.pose_times)
    assert not losses


@pytest.mark.parametrize("t", [None, np.zeros(N, np.float32)])
def test_points_of_one_time_need_nothing(t):
    frame = dataclasses.replace(sweep(), t=t, poses=None, pose_times=None)
    assert counted(frame) == (None, {})


@pytest.mark.parametrize(
    "more",
    [
        {"poses": None},
        {"pose_times": None},
        {"poses": poses_at([0.0]), "pose_times": np.zeros(1)},
        {"pose_times": np.array([0.01, 0.02, 0.03])},
        {"pose_times": np.array([-0.3, -0.2, -0.1])},
        {"pose_times": np.full(3, np.nan)},
    ],
)
def test_without_poses_about_the_version_nothing_is_done_and_that_is_counted(more):
    assert counted(sweep(**more)) == (None, {"not_compensated": 1})


def test_only_the_poses_about_the_sweep_are_taken():
    times = np.arange(-20, 21) * 0.02
    motion, losses = counted(sweep(times=times))
    np.testing.assert_allclose(motion.times, [-0.06, -0.04, -0.02, 0, 0.02, 0.04, 0.06], atol=1e-12)
    assert not losses


def test_of_very_many_poses_some_are_taken_that_span_the_sweep():
    times = np.arange(-2000, 2001) * 1e-4
    motion, _ = counted(sweep(times=times))
    assert len(motion.times) == len(motion.poses) == MAX_POSES
    assert motion.times[0] <= -0.05 + 1e-4
    assert motion.times[-1] >= 0.05 - 1e-4
    assert (np.diff(motion.times) > 0).all()


def test_points_before_and_after_the_poses_are_counted():
    motion, losses = counted(sweep(times=(-0.025, 0.0, 0.025)))
    assert motion is not None
    assert losses == {"beyond_poses": int((np.abs(sweep().t) > 0.026).sum())}


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"t must have shape \(400,\)"):
        sweep_motion(sweep(t=np.ones(3, np.float32)))
    with pytest.raises(ValueError, match=r"poses must have shape \(3, 4, 4\)"):
        sweep_motion(sweep(poses=np.eye(4)))


def test_a_perceived_frame_shows_the_points_where_perception_saw_them():
    frame, labels = sweep(), PointLabels.unknown(N)
    what = {"objects": None, "ground": labels.ground, "height": labels.height, "clusters": labels.clusters}
    what |= {"latency": Latency(1.0), "dropped": {}, "sensor": frame}
    seen = PerceptionFrame(**what, compensated=True).points
    np.testing.assert_array_equal(seen, wl.compensate_motion(frame.points, frame.t, frame.poses, frame.pose_times, 0.0))
    # At 10 m/s along x what was seen at t is 10 t farther on.
    np.testing.assert_allclose(seen[:, 0] - frame.points[:, 0], 10.0 * frame.t, atol=1e-4)
    assert PerceptionFrame(**what).points is frame.points


def test_recordings_keep_the_poses():
    frame = sweep()
    again = decode(encode(frame))
    np.testing.assert_array_equal(again.poses, frame.poses)
    np.testing.assert_array_equal(again.pose_times, frame.pose_times)
