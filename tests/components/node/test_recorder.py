"""The component that records topics of a node."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from warploom.components.node.recorder import TopicRecorder
from warploom.dag import Process, load_module
from warploom.datamesh import CommitPolicy, Output
from warploom.datamesh.recording import GAPS, EventKind
from warploom.datamesh.recording_reader import Recording
from warploom.errors import ConfigError, SinkError

MODULE = """\
module: recording
components:
  - name: recorder
    kind: generic
    class: warploom.components.node.recorder.TopicRecorder
    config: {{path: {path}, {more}}}
    inputs: {inputs}
"""


@pytest.fixture
def process(tmp_path):
    def process(path=tmp_path / "out" / "run.mcap", more="when_full: block", inputs="{a: a, b: b}"):
        file = tmp_path / "m.yaml"
        file.write_text(MODULE.format(path=path, more=more, inputs=inputs))
        return Process([load_module(file)], external={"a": object, "b": object})

    return process


def commit(process, topic, version, value):
    output = Output()
    output.bind(topic, process.mesh.window(topic))
    with output.allocate_change() as change:
        change.set_version(version)
        change.value = value
        output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)


def commits(path):
    return [(event.topic, event.version, event.value) for event in Recording(path) if event.kind is EventKind.COMMIT]


@pytest.mark.parametrize("more", ["write_through: true", "write_through: false, compression: zstd"])
def test_it_records_what_its_inputs_name_and_closes_the_file(process, tmp_path, more):
    one = process(more=f"{more}, when_full: block")
    one.start()
    commit(one, "a", 1, 7)
    commit(one, "b", 2, "x")
    commit(one, "c", 3, "not asked for")
    one.stop()
    path = next((tmp_path / "out").iterdir())
    assert commits(path) == [("a", 1, 7), ("b", 2, "x")]
    assert Recording(path).broken is None
    component = one.components["recorder"]
    assert component.state() == {"file": str(path), "commits": 2}
    assert component.idle_because is None


def test_each_start_makes_a_file_of_its_own(process, tmp_path):
    path = tmp_path / "out" / "run.mcap"
    one = process(path)
    one.start()
    one.stop()
    name = next(path.parent.iterdir()).name
    assert name.startswith("run-2")
    assert name.endswith(f"-{os.getpid()}.mcap")


def cut_short(path):
    """What a killed recorder leaves: the file without its end."""
    data = path.read_bytes()
    path.write_bytes(data[: data.rindex(b"warploom.end") - 20])


def test_after_a_kill_it_goes_on_in_a_further_file_and_says_what_is_missing(process, tmp_path):
    first = process()
    first.start()
    for version in (1, 2, 3):
        commit(first, "a", version, version)
        commit(first, "b", version, version)
    first.stop()
    before = next((tmp_path / "out").iterdir())
    before = before.rename(before.with_stem("run-20260101T000000-1"))
    cut_short(before)
    second = process()
    second.start()
    for version in (2, 3, 4):  # what the producer keeps reaches back to the end of the file before
        commit(second, "a", version, version)
    for version in (7, 8):  # here it does not
        commit(second, "b", version, version)
    said = second.components["recorder"].state()
    assert (said["continues"], said["gaps"]) == (before.name, 1)
    assert second.mesh.losses.as_dict()["recorder b"] == {"gap": 1}
    second.stop()
    path = next(path for path in (tmp_path / "out").iterdir() if path != before)
    recording = Recording(path)
    gaps = [event for event in recording if event.topic == GAPS]
    assert [(event.version, event.value) for event in gaps] == [(7, ("b", 0, 3, 7, before.name))]
    assert recording.metadata["continues"] == before.name
    assert commits(path) == [("a", 2, 2), ("a", 3, 3), ("a", 4, 4), ("b", 7, 7), ("b", 8, 8)]
    third = process()
    third.start()
    assert "continues" not in third.components["recorder"].state(), "the one before was closed"
    third.stop()


def test_a_file_of_another_node_or_recorder_is_not_continued(process, tmp_path, monkeypatch):
    one = process()
    one.start()
    commit(one, "a", 1, 1)
    one.stop()
    path = next((tmp_path / "out").iterdir())
    cut_short(path)
    (tmp_path / "out" / "run-0.mcap").write_bytes(b"no recording")
    monkeypatch.setattr("warploom.components.node.recorder._session", lambda: "another start of the node")
    two = process()
    two.start()
    commit(two, "a", 9, 9)
    assert "gaps" not in two.components["recorder"].state()
    two.stop()


def test_bad_configurations_and_folders_are_told(process, tmp_path):
    with pytest.raises(ConfigError, match=r"m.yaml:6: components.0.config.when_ful: unknown key; did you mean"):
        process(more="when_ful: drop")
    (tmp_path / "file").write_text("")
    one = process(tmp_path / "file" / "run.mcap")
    with pytest.raises(SinkError, match="cannot be created"):
        one.start()


def test_without_inputs_it_says_that_it_is_idle(process):
    assert TopicRecorder("r").idle_because == "its inputs name no topic"


def test_what_was_written_when_its_process_is_killed_is_there(tmp_path):
    """All but what waited in the queue: here nothing, as the process says so itself before it dies."""
    code = f"""
import os, signal, time
from warploom.datamesh import CommitPolicy, DataMesh, Output
from warploom.datamesh.recording import Recorder
mesh = DataMesh()
recorder = Recorder({str(tmp_path / "run.mcap")!r}, write_through=True)
recorder.watch(mesh, ["a"])
output = Output()
output.bind("a", mesh.window("a"))
for version in range(100):
    with output.allocate_change() as change:
        change.set_version(version)
        change.value = version
        output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)
while recorder.written < 100:
    time.sleep(0.01)
os.kill(os.getpid(), signal.SIGKILL)
"""
    assert subprocess.run([sys.executable, "-c", code]).returncode == -9
    assert commits(Path(tmp_path / "run.mcap")) == [("a", n, n) for n in range(100)]
    recording = Recording(tmp_path / "run.mcap")
    list(recording)
    assert recording.broken is not None
    assert np.all(np.diff([event.version for event in recording]) == 1)
