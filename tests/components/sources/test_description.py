import json
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.components.messages import Obstacles
from warploom.components.sinks import JsonLinesSink, McapSink
from warploom.components.sources import describe, describe_lines
from warploom.datamesh import CommitPolicy, DataMesh, Entry
from warploom.datamesh.recording import Recorder
from warploom.errors import SourceError


def nothing(frame):
    return Obstacles(
        version=frame * 100_000_000,
        frame=frame,
        frame_id="lidar",
        velocity_reference="ego",
        ids=np.array([4], np.int64),
        classes=np.zeros(1, np.int32),
        scores=np.ones(1, np.float32),
        boxes=np.ones((1, 7), np.float32),
        velocities=np.zeros((1, 2), np.float32),
        background=np.zeros(1, bool),
    )


def test_a_scan_is_described(tmp_path):
    points = np.array([[1, -2, 3, 0.5], [-1, 2, 5, 0.25], [np.nan, 0, 0, 0]], np.float32)
    points.tofile(tmp_path / "a.bin")
    description = describe(tmp_path / "a.bin")
    assert description["kind"] == "scan"
    assert description["frames"] == 1
    assert description["points"] == [3]
    assert description["points not finite"] == 1
    assert description["x [m]"] == [-1.0, 1.0]
    assert description["fields"] == ["x", "y", "z", "intensity"]
    json.dumps(description)
    assert "points: 3" in describe_lines(description)


def test_a_folder_is_described_and_a_bad_scan_in_it_told(tmp_path):
    for number in range(5):
        np.zeros((10, 4), np.float32).tofile(tmp_path / f"{number}.bin")
    (tmp_path / "2.bin").write_bytes(b"123")
    description = describe(f"kitti:{tmp_path}")
    assert description["kind"] == "KITTI folder, bare"
    assert description["frames"] == 5
    assert description["duration [s]"] == 0.4
    assert len(description["cannot be read"]) == 1


def test_an_empty_scan_is_described(tmp_path):
    (tmp_path / "a.bin").touch()
    assert describe(tmp_path / "a.bin")["points"] == [0]


def test_a_recording_and_its_objects_are_described(tmp_path):
    with McapSink(tmp_path / "run.mcap") as recording, JsonLinesSink(tmp_path / "objects.jsonl") as objects:
        for frame in range(4):
            recording.write(nothing(frame), latency_ms=1, points=np.zeros((10, 4), np.float32))
            objects.write(nothing(frame), latency_ms=1)
    description = describe(tmp_path / "run.mcap")
    assert description["messages"] == 12
    assert description["duration [s]"] == 0.3
    assert description["compression"] == ["zstd"]
    cloud = {"messages": 4, "schema": "foxglove.PointCloud", "encoding": "protobuf"}
    assert description["topics"]["/lidar/points"] == cloud
    assert "  /lidar/points: messages 4, schema foxglove.PointCloud, encoding protobuf" in describe_lines(description)
    description = describe(tmp_path / "objects.jsonl")
    assert (description["frames"], description["objects"], description["tracks"]) == (4, 4, 1)
    assert description["classes"]["vehicle"] == 4


def test_a_time_of_a_recording_is_called_what_it_is(tmp_path):
    mesh, before = DataMesh(), time.time_ns()
    with Recorder(tmp_path / "run.mcap") as recorder:
        recorder.watch(mesh, ["number"])
        mesh.window("number").commit(CommitPolicy.DISCARD_OUT_OF_ORDER, Entry(7, 1, 0, mesh.clock.monotonic_ns()))
    description = describe(tmp_path / "run.mcap")
    assert description["first log time [ns]"] >= before, "of the wall clock, where the version is 7"
    assert "first version [ns]" not in description


@given(st.integers(0, 3000))
@settings(max_examples=30, deadline=None)
def test_a_truncated_recording_is_told(tmp_path_factory, length):
    folder = tmp_path_factory.mktemp("recording")
    with McapSink(folder / "run.mcap") as sink:
        sink.write(nothing(0), latency_ms=1)
    whole = (folder / "run.mcap").read_bytes()
    (folder / "run.mcap").write_bytes(whole[: min(length, len(whole) - 1)])
    with pytest.raises(SourceError, match=r"run\.mcap"):
        describe(folder / "run.mcap")


def test_what_is_missing_is_told(tmp_path):
    for name in ("a.mcap", "a.jsonl", "a.bin"):
        with pytest.raises(SourceError, match="no such file"):
            describe(tmp_path / name)
