"""A run at its own pace, in which the clock decides much, replays to the bit, because its log says what was decided."""

import random
import time

import numpy as np
import pytest

from warploom.dag import In, Out, Process, Processor, Status, load_module
from warploom.dag.replay import Replay, produced_topics
from warploom.dag.run_log import RunLog
from warploom.datamesh import CommitPolicy, Output
from warploom.datamesh.recording import READS, RUNS, Recorder
from warploom.datamesh.recording_reader import Recording

pytestmark = pytest.mark.usefixtures("no_thread_left")
COMMIT = "{{processor: warploom.dag.CommitDagProcessor, in: {{value: {0}}}, config: {{output: {0}}}}}"


class SlowSum(Processor):
    """Keeps a sum, and now and then takes longer than the next frame; slower than in a replay."""

    value: In[int]
    extra: In[object] = In(optional=True)
    total: Out[object]
    slow = True

    def init(self, config):
        self.sum = 0.0

    def process(self, trigger):
        if self.slow:
            time.sleep(random.Random(trigger.version).choice((0.0, 0.001, 0.008)))
        self.sum = self.sum * 0.5 + self.value.value
        if self.extra.present:
            extra = self.extra.value
            known = extra if isinstance(extra, int) else sum(extra.values.values()) + 1000 * len(extra.absent)
            self.sum += known
        self.total.value = (trigger.version, self.sum)
        return Status.OK


def module(vertices: str, *, trigger: str = "value", more: str = "", inputs: str = "value: sensor/value") -> str:
    return f"""\
module: test
components:
  - name: sums
    kind: dag
    trigger: {trigger}
    inputs: {{{inputs}}}
    outputs: {{total: made/total}}
    backlog: {{policy: latest}}
    workers: 2
    in_flight: 2
{more}    graph:
{vertices}      commit: {COMMIT.format("total")}
"""


SUM = f"      sum: {{processor: {__name__}.SlowSum}}\n"
OUTSIDE = {"sensor/value": int, "sensor/map": int}


def feed(mesh, topic, versions, pause=0.0):
    output = Output()
    output.bind(topic, mesh.window(topic))
    for version in versions:
        with output.allocate_change() as change:
            change.set_version(version)
            change.value = version % 17
            output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)
        if pause:
            time.sleep(random.uniform(0, 2 * pause))


def record(write, tmp_path, text, run):
    """A run at its own pace with its log."""
    with Recorder(tmp_path / "a.mcap") as recorder:
        log = RunLog(recorder.log)
        process = Process([load_module(write(text))], external=OUTSIDE, on_timing=log.on_timing)
        recorder.watch(process.mesh, {*OUTSIDE, *produced_topics(process)})
        log.watch(process)
        process.start()
        run(process.mesh)
        process.stop()
    assert not recorder.dropped
    return Recording(tmp_path / "a.mcap"), process.mesh.losses.as_dict()


def replay(write, text, recording, workers, monkeypatch):
    monkeypatch.setattr(SlowSum, "slow", False)
    changes = {("sums", "workers"): workers, ("sums", "in_flight"): workers}
    process = Process([load_module(write(text), changes)], external=OUTSIDE, offline=True)
    return Replay(recording, process).run()


def check(write, tmp_path, text, run, monkeypatch, commits=20):
    recording, losses = record(write, tmp_path, text, run)
    for workers in (1, 2, 8):
        result = replay(write, text, recording, workers, monkeypatch)
        assert result.good, (workers, result.differences, result.hung)
        assert result.equal["made/total"] >= commits
    return recording, losses


def test_triggers_that_a_backlog_dropped_are_not_run_in_the_replay(write, tmp_path, monkeypatch):
    recording, losses = check(
        write, tmp_path, module(SUM), lambda mesh: feed(mesh, "sensor/value", range(300), 0.001), monkeypatch
    )
    assert losses["sums"]["backlog"] > 20
    taken = [event.version for event in recording if event.topic == RUNS]
    assert len(taken) == 300 - losses["sums"]["backlog"]
    # Without the log they would all be run, and the sums be others.
    monkeypatch.setattr("warploom.dag.replay.RecordedRuns.__bool__", lambda self: False)
    assert not replay(write, module(SUM), recording, 2, monkeypatch).good


RECENT = (
    "      recent: {processor: warploom.dag.GetRecentDagProcessor, out: {value: extra}, config: {input: map}}\n"
    f"      sum: {{processor: {__name__}.SlowSum}}\n"
)
BOTH = "value: sensor/value, map: sensor/map"


def feed_maps_now_and_then(mesh):
    chance = random.Random(5)
    for version in range(100, 300):
        if chance.random() < 0.2:
            feed(mesh, "sensor/map", [version])
        feed(mesh, "sensor/value", [version], 0.002)


def feed_maps_in_time_late_or_never(mesh):
    """Three frames at a time, whose last sum is waited for: on a busy machine too, some waits end with data."""
    for version in range(60):
        if version % 3 == 0:
            feed(mesh, "sensor/map", [version])
        feed(mesh, "sensor/value", [version])
        time.sleep(0.012)
        if version % 3 == 1:
            feed(mesh, "sensor/map", [version])
        if version % 3 == 2:
            wait_for_sum(mesh, version)


def wait_for_sum(mesh, version, seconds=5.0):
    made = mesh.window("made/total")
    end = time.monotonic() + seconds
    while not (found := made.snapshot().versions) or found[-1] < version:
        assert time.monotonic() < end, f"no sum of {version}; the last is of {found[-1:]}"
        time.sleep(0.001)


def test_weak_sync_reads_what_the_recorded_run_read(write, tmp_path, monkeypatch):
    recording, _ = check(write, tmp_path, module(RECENT, inputs=BOTH), feed_maps_now_and_then, monkeypatch)
    reads = [(event.version, event.value[1]["map"][1]) for event in recording if event.topic == READS]
    ages = [version - read for version, read in reads]
    assert min(ages) >= 0
    assert len(set(ages)) > 3, "maps of many ages were read"


ALIGN = (
    "      align: {processor: warploom.dag.AlignDagProcessor, out: {aligned: extra}, "
    "config: {inputs: [map], timeout_ms: 4}}\n"
    f"      sum: {{processor: {__name__}.SlowSum}}\n"
)
FIFO = ("backlog: {policy: latest}", "backlog: {policy: fifo, depth: 20}")


def feed_maps_when_all_frames_wait(mesh):
    """Twenty frames are in the backlog when the datum comes that the later ones of them read."""
    feed(mesh, "sensor/value", range(1, 21))
    time.sleep(0.002)
    feed(mesh, "sensor/map", [0])
    feed(mesh, "sensor/map", range(1, 21))
    wait_for_sum(mesh, 20)


def test_what_weak_sync_read_may_have_come_after_frames_that_waited_behind_it(write, tmp_path, monkeypatch):
    """The player must get past them to what the first is to read, however few may be in flight."""
    monkeypatch.setattr(SlowSum, "process", paced(SlowSum.process))
    text = module(RECENT, inputs=BOTH).replace(*FIFO)
    recording, losses = check(write, tmp_path, text, feed_maps_when_all_frames_wait, monkeypatch, commits=20)
    assert "sums" not in losses
    assert len([event for event in recording if event.topic == READS]) > 10


def test_what_strong_sync_waited_for_may_have_come_after_frames_that_waited_behind_it(write, tmp_path, monkeypatch):
    text = module(ALIGN.replace("timeout_ms: 4", "timeout_ms: 10000"), inputs=BOTH).replace(*FIFO)
    check(write, tmp_path, text, feed_maps_when_all_frames_wait, monkeypatch, commits=20)


def paced(process):
    """A process that takes two milliseconds more in a run that is recorded."""

    def slower(self, trigger):
        time.sleep(0.002 if self.slow else 0.0)
        return process(self, trigger)

    return slower


def test_what_triggered_is_kept_though_a_hundred_others_come_before_its_turn(write, tmp_path, monkeypatch):
    """The window keeps 32 versions. Those that the backlog dropped pass in no time, while a frame is at work."""
    text = module(SUM).replace("in_flight: 2", "in_flight: 1")
    monkeypatch.setattr(SlowSum, "process", paced(SlowSum.process))
    recording, losses = record(write, tmp_path, text, lambda mesh: feed(mesh, "sensor/value", range(1000), 0.00005))
    assert losses["sums"]["backlog"] > 500
    process = Process([load_module(write(text))], external=OUTSIDE, offline=True)
    result = Replay(recording, process).run()
    assert result.good, result.differences
    assert process.mesh.losses.as_dict() == {}


def test_strong_sync_ends_its_waits_as_in_the_recorded_run(write, tmp_path, monkeypatch):
    recording, losses = check(write, tmp_path, module(ALIGN, inputs=BOTH), feed_maps_in_time_late_or_never, monkeypatch)
    assert sum(losses["sums.align"].values()) > 5, "some waits ended without data"
    assert len([event for event in recording if event.topic == READS]) > 5, "and some with"


class Reasons(Processor):
    """Gives why what was waited for is absent."""

    extra: In[object]
    total: Out[object]

    def process(self, trigger):
        self.total.value = [outcome.value for outcome in self.extra.value.outcomes.values()]
        return Status.OK


def test_why_an_input_was_absent_is_in_the_log(write, tmp_path, monkeypatch):
    """A version each that was found, had left the window, was settled, and did not come in time."""

    def run(mesh):
        feed(mesh, "sensor/map", range(100, 140))  # the window keeps the last 32 of them
        mesh.window("sensor/map").settle(150)
        for version in (101, 120, 150, 160):
            feed(mesh, "sensor/value", [version])
            wait_for_sum(mesh, version)

    text = module(ALIGN.replace("SlowSum", "Reasons"), inputs=BOTH)
    recording, losses = check(write, tmp_path, text, run, monkeypatch, commits=4)
    reasons = [event.value[0] for event in recording if event.topic == "made/total"]
    assert reasons == ["evicted", "found", "settled empty", "timeout"]
    assert losses["sums.align"] == {"map evicted": 1, "map settled empty": 1, "map timeout": 1}


def test_ticks_of_time_come_from_the_log(write, tmp_path, monkeypatch):
    vertices = (
        "      recent: {processor: warploom.dag.GetRecentDagProcessor, out: {value: newest}, config: {input: value}}\n"
        f"      sum: {{processor: {__name__}.SlowSum, in: {{value: newest}}}}\n"
    )
    text = module(vertices, trigger="{period_ms: 3}")

    def run(mesh):
        start = time.time_ns()
        feed(mesh, "sensor/value", [start + i * 1000 for i in range(100)], 0.002)

    recording, _ = check(write, tmp_path, text, run, monkeypatch, commits=5)
    assert all(event.value[1] == {} for event in recording if event.topic == RUNS)


def test_what_a_deadline_left_out_is_left_out_again(write, tmp_path, monkeypatch):
    vertices = (
        f"      wait: {{processor: {__name__}.SlowSum, in: {{extra: nothing}}, out: {{total: slow}}}}\n"
        f"      extra: {{processor: {__name__}.Extra, in: {{value: slow}}, expendable: true}}\n"
        f"      sum: {{processor: {__name__}.SlowSum}}\n"
    )
    text = module(vertices, more="    deadline: {ms: 4, on_miss: degrade}\n")
    recording, _ = check(write, tmp_path, text, lambda mesh: feed(mesh, "sensor/value", range(200), 0.003), monkeypatch)
    left_out = [event.version for event in recording if event.topic == READS and event.value[1] is None]
    assert 3 < len(left_out) < 190


class Extra(Processor):
    value: In[object]
    extra: Out[object]

    def process(self, trigger):
        self.extra.value = trigger.version % 5
        return Status.OK


def test_a_component_that_gives_nothing_in_the_replay_holds_up_nobody(write, tmp_path, monkeypatch, caplog):
    """The second waits for what the first committed in the recorded run, and does not now."""
    text = (
        module(SUM)
        + f"""\
  - name: second
    kind: monotonic_dag
    trigger: value
    inputs: {{value: made/total}}
    outputs: {{spread: made/second}}
    graph:
      spread: {{processor: {__name__}.Last}}
      commit: {COMMIT.format("spread")}
"""
    )
    recording, _ = record(write, tmp_path, text, lambda mesh: feed(mesh, "sensor/value", range(30), 0.004))
    process_of_first = SlowSum.process

    def fails(self, trigger):
        if trigger.version == 20:
            raise RuntimeError("only now")
        return process_of_first(self, trigger)

    monkeypatch.setattr(SlowSum, "process", fails)
    result = replay(write, text, recording, 2, monkeypatch)
    taken = {event.version for event in recording if event.topic == RUNS}
    if 20 in taken:
        assert not result.good
        assert {(d.topic, d.version) for d in result.differences if d.what == "missing"} == {
            ("made/total", 20), ("made/second", 20)
        }  # fmt: skip
    assert result.hung is None


class Last(Processor):
    value: In[object]
    spread: Out[object]

    def process(self, trigger):
        self.spread.value = np.float32(self.value.value[1])
        return Status.OK
