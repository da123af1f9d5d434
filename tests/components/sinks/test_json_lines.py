import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.components.messages import Obstacles
from warploom.components.sinks import JsonLinesSink, read_objects
from warploom.errors import SinkError, SourceError


def obstacles(k=3, frame=0, **changes):
    rng = np.random.default_rng(frame)
    values = {
        "version": 1_585_897_255_376_374_245 + frame * 100_000_000,
        "frame": frame,
        "frame_id": "lidar",
        "velocity_reference": "world",
        "ids": np.arange(k, dtype=np.int64) + 7,
        "classes": np.arange(k, dtype=np.int32) % 6,
        "scores": rng.uniform(size=k).astype(np.float32),
        "boxes": rng.normal(scale=20, size=(k, 7)).astype(np.float32),
        "velocities": rng.normal(size=(k, 2)).astype(np.float32),
        "background": np.arange(k) % 2 == 1,
    }
    return Obstacles(**(values | changes))


def lines(path):
    return path.read_text().splitlines()


def test_a_line_has_the_keys_of_the_contract_in_their_order(tmp_path):
    with JsonLinesSink(tmp_path / "new" / "objects.jsonl") as sink:
        sink.write(
            obstacles(2, missing_inputs=("camera",)), latency_ms=12.34567, points=np.zeros((5, 4)), pose=np.eye(4)
        )
        assert sink.written == 1
    (line,) = lines(tmp_path / "new" / "objects.jsonl")
    record = json.loads(line)
    keys = ["version", "frame", "objects", "missing_inputs", "frame_id", "velocity_reference", "latency_ms"]
    assert list(record) == keys
    assert record["version"] == 1_585_897_255_376_374_245
    assert record["missing_inputs"] == ["camera"]
    assert record["latency_ms"] == 12.346
    first, second = record["objects"]
    assert list(first) == ["id", "class", "score", "box", "velocity", "kind"]
    assert (first["id"], first["class"], first["kind"]) == (7, "vehicle", "foreground")
    assert second["kind"] == "background"
    assert (len(first["box"]), len(first["velocity"])) == (7, 2)


def test_numbers_are_rounded_in_one_way(tmp_path):
    box = np.array([[1.23456, -0.00004, 0, 4, 2, 1.5, 3.141592]], np.float32)
    with JsonLinesSink(tmp_path / "o.jsonl") as sink:
        sink.write(
            obstacles(1, boxes=box, velocities=np.array([[np.nan, -0.0]]), scores=np.array([0.123456])),
            latency_ms=math.inf,
        )
    text = lines(tmp_path / "o.jsonl")[0]
    assert '"score":0.1235,"box":[1.235,0.0,0.0,4.0,2.0,1.5,3.1416],"velocity":[null,0.0]' in text
    assert '"latency_ms":null' in text


def test_the_same_frames_make_the_same_bytes_and_come_back(tmp_path):
    for name in ("a", "b"):
        with JsonLinesSink(tmp_path / name) as sink:
            for frame in range(5):
                sink.write(obstacles(frame, frame), latency_ms=1.5)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    records = list(read_objects(tmp_path / "a"))
    assert [len(record.obstacles) for record in records] == [0, 1, 2, 3, 4]
    for frame, record in enumerate(records):
        expected = obstacles(frame, frame)
        assert record.latency_ms == 1.5
        assert record.obstacles.version == expected.version
        # Half of the last decimal: 0.5 mm, and 0.00005 for yaw and score.
        np.testing.assert_allclose(record.obstacles.boxes, expected.boxes, atol=5.1e-4)
        np.testing.assert_allclose(record.obstacles.boxes[:, 6], expected.boxes[:, 6], atol=5.2e-5)
        np.testing.assert_allclose(record.obstacles.scores, expected.scores, atol=5.1e-5)
        for name in ("ids", "classes", "background"):
            np.testing.assert_array_equal(getattr(record.obstacles, name), getattr(expected, name))


def test_an_object_that_is_not_finite_is_left_out_and_counted(tmp_path):
    boxes = np.ones((3, 7), np.float32)
    boxes[1, 3] = np.nan
    with JsonLinesSink(tmp_path / "o.jsonl") as sink:
        sink.write(obstacles(3, boxes=boxes), latency_ms=1)
        assert sink.refused == 1
    assert [entry["id"] for entry in json.loads(lines(tmp_path / "o.jsonl")[0])["objects"]] == [7, 9]


def test_each_line_is_in_the_file_at_once(tmp_path):
    sink = JsonLinesSink(tmp_path / "o.jsonl")
    for frame in range(3):
        sink.write(obstacles(1, frame), latency_ms=1)
        assert len(lines(tmp_path / "o.jsonl")) == frame + 1
    sink.close()
    sink.close()
    with pytest.raises(SinkError, match="closed"):
        sink.write(obstacles(), latency_ms=1)


def test_a_place_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(SinkError, match=r"objects\.jsonl: cannot be created"):
        JsonLinesSink(tmp_path / "file" / "objects.jsonl")


def test_a_full_disk_is_told():
    try:
        sink = JsonLinesSink("/dev/full")
    except SinkError:
        pytest.skip("no /dev/full here")
    with pytest.raises(SinkError, match="frame 4 cannot be written: No space left"):
        sink.write(obstacles(frame=4), latency_ms=1)
    sink.close()


@given(st.data())
@settings(max_examples=150, deadline=None)
def test_a_damaged_file_is_told_with_its_line(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("objects") / "o.jsonl"
    with JsonLinesSink(path) as sink:
        sink.write(obstacles(2), latency_ms=1)
    raw = bytearray(path.read_bytes()[: data.draw(st.integers(1, 600))])
    for _ in range(data.draw(st.integers(0, 2))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(raw)
    try:
        list(read_objects(path))
    except SourceError as error:
        assert "o.jsonl, line" in str(error)  # noqa: PT017 (either outcome is right)


def test_a_missing_file_of_objects_is_told(tmp_path):
    with pytest.raises(SourceError, match="cannot be read"):
        list(read_objects(tmp_path / "none"))
