"""The pipeline on simulated frames and on clouds that no sensor should give."""

import threading

import numpy as np
import pytest

import warploom as wl
from warploom.components.messages import SensorFrame
from warploom.components.perception.filtering import FilteredCloud
from warploom.dag import In, Out, Processor, Status
from warploom.errors import ConfigError, SourceError
from warploom.models.detections import Detections


@pytest.fixture(scope="module")
def street() -> list[SensorFrame]:
    """Six simulated frames."""
    return list(wl.read("sim:street?seed=3&duration=0.6"))


@pytest.fixture(scope="module")
def pipeline():
    with wl.Pipeline.from_profile("cpu") as made:
        yield made


def cloud_frame(index: int, points: np.ndarray) -> SensorFrame:
    return SensorFrame(version=(index + 1) * 100_000_000, index=index, points=points)


def fingerprint(frame) -> bytes:
    """Every byte that perception said of a frame."""
    objects = frame.objects
    arrays = (objects.ids, objects.classes, objects.scores, objects.boxes, objects.velocities, objects.background)
    return b"".join(np.ascontiguousarray(a).tobytes() for a in (*arrays, frame.ground, frame.height, frame.clusters))


def test_every_frame_comes_out_in_order_with_objects_ground_and_clusters(pipeline, street):
    frames = list(pipeline.run(street))
    assert [frame.index for frame in frames] == [frame.index for frame in street]
    for frame, sensor in zip(frames, street, strict=True):
        n = len(sensor.points)
        assert not frame.failed
        assert frame.version == sensor.version == frame.objects.version
        assert frame.ground.shape == frame.height.shape == frame.clusters.shape == (n,)
        assert frame.ground.mean() > 0.2
        assert frame.clusters.max() > 5
        assert not (frame.ground & (frame.clusters >= 0)).any()
        assert frame.latency.total_ms > 0
        assert {"perception.filter", "perception.ground", "perception.detect", "tracking.track"} <= set(
            frame.latency.stages
        )
    assert len(frames[-1].objects) > 0


def test_the_same_frames_give_the_same_bytes_with_one_worker_and_with_four(street):
    runs = []
    for workers in (1, 4):
        with wl.Pipeline.from_profile(
            "cpu", settings={"perception.workers": workers, "perception.in_flight": workers}
        ) as p:
            runs.append([fingerprint(frame) for frame in p.run(street)])
    assert runs[0] == runs[1]


def test_a_pipeline_runs_again_from_the_beginning(pipeline, street):
    first = [fingerprint(frame) for frame in pipeline.run(street)]
    assert [fingerprint(frame) for frame in pipeline.run(street)] == first


def test_clouds_that_no_sensor_should_give_come_out_and_are_counted(pipeline, street):
    good = street[0].points
    bad = good.copy()
    bad[::7, 0] = np.nan
    bad[1::7, 1] = np.inf
    clouds = [
        good,
        np.empty((0, 4), np.float32),
        np.zeros((1, 4), np.float32) + 5,
        bad,
        np.full((50, 4), np.nan, np.float32),
        np.full((50, 4), 1e5, np.float32),
        np.tile(np.float32([8, 1, -1, 0]), (20_000, 1)),
        good,
    ]
    frames = list(pipeline.run(cloud_frame(i, cloud) for i, cloud in enumerate(clouds)))
    assert [frame.index for frame in frames] == list(range(len(clouds)))
    assert not any(frame.failed for frame in frames)
    assert frames[3].dropped["non_finite"] == len(bad[::7]) + len(bad[1::7])
    assert frames[4].dropped["non_finite"] == 50
    assert frames[5].dropped["out_of_range"] == 50
    assert np.array_equal(frames[0].ground, frames[-1].ground)


def test_points_beyond_the_capacity_are_dropped_and_counted(street):
    with wl.Pipeline.from_profile("cpu", settings={"profile.capacity": 50_000}) as pipeline:
        frames = list(pipeline.run(street[:2]))
    n = len(street[0].points)
    assert frames[0].dropped["over_capacity"] == n - 50_000
    assert not frames[0].ground[50_000:].any()
    assert len(frames) == 2


class FailsOnce(Processor):
    """Stands in for the head, and raises in the frame with index 2."""

    filtered: In[FilteredCloud]
    foreground: Out[Detections]

    def process(self, trigger):
        if self.filtered.value.sensor.index == 2:
            raise RuntimeError("made to fail")
        self.foreground.value = Detections.empty()
        return Status.OK


def test_a_processor_that_raises_costs_its_own_output_in_one_frame(street, caplog):
    settings = {"perception.graph.detect.processor": f"{__name__}.FailsOnce"}
    with wl.Pipeline.from_profile("cpu", settings=settings) as pipeline:
        frames = list(pipeline.run(street))
        assert pipeline.losses["perception.detect"]["failed"] == 1
    assert [frame.index for frame in frames] == list(range(6))
    # The main flow goes on with the background alone, and says so.
    assert [frame.objects.missing_inputs for frame in frames if frame.index != 2] == [()] * 5
    assert frames[2].objects.missing_inputs == ("foreground",)
    assert len(frames[2].objects) > 0
    assert "made to fail" in caplog.text


class Scribbles(FailsOnce):
    """Stands in for the head, and writes to the sensor's points, which NumPy's flag alone cannot prevent."""

    def process(self, trigger):
        sensor = self.filtered.value.sensor
        if sensor.index == 1:
            sensor.points.setflags(write=True)
            sensor.points[0, 0] += 1.0
            sensor.points.setflags(write=False)
        self.foreground.value = Detections.empty()
        return Status.OK


def test_a_profile_that_checks_counts_who_writes_to_data_after_their_commit(street):
    settings = {"perception.graph.detect.processor": f"{__name__}.Scribbles", "profile.check": True}
    with wl.Pipeline.from_profile("cpu", settings=settings) as pipeline:
        frames = [cloud_frame(f.index, f.points.copy()) for f in street[:3]]
        assert len(list(pipeline.run(frames))) == 3
        assert pipeline.losses["lidar/points"] == {"modified": 1}


def test_a_source_that_fails_raises_after_the_frames_before_it(pipeline, street):
    def breaking():
        yield from street[:3]
        raise SourceError("the cable is out")

    frames = pipeline.run(breaking())
    assert [next(frames).index for _ in range(3)] == [0, 1, 2]
    with pytest.raises(SourceError, match="the cable is out"):
        next(frames)


def test_versions_that_do_not_rise_are_refused(pipeline, street):
    with pytest.raises(SourceError, match="rising versions"):
        list(pipeline.run([street[1], street[0]]))


def test_leaving_a_run_early_leaves_no_thread(street):
    before = set(threading.enumerate())
    with wl.Pipeline.from_profile("cpu") as pipeline:
        for _ in pipeline.run(street):
            break
    left = [t for t in set(threading.enumerate()) - before if t.is_alive() and t.name != "source"]
    assert not left


def test_what_was_committed_cannot_be_written(pipeline, street):
    frame = next(iter(pipeline.run(street)))
    with pytest.raises(ValueError, match="read-only"):
        frame.objects.boxes[0] = 0
    with pytest.raises(ValueError, match="read-only"):
        frame.ground[0] = True


def test_iterating_objects_gives_them_one_by_one(pipeline, street):
    frame = list(pipeline.run(street))[-1]
    things = list(frame.objects)
    assert len(things) == len(frame.objects)
    assert {thing.kind for thing in things} <= {"foreground", "background"}
    assert all(len(thing.box) == 7 and len(thing.velocity) == 2 for thing in things)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"perceptoin.cluster.radius": 1}, "no component 'perceptoin'; did you mean 'perception'"),
        ({"perception.clutser.radius": 1}, "no vertex 'clutser'; did you mean 'cluster'"),
        ({"perception.cluster.radios": 1}, "unknown key; did you mean 'radius'"),
        ({"perception.cluster.radius": -1}, "greater than 0"),
        ({"profile.capacity": "many"}, "valid integer"),
        ({"profile.device": "cuda:99"}, "no device 'cuda:99' here; there are: cpu"),
    ],
)
def test_a_wrong_setting_names_the_key_and_what_is_known(settings, message):
    with pytest.raises((ConfigError, wl.DeviceError), match=message):
        wl.Pipeline.from_profile("cpu", settings=settings)


def test_an_unknown_profile_names_those_there_are():
    with pytest.raises(ConfigError, match=r"no profile 'cpuu'.*did you mean 'cpu'"):
        wl.Pipeline.from_profile("cpuu")


def test_asking_for_a_topic_that_nobody_gives_is_refused(pipeline, street):
    with pytest.raises(ConfigError, match="no component gives topic 'perception/obstaclez'"):
        next(iter(pipeline.run(street, topics=["perception/obstaclez"])))


def test_realtime_feeds_frames_at_their_pace_and_loses_none_when_there_is_time(pipeline, street):
    """Half a second apart there is time for each frame, on any machine this runs on."""
    slow = [
        SensorFrame(version=i * 1_500_000_000, index=i, points=frame.points[::10]) for i, frame in enumerate(street[:2])
    ]
    assert [frame.index for frame in pipeline.run(slow, realtime=True)] == [0, 1]
