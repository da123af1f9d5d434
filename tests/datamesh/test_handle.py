"""Handles: how a component declares, reads and writes."""

import gc
import logging
import pathlib
import time

import numpy as np
import pytest

from warploom.dag import BacklogConfig, DataProcessComponent, Trigger
from warploom.datamesh import (
    CommitPolicy,
    DataMesh,
    Input,
    LossCounters,
    Miss,
    Output,
    Status,
    Window,
    declared_handles,
)

DISCARD = CommitPolicy.DISCARD_OUT_OF_ORDER
log = logging.getLogger(__name__)


class Cloud:
    def __init__(self, number):
        self.number = number


class HdmapStruct:
    def __init__(self, number):
        self.number = number


def example(document):
    """The first Python of a document, as it stands there, with the one method that it leaves out."""
    code = document.read_text(encoding="utf-8").partition("```python\n")[2].partition("```")[0]
    kinds = (DataProcessComponent, Input, Output, Cloud, HdmapStruct, CommitPolicy, Status)
    names = {"__name__": __name__, "log": log, **{kind.__name__: kind for kind in kinds}}
    exec(compile(code, str(document), "exec"), names)

    class HdmapManager(names["HdmapManager"]):
        def query(self, cloud):
            return HdmapStruct(cloud.number * 10)

    return HdmapManager


ROOT = pathlib.Path(__file__).parents[2]
SPECIFICATION = ROOT.parent / "shared" / "spec" / "datamesh.md"
HdmapManager = example(ROOT / "docs" / "datamesh.md")


def bound(kind, window=None):
    handle = kind()
    handle.bind("handle", window if window is not None else Window("topic"))
    return handle


def publish(output, version, value, received_ns=None):
    with output.allocate_change() as change:
        change.set_version(version, received_ns)
        change.value = value
        return output.commit(DISCARD, change)


@pytest.fixture(params=["documentation", "specification"])
def manager(request):
    if request.param == "specification" and not SPECIFICATION.is_file():
        pytest.skip("the specification (../shared/spec) is not here")
    mesh = DataMesh(window_capacity=2)
    component = (HdmapManager if request.param == "documentation" else example(SPECIFICATION))("hdmap_manager")
    component.bind(mesh, {"lidar": "lidar/points", "hdmap": "map/local"})
    lidar = bound(Output, mesh.window("lidar/points"))
    return mesh, component, lidar


def test_a_component_reads_at_the_trigger_version_and_writes_at_it(manager):
    """The frame that triggered is read, although a newer one is there."""
    mesh, component, lidar = manager
    publish(lidar, 100, Cloud(1))
    publish(lidar, 200, Cloud(2))
    assert component.process(Trigger(100)) is Status.OK
    written = mesh.window("map/local").snapshot()
    assert written.versions == (100,)
    assert written.last().number == 10


def test_the_example_runs_in_the_runtime(manager):
    """As above, with its trigger and its thread: each LiDAR frame gives a map at its version."""
    mesh, component, lidar = manager
    component.set_trigger("lidar", BacklogConfig(policy="block"))
    component.start()
    for version in (100, 200, 300):
        publish(lidar, version, Cloud(version))
    component.stop()
    written = mesh.window("map/local").snapshot()
    assert written.versions == (200, 300)
    assert [one.number for one in written] == [2000, 3000]
    assert mesh.losses.as_dict() == {}


def test_a_component_that_comes_late_sees_why(manager, caplog):
    mesh, component, lidar = manager
    for version in (100, 200, 300):
        publish(lidar, version, Cloud(0))
    with caplog.at_level(logging.INFO):
        assert component.process(Trigger(100)) is Status.MISS
        assert component.process(Trigger(400)) is Status.MISS
    assert "EVICTED" in caplog.text
    assert "FUTURE" in caplog.text
    assert len(mesh.window("map/local").snapshot()) == 0


def test_a_component_that_runs_out_of_order_is_told_by_the_commit(manager):
    mesh, component, lidar = manager
    publish(lidar, 100, Cloud(1))
    publish(lidar, 200, Cloud(2))
    assert component.process(Trigger(200)) is Status.OK
    assert component.process(Trigger(100)) is Status.OUT_OF_ORDER
    assert component.process(Trigger(200)) is Status.DUPLICATE
    assert mesh.losses.as_dict() == {"map/local": {"duplicate": 1, "out_of_order": 1}}


def test_reads_repeat_within_one_access():
    window = Window("topic", 2)
    reader, writer = bound(Input, window), bound(Output, window)
    publish(writer, 1, "a")
    with reader.access() as snapshot:
        for version in (2, 3, 4):
            publish(writer, version, "b")
        assert snapshot.last() == "a"
        assert snapshot.versions == (1,)
    with reader.access() as snapshot:
        assert snapshot.versions == (3, 4)


def test_a_change_is_committed_once():
    output = bound(Output)
    change = output.allocate_change()
    change.set_version(1)
    change.value = "first"
    assert change.value == "first"
    assert output.commit(DISCARD, change) is Status.OK
    with pytest.raises(RuntimeError, match="'topic' was committed or abandoned already"):
        output.commit(DISCARD, change)
    with pytest.raises(RuntimeError, match="allocate another"):
        change.value = "second"
    assert list(output.window.snapshot()) == ["first"]


def test_a_change_without_version_or_value_is_refused_and_publishes_nothing():
    losses = LossCounters()
    output = bound(Output, Window("topic", 8, losses))

    def commit_without(part):
        with output.allocate_change() as change:
            if part == "version":
                change.value = 1
            else:
                change.set_version(1)
            output.commit(DISCARD, change)

    with pytest.raises(ValueError, match="has no version: call set_version"):
        commit_without("version")
    with pytest.raises(ValueError, match="has no value"):
        commit_without("value")
    with pytest.raises(LookupError, match="no value yet"):
        _ = output.allocate_change().value
    assert len(output.window.snapshot()) == 0
    assert losses.as_dict() == {"topic": {"abandoned": 3}}


def test_none_is_a_value():
    output = bound(Output)
    assert publish(output, 1, None) is Status.OK
    assert output.window.snapshot().last() is None


@pytest.mark.parametrize("version", [-1, 1 << 64])
def test_a_version_that_is_no_uint64_is_refused(version):
    with pytest.raises(ValueError, match="unsigned 64-bit"):
        bound(Output).allocate_change().set_version(version)


@pytest.mark.parametrize("version", [1.5, "1", None])
def test_a_version_that_is_no_whole_number_is_refused(version):
    with pytest.raises(TypeError):
        bound(Output).allocate_change().set_version(version)


def test_the_whole_range_of_versions_is_taken_also_from_numpy():
    output = bound(Output)
    assert publish(output, np.uint64(0), "first") is Status.OK
    assert publish(output, np.uint64((1 << 64) - 1), "last") is Status.OK
    assert output.window.snapshot().versions == (0, (1 << 64) - 1)


def test_an_exception_in_mid_write_abandons_the_change():
    losses = LossCounters()
    output = bound(Output, Window("topic", 8, losses))

    def write():
        with output.allocate_change() as change:
            change.set_version(7)
            change.value = np.zeros(3)
            raise KeyError("sensor")

    with pytest.raises(KeyError, match="sensor"):
        write()
    assert len(output.window.snapshot()) == 0
    assert output.window.snapshot().miss(7) is Miss.FUTURE
    assert losses.as_dict() == {"topic": {"abandoned": 1}}


def test_a_change_left_without_a_commit_is_counted_and_cannot_come_back():
    losses = LossCounters()
    output = bound(Output, Window("topic", 8, losses))
    with output.allocate_change() as change:
        change.set_version(7)
        change.value = 1
    with pytest.raises(RuntimeError, match="committed or abandoned"):
        output.commit(DISCARD, change)
    assert losses["topic", "abandoned"] == 1


def test_a_change_that_is_dropped_is_counted():
    losses = LossCounters()
    output = bound(Output, Window("topic", 8, losses))
    change = output.allocate_change()
    change.set_version(7)
    change.value = 1
    del change
    gc.collect()
    assert losses["topic", "abandoned"] == 1
    assert len(output.window.snapshot()) == 0


def test_a_change_is_made_in_the_epoch_of_its_handle_or_the_one_it_names():
    output = bound(Output)
    publish(output, 5, "a")
    output.epoch = 2
    publish(output, 3, "b")
    with output.allocate_change() as change:
        change.set_version(1, epoch=4)
        change.value = "c"
        assert output.commit(DISCARD, change) is Status.OK
    assert (output.window.epoch, output.window.snapshot().versions) == (4, (1,))
    assert output.window.snapshot().entry(0).epoch == 4
    assert publish(output, 9, "d") is Status.OUT_OF_ORDER


def test_a_payload_on_a_device_carries_its_event_to_the_readers():
    class Event:
        stream = "own"
        waited = 0

        def synchronize(self):
            self.waited += 1

    event, output = Event(), bound(Output)
    with output.allocate_change() as change:
        change.set_version(1)
        change.value = "on the device"
        change.completes_with(event)
        output.commit(DISCARD, change)
    reader = bound(Input, output.window)
    with reader.access(stream="own") as snapshot:
        assert snapshot.last() == "on the device"
    assert event.waited == 0
    with reader.access() as snapshot:
        assert snapshot.last() == "on the device"
    assert event.waited == 1


def test_a_commit_carries_when_the_sensor_data_was_received():
    output = bound(Output)
    before = time.perf_counter_ns()
    publish(output, 1, "a", received_ns=before - 1000)
    publish(output, 2, "b")
    first, second = (output.window.snapshot().entry(i) for i in (0, 1))
    assert first.received_ns == before - 1000
    assert first.committed_ns >= before
    assert second.received_ns == second.committed_ns


def test_a_committed_frame_cannot_be_written_by_producer_or_consumer():
    window = Window("topic")
    frame = {"points": np.zeros((4, 3), np.float32)}
    publish(bound(Output, window), 1, frame)
    with bound(Input, window).access() as snapshot:
        for array in (frame["points"], snapshot.last()["points"]):
            with pytest.raises(ValueError, match="read-only"):
                array[0, 0] = 1.0


def test_settle_says_that_nothing_will_come():
    output = bound(Output)
    output.settle(5)
    assert output.window.snapshot().miss(5) is Miss.SETTLED_EMPTY


def test_an_unbound_handle_says_so():
    handle = declared_handles(HdmapManager)["lidar"]
    with pytest.raises(RuntimeError, match="Input 'lidar' is not bound"):
        handle.access()


def test_a_bound_handle_knows_its_topic():
    assert bound(Input).topic == "topic"


class Declaring:
    camera: Input[np.ndarray] = Input(optional=True)
    anything: Input
    numbers: Output[list[int]]
    not_a_handle: int = 3


class Inheriting(Declaring):
    more: Output["Cloud"]


def test_annotations_declare_handles_with_types_and_options():
    handles = declared_handles(Inheriting)
    assert set(handles) == {"camera", "anything", "numbers", "more"}
    assert {name: type(handle) for name, handle in handles.items() if isinstance(handle, Input)} == {
        "camera": Input,
        "anything": Input,
    }
    assert [handles[n].payload for n in ("camera", "anything", "numbers", "more")] == [
        np.ndarray,
        object,
        list[int],
        Cloud,
    ]
    assert [handles[n].optional for n in ("camera", "anything", "numbers", "more")] == [True, False, False, False]


def test_two_components_of_a_class_do_not_share_handles():
    a, b = HdmapManager("a"), HdmapManager("b")
    assert a.lidar is not b.lidar
    assert a.inputs == {"lidar": a.lidar}
    assert a.outputs == {"hdmap": a.hdmap}


def test_a_change_goes_to_its_own_output_alone():
    mesh = DataMesh()
    one, other = Output(), Output()
    one.bind("one", mesh.window("left"))
    other.bind("other", mesh.window("right"))
    change = other.allocate_change()
    change.set_version(1)
    change.value = 1
    with pytest.raises(ValueError, match="the change is of 'right': it cannot be committed to 'left'"):
        one.commit(DISCARD, change)
    assert other.commit(DISCARD, change) is Status.OK
    with pytest.raises(TypeError, match="commit takes a policy and a change"):
        one.commit(one.allocate_change(), DISCARD)  # the wrong way round


@pytest.mark.parametrize(
    ("policy", "options", "said"),
    [
        ("discard", {}, "policy must be a CommitPolicy or a Reorder, not 'discard'"),
        (None, {}, "policy must be"),
        (DISCARD, {"equal": "replace"}, "equal must be an EqualVersion, not 'replace'"),
    ],
)
def test_a_policy_that_is_none_is_refused_and_publishes_nothing(policy, options, said):
    output = bound(Output)
    publish(output, 5, "first")
    change = output.allocate_change()
    change.set_version(5)
    change.value = "second"
    with pytest.raises(TypeError, match=said):
        output.commit(policy, change, **options)
    assert output.window.snapshot().last() == "first"
