"""Recordings as a source: the frames that were committed, up to the break where the file was cut off."""

import numpy as np
import pytest

import warploom as wl
from warploom.components.messages import SensorFrame
from warploom.components.sources import describe
from warploom.components.sources.recording import RecordingSource
from warploom.datamesh import CommitPolicy, DataMesh, Output
from warploom.datamesh.recording import Recorder
from warploom.errors import ConfigError, SourceError


def commit(mesh, topic, version, value):
    output = Output()
    output.bind(topic, mesh.window(topic))
    with output.allocate_change() as change:
        change.set_version(version)
        change.value = value
        output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """Twelve frames, then the same in a second epoch; and a topic of numbers."""
    path = tmp_path_factory.mktemp("recording") / "a.mcap"
    mesh = DataMesh()
    with Recorder(path, compression="none") as recorder:
        recorder.watch(mesh, ["lidar/points", "number"])
        for _ in range(2):
            for index in range(12):
                points = np.random.default_rng(index).normal(size=(20_000, 4)).astype(np.float32)
                commit(mesh, "lidar/points", (index + 1) * 10**8, SensorFrame(version=1, index=index, points=points))
                commit(mesh, "number", (index + 1) * 10**8, index)
            mesh.window("lidar/points").new_epoch()
            mesh.window("number").new_epoch()
    return path


def test_the_frames_of_the_first_epoch_come_out(path):
    source = wl.read(f"mcap:{path}")
    assert isinstance(source, RecordingSource)
    assert [frame.index for frame in source] == list(range(12))
    assert len(source) == 12
    assert source.skipped == []


def test_a_recording_that_was_cut_off_gives_what_is_before(path, tmp_path):
    data = path.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) // 4])
    frames = [frame.index for frame in RecordingSource(cut)]
    assert 2 < len(frames) < 12
    assert frames == list(range(len(frames)))
    told = describe(cut)
    assert "breaks off" in told["broken"]
    assert told["topics"]["lidar/points"]["messages"] == len(frames)


@pytest.mark.parametrize(
    ("uri", "error", "said"),
    [
        ("mcap:", ConfigError, "no file after mcap:"),
        ("mcap:PATH?topik=x", ConfigError, "unknown key 'topik' .did you mean 'topic'"),
        (
            "mcap:PATH?topic=lidar",
            SourceError,
            "no values of topic 'lidar' in the recording; there are: lidar/points, n",
        ),
        ("mcap:absent.mcap", SourceError, "No such file"),
    ],
)
def test_what_makes_no_sense_is_refused(path, uri, error, said):
    with pytest.raises(error, match=said):
        wl.read(uri.replace("PATH", str(path)))


def test_a_topic_of_something_else_is_refused(path):
    with pytest.raises(SourceError, match="topic 'number' has int, not SensorFrame"):
        list(wl.read(f"mcap:{path}?topic=number"))
