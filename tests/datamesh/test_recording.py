"""Recordings: everything that was committed comes back, and a broken disk or file costs what it must and no more."""

import errno
import resource
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from warploom.datamesh import CommitPolicy, DataMesh, Output
from warploom.datamesh.messages import encode
from warploom.datamesh.recording import LOSSES, EventKind, Recorder, digest
from warploom.datamesh.recording_reader import Recording
from warploom.errors import SinkError, SourceError


def output_of(mesh, topic) -> Output:
    output = Output()
    output.bind(topic, mesh.window(topic))
    return output


def commit(mesh, topic, version, value, policy=CommitPolicy.DISCARD_OUT_OF_ORDER):
    output = output_of(mesh, topic)
    with output.allocate_change() as change:
        change.set_version(version, received_ns=version + 5)
        change.value = value
        return output.commit(policy, change)


@pytest.mark.parametrize("compression", ["lz4", "zstd", "none"])
def test_commits_settles_and_losses_come_back_in_their_order(tmp_path, compression):
    mesh = DataMesh()
    arrays = [np.random.default_rng(i).normal(size=(i, 3)).astype(np.float32) for i in range(20)]
    with Recorder(tmp_path / "a.mcap", compression=compression, metadata={"source": "test"}) as recorder:
        recorder.watch(mesh, ["cloud", "text"])
        for version, array in enumerate(arrays):
            commit(mesh, "cloud", version, array)
            if version % 3 == 0:
                commit(mesh, "text", version, f"frame {version}")
            else:
                output_of(mesh, "text").settle(version)
        commit(mesh, "cloud", 3, arrays[3])
        commit(mesh, "unrecorded", 1, "x")
    recording = Recording(tmp_path / "a.mcap")
    assert recording.metadata == {"source": "test"}
    events = list(recording)
    assert recording.broken is None
    clouds = [event for event in events if event.topic == "cloud"]
    assert [event.version for event in clouds] == list(range(20))
    assert all(event.received_ns == event.version + 5 < event.committed_ns for event in clouds)
    for event, array in zip(clouds, arrays, strict=True):
        assert event.value.tobytes() == array.tobytes()
        assert event.sha256 == digest(encode(array)) == digest(event.payload)
    texts = [event for event in events if event.topic == "text"]
    assert [event.kind for event in texts] == [EventKind.SETTLE if i % 3 else EventKind.COMMIT for i in range(20)]
    losses = [(event.version, event.value) for event in events if event.topic == LOSSES]
    assert losses == [(3, ("cloud", "duplicate"))]
    stamps = [event.committed_ns for event in events]
    assert stamps == sorted(stamps)
    assert recorder.written == 20 + 7
    assert not recorder.dropped


def test_epochs_are_kept(tmp_path):
    mesh = DataMesh()
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.watch(mesh, ["number"])
        for epoch in range(3):
            for version in range(4):
                commit(mesh, "number", version, epoch * 10 + version)
            mesh.window("number").new_epoch()
    assert [(event.epoch, event.version, event.value) for event in Recording(tmp_path / "a.mcap")] == [
        (epoch, version, epoch * 10 + version) for epoch in range(3) for version in range(4)
    ]


def test_commits_of_many_threads_are_read_in_the_order_of_their_topics(tmp_path):
    mesh = DataMesh(window_capacity=4)
    topics = [f"topic/{i}" for i in range(8)]
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.watch(mesh, topics)
        threads = [
            threading.Thread(target=lambda t=topic: [commit(mesh, t, v, (t, v)) for v in range(200)])
            for topic in topics
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    events = list(Recording(tmp_path / "a.mcap"))
    for topic in topics:
        assert [event.value for event in events if event.topic == topic] == [(topic, v) for v in range(200)]


def test_a_cause_is_read_before_its_effect_however_they_were_told(tmp_path):
    mesh = DataMesh()
    # This subscriber is there before the recorder, so the recorder is told of its commits first.
    mesh.window("cause").subscribe(lambda entry: commit(mesh, "effect", entry.version, "e"), lambda *_: None)
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.watch(mesh, ["cause", "effect"])
        for version in range(50):
            commit(mesh, "cause", version, "c")
    assert "".join(event.value for event in Recording(tmp_path / "a.mcap")) == "ce" * 50


def test_a_topic_may_be_kept_as_hashes(tmp_path):
    mesh = DataMesh()
    value = np.zeros(100_000)
    with Recorder(tmp_path / "a.mcap", digest_only=["cloud"], compression="none") as recorder:
        recorder.watch(mesh, ["cloud"])
        commit(mesh, "cloud", 1, value)
    (event,) = Recording(tmp_path / "a.mcap")
    assert event.sha256 == digest(encode(value))
    assert (tmp_path / "a.mcap").stat().st_size < 5000
    with pytest.raises(LookupError, match="recorded as hashes"):
        _ = event.value


def test_what_cannot_be_encoded_is_counted_and_told_once(tmp_path, caplog):
    mesh = DataMesh()
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.watch(mesh, ["thing"])
        for version in range(5):
            commit(mesh, "thing", version, object() if version < 3 else version)
    assert recorder.dropped == {"not_encodable": 3}
    assert mesh.losses["recorder thing", "not_encodable"] == 3
    assert [event.value for event in Recording(tmp_path / "a.mcap") if event.topic == "thing"] == [3, 4]
    assert caplog.text.count("is left out") == 1


class FullDisk:
    """Takes so many bytes; then the disk is full."""

    def __init__(self, file, room):
        self._file, self._room = file, room

    def write(self, data):
        if self._room <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        taken = self._file.write(bytes(data)[: self._room])
        self._room -= taken
        return taken

    def close(self):
        self._file.close()


@pytest.mark.parametrize("when_full", ["block", "drop"])
def test_a_full_disk_stops_the_recording_and_nothing_else(tmp_path, when_full, caplog):
    mesh = DataMesh()
    recorder = Recorder(tmp_path / "a.mcap", compression="none", when_full=when_full)
    recorder._file._file = FullDisk(recorder._file._file, 9_000_000)
    recorder.watch(mesh, ["cloud"])
    seen = []
    mesh.window("cloud").subscribe(lambda entry: seen.append(entry.version), lambda *_: None)
    for version in range(300):
        commit(mesh, "cloud", version, np.full(50_000, version, np.float32))
        if when_full == "drop":
            time.sleep(0.002)
    recorder.close()
    recorder.close()
    assert seen == list(range(300)), "every commit went on its way"
    assert recorder.failure == "No space left on device"
    assert recorder.dropped["disk"] > 200
    assert recorder.written + recorder.dropped.total() == 300
    assert mesh.losses["recorder cloud", "disk"] == recorder.dropped["disk"]
    assert "the recording broke off: No space left on device" in caplog.text
    # What reached the disk is whole, up to the last message that was cut.
    recording = Recording(tmp_path / "a.mcap")
    read = [event for event in recording if event.topic == "cloud"]
    assert recording.broken is not None
    assert 30 < len(read) <= recorder.written
    assert all((event.value == event.version).all() for event in read)


def test_a_file_that_may_not_grow_is_a_full_disk(tmp_path):
    """The kernel's own refusal, by a limit on the size of files, in a process of its own."""
    code = f"""
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))
import numpy as np
from warploom.datamesh import CommitPolicy, DataMesh, Output
from warploom.datamesh.recording import Recorder
mesh = DataMesh()
output = Output()
output.bind("cloud", mesh.window("cloud"))
recorder = Recorder({str(tmp_path / "a.mcap")!r}, compression="none")
recorder.watch(mesh, ["cloud"])
for version in range(100):
    with output.allocate_change() as change:
        change.set_version(version)
        change.value = np.full(5_000, version)
        output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)
recorder.close()
print(recorder.failure, recorder.dropped["disk"] > 50)
"""
    assert hasattr(resource, "RLIMIT_FSIZE")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "File too large True\n", done.stdout + done.stderr


def test_a_recorder_that_is_too_slow_drops_or_holds_up(tmp_path, monkeypatch):
    for when_full, lost in (("block", False), ("drop", True)):
        mesh = DataMesh()
        recorder = Recorder(tmp_path / "a.mcap", when_full=when_full)
        write = recorder._write
        monkeypatch.setattr(recorder, "_write", lambda event, write=write: (time.sleep(0.002), write(event)))
        recorder.watch(mesh, ["number"])
        for version in range(200):
            commit(mesh, "number", version, version)
        recorder.close()
        assert (recorder.dropped["queue_full"] > 0) is lost
        assert recorder.written + recorder.dropped.total() == 200
        assert recorder.failure is None


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A recording of 40 commits in some ten chunks."""
    path = tmp_path_factory.mktemp("recording") / "whole.mcap"
    mesh = DataMesh()
    with Recorder(path, compression="lz4", metadata={"source": "test"}) as recorder:
        recorder.watch(mesh, ["noise"])
        for version in range(40):
            commit(mesh, "noise", version, np.random.default_rng(version).normal(size=40_000))
    return path


@pytest.mark.parametrize("fraction", [0.05, 0.3, 0.5, 0.75, 0.99])
def test_a_truncated_recording_is_read_up_to_the_break(whole, tmp_path, fraction):
    data = whole.read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[: int(len(data) * fraction)])
    recording = Recording(path)
    assert recording.metadata == {"source": "test"}
    versions = [event.version for event in recording]
    assert versions == list(range(len(versions)))
    assert len(versions) >= int(40 * fraction) - 5
    if len(versions) < 40:
        assert "breaks off" in recording.broken


@pytest.mark.parametrize("write_through", [True, False])
def test_where_each_topic_ends_is_told_of_whole_and_of_truncated_recordings(tmp_path, write_through):
    """The reference: the events as they are read one by one."""
    mesh = DataMesh()
    path = tmp_path / "whole.mcap"
    with Recorder(path, write_through=write_through) as recorder:
        recorder.watch(mesh, ["noise", "text"])
        for version in range(60):
            commit(mesh, "noise", version, np.random.default_rng(version).normal(size=10_000))
            if version % 7 == 0:
                commit(mesh, "text", version, "x" * version)
            output_of(mesh, "text").settle(version + 1)
        mesh.window("noise").new_epoch()
        commit(mesh, "noise", 3, np.zeros(3))
    data = path.read_bytes()
    assert Recording(path).closed
    assert Recording(path).ends() == {"noise": (1, 3), "text": (0, 56)}
    seen = set()
    for size in np.linspace(len(data) // 20, len(data) - 1, 40).astype(int):
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(data[:size])
        recording = Recording(cut)
        events = [event for event in recording if event.kind is EventKind.COMMIT]
        expected = {t: max((e.epoch, e.version) for e in events if e.topic == t) for t in {e.topic for e in events}}
        assert not recording.closed
        assert recording.ends() == expected
        seen.add(tuple(sorted(expected.items())))
    assert len(seen) > 3


def test_damage_within_is_told_and_what_comes_before_is_read(whole, tmp_path):
    data = bytearray(whole.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    recording = Recording(path)
    versions = [event.version for event in recording]
    assert 10 < len(versions) < 40
    assert versions == list(range(len(versions)))
    assert recording.broken is not None


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"not a recording at all, but some text", bytes(500)])
def test_what_is_no_recording_is_refused(tmp_path, content):
    path = tmp_path / "other.mcap"
    path.write_bytes(content)
    with pytest.raises(SourceError, match=r"other\.mcap: is no recording that `warploom record` made"):
        Recording(path)


def test_another_programs_mcap_is_refused(tmp_path):
    from mcap.writer import Writer

    with (tmp_path / "other.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        writer.finish()
    with pytest.raises(SourceError, match="written by something else"):
        Recording(tmp_path / "other.mcap")
    with pytest.raises(SourceError, match="No such file"):
        Recording(tmp_path / "absent.mcap")


def test_bad_arguments_and_places_are_refused(tmp_path):
    with pytest.raises(ValueError, match="compression is 'gzip'; expected lz4, zstd or none"):
        Recorder(tmp_path / "a.mcap", compression="gzip")
    with pytest.raises(ValueError, match="when_full is 'wait'; expected block or drop"):
        Recorder(tmp_path / "a.mcap", when_full="wait")
    with pytest.raises(SinkError, match="cannot be created"):
        Recorder(tmp_path)


def test_no_thread_is_left(tmp_path):
    before = set(threading.enumerate())
    with Recorder(tmp_path / "a.mcap"):
        pass
    assert set(threading.enumerate()) == before
