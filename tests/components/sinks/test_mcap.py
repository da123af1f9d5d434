import math
import threading

import numpy as np
import pytest

from warploom.components.messages import Obstacles
from warploom.components.sinks import McapSink
from warploom.components.sinks.mcap import CLOUD_TOPIC, OBSTACLES_TOPIC, TRANSFORM_TOPIC
from warploom.errors import SinkError


def obstacles(k=3, frame=0, **changes):
    rng = np.random.default_rng(frame)
    boxes = np.hstack(
        [rng.normal(scale=20, size=(k, 3)), rng.uniform(0.5, 5, size=(k, 3)), rng.uniform(-3, 3, size=(k, 1))]
    )
    values = {
        "version": 1_585_897_255_376_374_245 + frame * 100_000_000,
        "frame": frame,
        "frame_id": "lidar",
        "velocity_reference": "world",
        "ids": np.arange(k, dtype=np.int64) + 7,
        "classes": np.arange(k, dtype=np.int32) % 6,
        "scores": rng.uniform(size=k).astype(np.float32),
        "boxes": boxes.astype(np.float32),
        "velocities": np.tile(np.array([[3.0, 4.0]], np.float32), (k, 1)),
        "background": np.arange(k) % 2 == 1,
    }
    return Obstacles(**(values | changes))


def decoded(path):
    """Topic, log time and message of everything in the file, decoded by the schemas in it."""
    protobuf = pytest.importorskip("google.protobuf")
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    from mcap.reader import make_reader

    assert protobuf is not None
    classes, messages = {}, []
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            if schema.name not in classes:
                pool, files = descriptor_pool.DescriptorPool(), descriptor_pb2.FileDescriptorSet.FromString(schema.data)
                for entry in files.file:
                    pool.Add(entry)
                classes[schema.name] = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            assert channel.message_encoding == "protobuf"
            messages.append((channel.topic, message.log_time, classes[schema.name].FromString(message.data)))
    return messages


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_what_was_recorded_is_in_the_file(tmp_path, compression):
    rng = np.random.default_rng(0)
    clouds = [rng.normal(size=(n, 4)).astype(np.float32) for n in (1000, 0, 17)]
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # a quarter turn to the left
    pose[:3, 3] = [10, 20, 0.5]
    with McapSink(tmp_path / "new" / "run.mcap", compression=compression, metadata={"profile": "cpu"}) as sink:
        for frame, cloud in enumerate(clouds):
            sink.write(obstacles(3, frame), latency_ms=5.0, points=cloud, pose=pose)
    assert (sink.written, sink.dropped) == (3, 0)
    messages = decoded(tmp_path / "new" / "run.mcap")
    assert [time for topic, time, _ in messages if topic == CLOUD_TOPIC] == [obstacles(0, f).version for f in range(3)]
    for cloud, (_, _, message) in zip(clouds, (m for m in messages if m[0] == CLOUD_TOPIC), strict=True):
        assert message.point_stride == 16
        assert [field.name for field in message.fields] == ["x", "y", "z", "intensity"]
        np.testing.assert_array_equal(np.frombuffer(message.data, "<f4").reshape(-1, 4), cloud)
    for frame, (_, _, message) in enumerate(m for m in messages if m[0] == OBSTACLES_TOPIC):
        expected = obstacles(3, frame)
        assert [entity.id for entity in message.entities] == ["7", "8", "9"]
        assert len(message.deletions) == 1
        for k, entity in enumerate(message.entities):
            (cube,) = entity.cubes
            place, size, turn = cube.pose.position, cube.size, cube.pose.orientation
            yaw = 2 * math.atan2(turn.z, turn.w)
            values = [place.x, place.y, place.z, size.x, size.y, size.z, yaw]
            np.testing.assert_allclose(values, expected.boxes[k], rtol=1e-6, atol=1e-6)
            (arrow,) = entity.arrows
            assert arrow.shaft_length == pytest.approx(5.0)
            assert [text.text for text in entity.texts] == (
                [] if expected.background[k] else [f"{entity.metadata[0].value} {entity.id}"]
            )
            metadata = {pair.key: pair.value for pair in entity.metadata}
            assert metadata["kind"] == ("background" if expected.background[k] else "foreground")
            assert metadata["frame"] == str(frame)
    transforms = [message for topic, _, message in messages if topic == TRANSFORM_TOPIC]
    assert len(transforms) == 3
    assert (transforms[0].parent_frame_id, transforms[0].child_frame_id) == ("world", "lidar")
    turn = transforms[0].rotation
    np.testing.assert_allclose([turn.x, turn.y, turn.z, turn.w], [0, 0, math.sqrt(0.5), math.sqrt(0.5)], atol=1e-12)
    assert transforms[0].translation.y == 20


def test_frames_without_cloud_objects_or_pose_are_recorded(tmp_path):
    with McapSink(tmp_path / "run.mcap") as sink:
        sink.write(obstacles(0), latency_ms=1)
    topics = [topic for topic, _, _ in decoded(tmp_path / "run.mcap")]
    assert sorted(topics) == sorted([TRANSFORM_TOPIC, OBSTACLES_TOPIC])


def test_a_box_that_is_not_finite_is_left_out_and_an_unknown_velocity_has_no_arrow(tmp_path):
    boxes = np.ones((2, 7), np.float32)
    boxes[0, 0] = np.inf
    with McapSink(tmp_path / "run.mcap") as sink:
        sink.write(obstacles(2, boxes=boxes, velocities=np.full((2, 2), np.nan)), latency_ms=1)
    assert sink.refused == 1
    (message,) = (message for topic, _, message in decoded(tmp_path / "run.mcap") if topic == OBSTACLES_TOPIC)
    assert [entity.id for entity in message.entities] == ["8"]
    assert not message.entities[0].arrows


def test_the_cloud_may_be_changed_after_write(tmp_path):
    points = np.ones((100, 4), np.float32)
    with McapSink(tmp_path / "run.mcap") as sink:
        sink.write(obstacles(1), latency_ms=1, points=points)
        points[:] = 0
    (cloud,) = (message for topic, _, message in decoded(tmp_path / "run.mcap") if topic == CLOUD_TOPIC)
    assert (np.frombuffer(cloud.data, "<f4") == 1).all()


def test_two_recordings_of_the_same_frames_are_equal(tmp_path):
    for name in ("a", "b"):
        with McapSink(tmp_path / name) as sink:
            for frame in range(3):
                sink.write(obstacles(2, frame), latency_ms=1, points=np.ones((10, 4), np.float32))
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_slow_disk_drops_and_counts_or_blocks(tmp_path, monkeypatch):
    """With a writer that stands still: of 20 frames one is with the thread, eight wait, the others are dropped."""
    gate, started = threading.Event(), threading.Event()
    record = McapSink._record

    def slow(self, frame):
        started.set()
        gate.wait()
        record(self, frame)

    monkeypatch.setattr(McapSink, "_record", slow)
    sink = McapSink(tmp_path / "run.mcap", when_full="drop")
    sink.write(obstacles(1, 0), latency_ms=1)
    started.wait()
    for frame in range(1, 20):
        sink.write(obstacles(1, frame), latency_ms=1)
    assert (sink.written, sink.dropped) == (9, 11)
    gate.set()
    sink.close()
    assert sum(topic == OBSTACLES_TOPIC for topic, _, _ in decoded(tmp_path / "run.mcap")) == 9

    gate.clear()
    sink = McapSink(tmp_path / "all.mcap")
    threading.Timer(0.1, gate.set).start()
    for frame in range(20):
        sink.write(obstacles(1, frame), latency_ms=1)
    sink.close()
    assert (sink.written, sink.dropped) == (20, 0)
    assert sum(topic == OBSTACLES_TOPIC for topic, _, _ in decoded(tmp_path / "all.mcap")) == 20


class FullDisk:
    """A file that takes so many bytes and no more."""

    def __init__(self, file, room):
        self.file, self.room = file, room

    def write(self, data):
        self.room -= len(data)
        if self.room < 0:
            raise OSError(28, "No space left on device")
        return self.file.write(data)

    def __getattr__(self, name):
        return getattr(self.file, name)


@pytest.mark.parametrize("room", [0, 100, 50_000, 400_000])
def test_a_full_disk_is_told_and_nothing_hangs(tmp_path, room):
    points = np.random.default_rng(0).normal(size=(10_000, 4)).astype(np.float32)
    sink = McapSink(tmp_path / "run.mcap")
    sink._file._file = FullDisk(sink._file._file, room)

    def record():
        for frame in range(30):
            sink.write(obstacles(2, frame), latency_ms=1, points=points)
        sink.close()

    with pytest.raises(SinkError, match=r"run\.mcap.*No space left"):
        record()
    with pytest.raises(SinkError, match="No space left"):
        sink.close()
    sink.close()

    dropping = McapSink(tmp_path / "drop.mcap", when_full="drop")
    dropping._file._file = FullDisk(dropping._file._file, 0)
    for frame in range(30):
        dropping.write(obstacles(2, frame), latency_ms=1, points=points)
    with pytest.raises(SinkError, match="No space left"):
        dropping.close()
    assert dropping.written + dropping.dropped == 30


def test_wrong_arguments_and_places_are_told(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(SinkError, match="cannot be created"):
        McapSink(tmp_path / "file" / "run.mcap")
    with pytest.raises(ValueError, match="expected zstd, lz4 or none"):
        McapSink(tmp_path / "a.mcap", compression="gzip")
    with pytest.raises(ValueError, match="expected block or drop"):
        McapSink(tmp_path / "a.mcap", when_full="wait")
    with McapSink(tmp_path / "run.mcap") as sink, pytest.raises(ValueError, match=r"expected \(n, 4\)"):
        sink.write(obstacles(), latency_ms=1, points=np.zeros((4, 3)))
    with pytest.raises(SinkError, match="closed"):
        sink.write(obstacles(), latency_ms=1)


def test_an_error_inside_the_block_is_not_hidden_by_the_sink_s(tmp_path):
    def run():
        with McapSink(tmp_path / "run.mcap") as sink:
            sink._file._file = FullDisk(sink._file._file, 0)
            sink.write(obstacles(1), latency_ms=1)
            raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        run()
