"""The collector: what is there at the start is not looked at until the stop, and then it is; pauses are told of."""

import gc
import json
import threading
import weakref

import pytest

from warploom.dag import Process, frozen_heap, load_module
from warploom.dag.garbage import FrozenHeap, on_pause
from warploom.dag.metrics import Metrics
from warploom.dag.trace import Trace
from warploom.datamesh import DataMesh

MODULE = """\
module: doubler
components:
  - name: doubler
    class: component_parts.Doubler
    kind: data
    trigger: number
    inputs: {number: sensor/number}
    outputs: {double: sensor/doubled}
"""


class Node:
    """Refers to itself once `tie` is called, so that the collector alone frees it."""

    def tie(self):
        self.itself = self
        return weakref.ref(self)


def looked_at():
    """How many objects a full pass looks at."""
    return len(gc.get_objects())


@pytest.fixture(autouse=True)
def nothing_is_held():
    assert FrozenHeap._holders == 0
    yield
    assert FrozenHeap._holders == 0
    gc.unfreeze()


def test_what_was_there_is_left_out_and_what_comes_is_not():
    before = Node().tie()
    everything = looked_at()
    with frozen_heap():
        within = Node().tie()
        gc.collect()
        assert (before() is None, within() is None) == (False, True)
        assert looked_at() < everything / 10
    gc.collect()
    assert before() is None
    assert looked_at() > everything / 2


def test_an_exception_gives_the_heap_back():
    with pytest.raises(KeyError), frozen_heap():
        raise KeyError
    assert gc.get_freeze_count() == 0


def test_the_last_of_several_gives_it_back_and_each_takes_what_came_since():
    first, second = FrozenHeap(), FrozenHeap()
    first.hold()
    first.hold()
    later = Node().tie()
    second.hold()
    gc.collect()
    assert later() is not None, "it was there when the second one began"
    first.release()
    first.release()
    gc.collect()
    assert later() is not None, "the second one still holds it"
    second.release()
    gc.collect()
    assert later() is None


def processes(write, count, **options):
    module = load_module(write(MODULE))
    return [Process([module], external={"sensor/number": int}, **options) for _ in range(count)]


def test_a_process_keeps_what_it_was_built_of_from_the_collector_while_it_runs(write):
    first, second = processes(write, 2)
    everything = looked_at()
    for _ in range(3):
        first.start()
        second.start()
        assert looked_at() < everything / 10
        first.stop()
        assert looked_at() < everything / 10
        second.stop()
        assert looked_at() > everything / 2


def test_a_process_that_cannot_start_gives_it_back(write):
    (process,) = processes(write, 1)
    component = process.components["doubler"]
    start, component.start = component.start, lambda: 1 / 0
    with pytest.raises(ZeroDivisionError):
        process.start()
    assert gc.get_freeze_count() == 0
    component.start = start
    process.start()
    assert gc.get_freeze_count() > 0
    process.stop()


def test_a_process_that_is_told_not_to_leaves_the_collector_alone(write):
    (process,) = processes(write, 1, freeze=False)
    process.start()
    assert gc.get_freeze_count() == 0
    process.stop()


def test_a_full_pass_while_a_process_runs_is_told_by_metrics_and_trace(write, tmp_path, topic):
    metrics = Metrics()
    with Trace(tmp_path / "trace.json") as trace:
        (process,) = processes(write, 1, on_timing=metrics.on_timing)
        metrics.watch(process.mesh, ["sensor/doubled"])
        metrics.watch(process.mesh, [])  # twice, as what reports new topics does
        process.start()
        number, doubled = topic(process.mesh.window("sensor/number")), topic(process.mesh.window("sensor/doubled"))
        before = metrics.as_dict()["gc_pause_ms"]["generation 2"]["count"]
        garbage = Node().tie()
        gc.collect()
        number.commit(1, 1)
        doubled.wait_for(1)
        process.stop()
    assert garbage() is None
    told = metrics.as_dict()["gc_pause_ms"]["generation 2"]
    assert told["count"] - before == 1
    assert told["max"] > 0.0
    lines = metrics.prometheus().splitlines()
    assert f'warploom_gc_pause_milliseconds_count{{generation="2"}} {told["count"]}' in lines
    events = json.loads(trace.path.read_text())
    slices = [event for event in events if event.get("cat") == "gc"]
    full = [one for one in slices if one["name"] == "garbage collection, generation 2" and one["args"]["freed"] >= 1]
    assert full, "the pass that freed the garbage"
    assert all(one["ph"] == "X" and one["dur"] > 0.0 for one in slices)
    assert {one["tid"] for one in full} == {threading.get_ident()}


def test_metrics_that_are_gone_and_a_trace_that_is_closed_watch_no_more(tmp_path):
    gc.collect()  # what others left behind
    before = list(gc.callbacks)
    metrics = Metrics()
    metrics.watch(DataMesh(), [])
    trace = Trace(tmp_path / "trace.json")
    assert len(gc.callbacks) == len(before) + 2
    trace.close()
    gone = weakref.ref(metrics)
    del metrics
    gc.collect()
    assert gone() is None
    assert gc.callbacks == before


def test_a_pause_comes_while_its_thread_holds_any_lock_of_the_metrics():
    metrics = Metrics()
    metrics.watch(DataMesh(), [])
    locks = [metrics._lock, *(histogram._lock for histogram in metrics.pauses.values())]
    for lock in locks:
        lock.acquire()
    gc.collect()
    for lock in locks:
        lock.release()
    assert metrics.as_dict()["gc_pause_ms"]["generation 2"]["count"] >= 1


def test_who_watches_is_told_the_generation_and_the_time_and_can_end_it():
    told = []
    end = on_pause(told.append)
    gc.collect(1)
    end()
    end()
    gc.collect(1)
    assert [pause.generation for pause in told].count(1) >= 1
    assert all(pause.start_ns < pause.end_ns for pause in told)
    assert len([pause for pause in told if pause.generation == 1]) <= 2
