"""Processors that connect a graph to the mesh, each alone: weak sync, strong sync, commit."""

import pytest
from pydantic import ValidationError
from sync_parts import Mesh

from warploom.dag import (
    AlignDagProcessor,
    CommitDagProcessor,
    GetRecentDagProcessor,
    ProcessorHarness,
    Trigger,
)
from warploom.dag.recorded_reads import RecordedReads
from warploom.datamesh import Outcome, Status

MS = 1_000_000
pytestmark = pytest.mark.usefixtures("no_thread_left")


@pytest.fixture
def committing():
    """A processor that commits to a window, and the mesh."""

    def make(**config):
        mesh = Mesh("topic")
        harness = ProcessorHarness(
            CommitDagProcessor, {"output": "result", **config}, outputs={"result": mesh.outputs["topic"]}
        )
        return harness.feed(value="datum"), mesh.mesh

    return make


def statuses(harness, *versions):
    return [harness.run(Trigger(version)) or harness.status for version in versions]


def test_commits_at_the_version_of_the_trigger_with_its_time_of_reception_and_epoch(committing):
    harness, mesh = committing()
    harness.run(Trigger(5, received_ns=123, epoch=2))
    assert harness.status is Status.OK
    entry = mesh.window("topic").snapshot().entry(0)
    assert (entry.version, entry.value, entry.received_ns, entry.epoch) == (5, "datum", 123, 2)


class Done:
    """A completion that notes who waits for it."""

    def __init__(self, stream):
        self.stream, self.waited = stream, []

    def synchronize(self):
        self.waited.append("host")

    def wait_on(self, stream):
        self.waited.append(stream)


class OnDevice:
    """As an array of Warp or torch looks."""

    def numpy(self):
        raise AssertionError("nobody asked for it on the host")


class Device:
    """An execution context whose processors launch on a stream."""

    stream = "own"

    def __init__(self):
        self.events = []

    def completion(self):
        self.events.append(Done(self.stream))
        return self.events[-1]


@pytest.mark.parametrize(
    ("value", "carries"), [(OnDevice(), True), ({"boxes": [OnDevice()]}, True), ([1.0, "a"], False)]
)
def test_what_a_device_still_writes_is_committed_with_its_event(value, carries, committing):
    harness, mesh = committing()
    harness.processor.context = context = Device()
    harness.feed(value=value).run(5)
    assert harness.status is Status.OK
    assert len(context.events) == carries
    window = mesh.window("topic")
    for stream in ("own", "other", None):
        assert window.snapshot(stream=stream).last() is value
    assert [event.waited for event in context.events] == [["other", "host"]] * carries


def test_without_a_stream_nothing_is_waited_for(committing):
    harness, mesh = committing()
    harness.feed(value=OnDevice()).run(5)
    assert mesh.window("topic").snapshot().entry(0).completion is None


def test_an_older_version_is_discarded_and_counted(committing):
    harness, mesh = committing()
    assert statuses(harness, 5, 4, 5, 6) == [Status.OK, Status.OUT_OF_ORDER, Status.DUPLICATE, Status.OK]
    assert mesh.losses.as_dict() == {"topic": {"duplicate": 1, "out_of_order": 1}}


@pytest.mark.parametrize(
    ("config", "versions", "losses"),
    [
        ({"policy": "insert_sorted"}, (4, 5), {}),
        ({"policy": "reject"}, (5,), {"rejected": 1, "abandoned": 1}),
        ({"policy": "overwrite"}, (4,), {"overwritten": 1}),
        ({"policy": "force_new_epoch"}, (4,), {}),
        ({"policy": "reorder", "delay_ms": 5, "depth": 1}, (4,), {}),
        ({"policy": "reorder", "depth": 0}, (5,), {"out_of_order": 1}),
    ],
)
def test_every_policy_can_be_configured(config, versions, losses, committing):
    harness, mesh = committing(**config)
    statuses(harness, 5, 4)
    assert mesh.window("topic").snapshot().versions == versions
    assert mesh.losses.as_dict() == ({"topic": losses} if losses else {})


def test_a_topic_with_epochs_of_its_own_goes_on_after_it_began_one(committing):
    harness, mesh = committing(policy="force_new_epoch")
    for version in (5, 4, 6):
        harness.run(Trigger(version, epoch=0))
        assert harness.status is Status.OK
    assert (mesh.window("topic").epoch, mesh.window("topic").snapshot().versions) == (1, (4, 6))


def test_equal_versions_and_triggering_can_be_configured(committing):
    harness, mesh = committing(policy="insert_sorted", equal="replace", triggers=True)
    told = []
    mesh.window("topic").subscribe(lambda e: told.append((e.version, e.triggers)), lambda version, epoch: None)
    statuses(harness, 5, 4, 4)
    assert told == [(5, True), (4, True), (4, False)]
    harness, _ = committing(equal="error")
    statuses(harness, 5)
    with pytest.raises(ValueError, match="equal versions are errors"):
        harness.run(Trigger(5))


def test_without_a_value_nothing_is_published():
    mesh = Mesh("topic")
    harness = ProcessorHarness(CommitDagProcessor, {"output": "result"}, outputs={"result": mesh.outputs["topic"]})
    with pytest.raises(LookupError, match="'value' has no value"):
        harness.run(1)
    assert len(mesh.mesh.window("topic").snapshot()) == 0
    assert mesh.mesh.losses.as_dict() == {"topic": {"abandoned": 1}}


@pytest.mark.parametrize(
    ("processor", "config", "said"),
    [
        (
            CommitDagProcessor,
            {"output": "rseult"},
            "the component has no output 'rseult'; did you mean 'result'. known: result",
        ),
        (
            GetRecentDagProcessor,
            {"input": "camra"},
            "the component has no input 'camra'; did you mean 'camera'. known: camera",
        ),
        (
            AlignDagProcessor,
            {"inputs": ["camera", "x"], "timeout_ms": 1},
            "the component has no input 'x'; known: camera",
        ),
    ],
)
def test_a_handle_that_is_not_there_is_refused(processor, config, said):
    mesh = Mesh("camera", "result")
    with pytest.raises(ValueError, match=said):
        ProcessorHarness(
            processor, config, inputs={"camera": mesh.inputs["camera"]}, outputs={"result": mesh.outputs["result"]}
        )


@pytest.mark.parametrize(
    "config", [{"inputs": [], "timeout_ms": 1}, {"inputs": ["a"], "timeout_ms": -1}, {"inputs": ["a"]}]
)
def test_an_alignment_that_makes_no_sense_is_refused(config):
    with pytest.raises(ValidationError):
        AlignDagProcessor.Config(**config)


def recent(mesh, **config):
    return ProcessorHarness(GetRecentDagProcessor, {"input": "map", **config}, inputs=mesh.inputs)


@pytest.mark.parametrize(
    ("version", "max_age_ms", "got"),
    [(9, None, None), (10, None, 10), (19, None, 10), (20, None, 20), (10**15, None, 30), (35, 5e-6, 30),
     (36, 5e-6, None), (30, 0, 30), (31, 0, None)],
)  # fmt: skip
def test_weak_sync_gives_the_newest_that_is_not_newer_than_the_trigger(version, max_age_ms, got):
    mesh = Mesh("map")
    mesh.commit("map", 10, 20, 30)
    harness = recent(mesh, max_age_ms=max_age_ms)
    outputs = harness.run(version)
    assert outputs == ({} if got is None else {"value": f"map {got}", "version": got})
    assert harness.status is (Status.MISS if got is None else Status.OK)


def test_weak_sync_returns_at_once_when_there_is_nothing():
    harness = recent(Mesh("map"))
    assert harness.run(10) == {}
    assert harness.status is Status.MISS


def test_weak_sync_is_causal_across_epochs():
    """A map of the epoch before is older than any trigger of this one; one of the next epoch is not."""
    mesh = Mesh("map")
    mesh.commit("map", 10, 20)
    harness = recent(mesh)
    assert harness.run(Trigger(5, epoch=1)) == {"value": "map 20", "version": 20}
    assert recent(mesh, max_age_ms=1000).run(Trigger(5, epoch=1)) == {}, "there is no age across epochs"
    mesh.commit("map", 7, epoch=1)
    assert harness.run(Trigger(5, epoch=1)) == {}
    assert harness.run(Trigger(8, epoch=1)) == {"value": "map 7", "version": 7}
    assert harness.run(Trigger(15, epoch=0)) == {"value": "map 10", "version": 10}


class Waiting:
    """An alignment of some inputs with one trigger, in steps."""

    def __init__(self, mesh, **config):
        config = {"inputs": list(mesh.inputs), "timeout_ms": 100e-6, **config}
        self.harness = ProcessorHarness(AlignDagProcessor, config, inputs=mesh.inputs)
        self.processor, self.resumed = self.harness.processor, 0

    def begin(self, trigger):
        self.trigger = trigger
        return self.processor.begin(trigger, self.resume)

    def resume(self):
        self.resumed += 1

    def end(self):
        status = self.processor.process(self.trigger)
        port = self.processor.aligned
        return status, port.value if port.present else None


def test_strong_sync_goes_on_at_once_when_all_is_there():
    mesh = Mesh("camera", "radar")
    for topic in ("camera", "radar"):
        mesh.commit(topic, 10)
    waiting = Waiting(mesh)
    assert not waiting.begin(Trigger(10))
    status, aligned = waiting.end()
    assert status is Status.OK
    assert aligned.values == {"camera": "camera 10", "radar": "radar 10"}
    assert aligned.versions == {"camera": 10, "radar": 10}
    assert aligned.absent == ()
    assert waiting.resumed == 0


def test_strong_sync_waits_for_the_last_of_its_inputs():
    mesh = Mesh("camera", "radar")
    waiting = Waiting(mesh)
    assert waiting.begin(Trigger(10))
    mesh.commit("radar", 10)
    assert waiting.resumed == 0
    mesh.commit("camera", 10)
    assert waiting.resumed == 1
    assert waiting.end()[0] is Status.OK


def test_a_partial_set_names_the_absent_with_the_reason_of_each():
    mesh = Mesh("camera", "radar", "hdmap", capacity=1)
    waiting = Waiting(mesh)
    mesh.commit("camera", 10)
    assert waiting.begin(Trigger(10))
    mesh.outputs["radar"].settle(10)
    mesh.clock.advance(99)
    assert waiting.resumed == 0
    mesh.clock.advance(1)
    assert waiting.resumed == 1
    status, aligned = waiting.end()
    assert status is Status.TIMEOUT
    assert aligned.values == {"camera": "camera 10"}
    assert aligned.absent == ("radar", "hdmap")
    assert aligned.outcomes == {
        "camera": Outcome.FOUND,
        "radar": Outcome.SETTLED_EMPTY,
        "hdmap": Outcome.TIMEOUT,
    }
    assert waiting.processor.losses.as_dict() == {"AlignDagProcessor": {"hdmap timeout": 1, "radar settled empty": 1}}


@pytest.mark.parametrize(("partial", "given"), [(True, True), (False, False)])
def test_without_partial_sets_nothing_is_given_when_something_is_absent(partial, given):
    mesh = Mesh("camera", "radar", capacity=1)
    mesh.commit("camera", 10)
    mesh.commit("radar", 10, 20)
    waiting = Waiting(mesh, partial=partial)
    assert not waiting.begin(Trigger(10))
    status, aligned = waiting.end()
    assert status is Status.MISS
    assert (aligned is not None) is given
    if given:
        assert aligned.outcomes == {"camera": Outcome.FOUND, "radar": Outcome.EVICTED}


def test_the_deadline_counts_from_the_trigger_and_is_never_restarted():
    mesh = Mesh("camera")
    waiting = Waiting(mesh)
    mesh.clock.advance(1000)
    assert waiting.begin(Trigger(10, at_ns=950))
    mesh.clock.advance(49)
    mesh.commit("camera", 5)
    assert waiting.resumed == 0
    mesh.clock.advance(1)
    assert waiting.resumed == 1
    assert waiting.end()[0] is Status.TIMEOUT
    assert not waiting.begin(Trigger(11, at_ns=800)), "its time was over before it began"
    assert waiting.end()[0] is Status.TIMEOUT


def test_a_timeout_of_zero_only_looks():
    mesh = Mesh("camera")
    mesh.commit("camera", 10)
    waiting = Waiting(mesh, timeout_ms=0)
    for version, expected in ((10, Status.OK), (11, Status.TIMEOUT)):
        assert not waiting.begin(Trigger(version))
        assert waiting.end()[0] is expected


def test_a_tolerance_takes_the_nearest_that_is_there():
    mesh = Mesh("camera")
    mesh.commit("camera", 6, 13)
    waiting = Waiting(mesh, tolerance_ms=5e-6)
    assert not waiting.begin(Trigger(10))
    assert waiting.end()[1].versions == {"camera": 13}


def test_eviction_and_shutdown_end_the_wait():
    mesh = Mesh("camera", capacity=1)
    waiting = Waiting(mesh)
    assert waiting.begin(Trigger(10))
    mesh.commit("camera", 8, 20, 30)
    assert waiting.resumed == 1
    assert waiting.end()[0] is Status.MISS
    assert waiting.begin(Trigger(40))
    mesh.inputs["camera"].end_waits()
    assert waiting.end()[0] is Status.SHUTDOWN


def test_what_a_device_still_writes_is_waited_for_when_it_is_given_on():
    class Event:
        stream, waited = "own", 0

        def synchronize(self):
            self.waited += 1

    mesh, event = Mesh("camera"), Event()
    mesh.commit("camera", 10, completion=event)
    waiting = Waiting(mesh)
    waiting.begin(Trigger(10))
    assert event.waited == 0
    waiting.end()
    assert event.waited == 1


def test_in_a_replay_weak_sync_takes_what_the_recorded_run_read():
    """Not what is there now: it waits for that, however long, also for nothing."""
    mesh, resumed = Mesh("map"), []
    harness = recent(mesh, max_age_ms=0)
    harness.processor.recorded = RecordedReads({(0, 30): {"map": (0, 20)}}, mesh.inputs)
    mesh.commit("map", 10)
    assert harness.processor.begin(Trigger(30, epoch=0), lambda: resumed.append(1))
    mesh.clock.advance(3600 * 1000 * MS)
    assert resumed == []
    mesh.commit("map", 20, 25)
    assert resumed == [1]
    assert harness.processor.process(Trigger(30, epoch=0)) is Status.OK
    assert (harness.processor.value.value, harness.processor.version.value) == ("map 20", 20)
    assert harness.run(Trigger(40, epoch=0)) == {}
    assert harness.status is Status.MISS


def test_in_a_replay_strong_sync_takes_what_the_recorded_run_found():
    mesh = Mesh("camera", "radar")
    waiting = Waiting(mesh, tolerance_ms=5e-6)
    waiting.processor.recorded = RecordedReads({(0, 10): {"camera": (0, 9)}}, mesh.inputs)
    mesh.commit("camera", 9, 10)
    mesh.commit("radar", 10)
    assert not waiting.begin(Trigger(10, epoch=0))
    status, aligned = waiting.end()
    assert status is Status.TIMEOUT
    assert aligned.versions == {"camera": 9}
    assert aligned.absent == ("radar",)


@pytest.mark.parametrize("outcome", [Outcome.EVICTED, Outcome.SETTLED_EMPTY, Outcome.SHUTDOWN, Outcome.TIMEOUT])
def test_in_a_replay_what_was_absent_is_so_for_the_recorded_reason(outcome):
    mesh = Mesh("camera", "radar")
    waiting = Waiting(mesh)
    waiting.processor.recorded = RecordedReads({(0, 10): {"camera": (0, 10), "radar": outcome}}, mesh.inputs)
    mesh.commit("camera", 10)
    mesh.commit("radar", 10)
    assert not waiting.begin(Trigger(10, epoch=0))
    _, aligned = waiting.end()
    assert aligned.outcomes == {"camera": Outcome.FOUND, "radar": outcome}
    assert waiting.processor.losses.as_dict() == {"AlignDagProcessor": {f"radar {outcome.value}": 1}}


def test_in_a_replay_what_is_still_to_be_read_stays_though_it_has_left_the_window():
    mesh = Mesh("camera", capacity=2)
    weak = ProcessorHarness(GetRecentDagProcessor, {"input": "camera"}, inputs=mesh.inputs)
    strong = Waiting(mesh)
    for processor in (weak.processor, strong.processor):
        processor.recorded = RecordedReads({(0, 10): {"camera": (0, 10)}}, mesh.inputs)
    mesh.commit("camera", 10, 20, 30, 40)
    assert weak.run(Trigger(10, epoch=0)) == {"value": "camera 10", "version": 10}
    assert not strong.begin(Trigger(10, epoch=0))
    status, aligned = strong.end()
    assert status is Status.OK
    assert (aligned.values, aligned.outcomes) == ({"camera": "camera 10"}, {"camera": Outcome.FOUND})
    assert strong.processor.recorded.take(Trigger(10, epoch=0)) == {}, "it is let go of"
