"""A data process that reads what it likes, when it likes, replays to the bit: the log says what it found."""

import random
import time
from typing import ClassVar

import pytest

from warploom.dag import DataProcessComponent, Process, load_module
from warploom.dag.replay import Replay, produced_topics
from warploom.dag.run_log import RunLog
from warploom.datamesh import CommitPolicy, Input, Output
from warploom.datamesh.recording import READS, Recorder
from warploom.datamesh.recording_reader import Recording

pytestmark = pytest.mark.usefixtures("no_thread_left")
OUTSIDE = {"sensor/value": int, "sensor/map": int}


class Reader(DataProcessComponent):
    """Commits all that it sees of a topic that does not trigger it, and of its own, at a time of its own."""

    slow: ClassVar[bool] = True

    value: Input[int]
    map: Input[int]
    seen: Output[object]

    def process(self, trigger):
        if self.slow:
            time.sleep(random.Random(trigger.version).choice((0.0, 0.001, 0.004)))
        with self.map.access() as snapshot:
            maps = list(zip(snapshot.versions, snapshot, strict=True))
            why = snapshot.miss(trigger.version)
        with self.value.access() as snapshot:
            newest = snapshot.last()
        waited = self.map.wait(trigger.version, 1_000_000 if trigger.version % 3 == 0 else 0)
        found = None if waited.entry is None else waited.entry.value
        with self.map.access() as snapshot:
            later = snapshot.versions[-1:]
        with self.seen.allocate_change() as change:
            change.set_version(trigger.version)
            change.value = (maps, why.value if why else "there", newest, waited.outcome.value, found, later)
            return self.seen.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)


def module(trigger="value", hand_off="thread", backlog="{policy: block, depth: 20}"):
    return f"""\
module: test
components:
  - name: reader
    kind: data
    class: {__name__}.Reader
    trigger: {trigger}
    hand_off: {hand_off}
    backlog: {backlog}
    inputs: {{value: sensor/value, map: sensor/map}}
    outputs: {{seen: made/seen}}
"""


def feed(mesh, topic, version):
    output = Output()
    output.bind(topic, mesh.window(topic))
    with output.allocate_change() as change:
        change.set_version(version)
        change.value = version % 17
        output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)


def run(mesh):
    """Values, with maps now and then: at the same version, late, settled, or in numbers that evict what was there."""
    chance = random.Random(5)
    for version in range(100, 220):
        what = chance.random()
        if what < 0.2:
            feed(mesh, "sensor/map", version)
        elif what < 0.25:
            mesh.window("sensor/map").settle(version)
        feed(mesh, "sensor/value", version)
        time.sleep(chance.choice((0.0, 0.001, 0.003)))
        if what > 0.9:
            feed(mesh, "sensor/map", version)


def record(write, tmp_path, text):
    with Recorder(tmp_path / "a.mcap") as recorder:
        log = RunLog(recorder.log)
        process = Process([load_module(write(text))], external=OUTSIDE, on_timing=log.on_timing)
        recorder.watch(process.mesh, {*OUTSIDE, *produced_topics(process)})
        log.watch(process)
        process.start()
        run(process.mesh)
        process.stop()
    assert not recorder.dropped
    return Recording(tmp_path / "a.mcap")


def replay(write, text, recording):
    return Replay(recording, Process([load_module(write(text))], external=OUTSIDE, offline=True)).run()


@pytest.mark.parametrize("hand_off", ["thread", "inline"])
@pytest.mark.parametrize(
    ("trigger", "backlog"),
    [("value", "{policy: block, depth: 20}"), ("value", "{policy: latest}"), ("{period_ms: 3}", "{policy: latest}")],
)
@pytest.mark.parametrize("slow", [False, True])
def test_what_a_data_process_read_it_reads_again(write, tmp_path, monkeypatch, hand_off, trigger, backlog, slow):
    text = module(trigger, hand_off, backlog)
    recording = record(write, tmp_path, text)
    monkeypatch.setattr(Reader, "slow", slow)
    result = replay(write, text, recording)
    assert result.good, (result.differences, result.hung)
    assert result.equal["made/seen"] >= 1
    seen = [event.value for event in recording if event.topic == "made/seen" and event.payload is not None]
    if "block" in backlog:  # which loses none, however busy the machine is
        assert len(seen) == 120
        assert len({len(maps) for maps, *_ in seen}) > 5, "snapshots of many sizes were read"
        assert {"found", "timeout"} <= {outcome for _, _, _, outcome, _, _ in seen}


def test_without_its_log_it_would_read_something_else(write, tmp_path, monkeypatch):
    recording = record(write, tmp_path, module())
    monkeypatch.setattr(Reader, "slow", False)
    monkeypatch.setattr("warploom.dag.run_log.ReplayedAccesses", lambda *_: None)
    assert not replay(write, module(), recording).good


def test_each_run_has_its_accesses_in_the_log(write, tmp_path):
    recording = record(write, tmp_path, module())
    logged = [(event.version, *event.value) for event in recording if event.topic == READS]
    made = [event.version for event in recording if event.topic == "made/seen" and event.payload is not None]
    assert sorted(version for version, _, _ in logged) == sorted(made)
    assert {component for _, component, _ in logged} == {"reader"}
    assert all([noted[0] for noted in accesses] == ["map", "value", "map", "map"] for _, _, accesses in logged)


def test_a_run_that_reads_more_than_it_did_is_given_what_is_there(write, tmp_path, monkeypatch):
    recording = record(write, tmp_path, module())
    process = Reader.process

    def twice(self, trigger):
        status = process(self, trigger)
        with self.map.access() as snapshot:
            more.append(len(snapshot))
        return status

    more: list[int] = []
    monkeypatch.setattr(Reader, "process", twice)
    assert replay(write, module(), recording).good
    assert len(more) == len([event for event in recording if event.topic == "made/seen" and event.payload is not None])


def test_an_access_outside_a_run_is_in_no_log(write, tmp_path):
    with Recorder(tmp_path / "a.mcap") as recorder:
        log = RunLog(recorder.log)
        process = Process([load_module(write(module()))], external=OUTSIDE)
        log.watch(process)
        process.start()
        with process.components["reader"].inputs["map"].access() as snapshot:
            assert len(snapshot) == 0
        assert process.components["reader"].inputs["map"].wait(3, 0).entry is None
        process.stop()
    assert [event for event in Recording(tmp_path / "a.mcap") if event.topic == READS] == []
