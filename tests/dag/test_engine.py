"""The graph engine: concurrency shown by threads that meet, never by time."""

import gc
import logging
import random
import threading
import time
import weakref
from itertools import pairwise
from typing import Any

import pytest

from warploom.dag import GraphEngine, In, Out, Processor, Trigger, Vertex
from warploom.datamesh import Status

WAIT = 20.0
pytestmark = pytest.mark.usefixtures("no_thread_left")


class Step(Processor):
    """Up to three inputs; its output is `act(trigger, values)`; None there leaves the output absent."""

    a: In[Any]
    b: In[Any] = In(optional=True)
    c: In[Any] = In(optional=True)
    out: Out[Any]

    def __init__(self, act):
        super().__init__()
        self.act = act

    def process(self, trigger):
        result = self.act(trigger, [port.value for port in (self.a, self.b, self.c) if port.present])
        if isinstance(result, tuple):
            return result[0]
        if result is not None:
            self.out.value = result
        return Status.OK


def vertex(name, act, *inputs):
    return Vertex(name, Step(act), dict(zip("abc", inputs, strict=False)), {"out": name})


def ones(trigger, values):
    return 1


class Frames:
    """Runs versions through an engine, and waits for all of them."""

    def __init__(self, vertices, workers=2, on_timing=None):
        self.engine = GraphEngine("graph", vertices, workers, on_timing)
        self.done, self.count = {}, 0
        self.changed = threading.Condition()

    def __enter__(self):
        self.engine.start()
        return self

    def __exit__(self, *_):
        self.engine.stop()

    def submit(self, version, **data):
        self.count += 1
        self.engine.submit(Trigger(version), data, self.on_done)

    def on_done(self, run):
        with self.changed:
            assert run.trigger.version not in self.done, "a frame is done once"
            self.done[run.trigger.version] = run
            self.changed.notify_all()

    def wait(self):
        with self.changed:
            assert self.changed.wait_for(lambda: len(self.done) == self.count, WAIT), (self.count, sorted(self.done))
        return self.done


def test_data_flow_along_the_edges():
    graph = [
        vertex("sum", lambda t, v: v[0] + v[1], "left", "right"),
        vertex("left", lambda t, v: v[0] * 2, "input"),
        vertex("right", lambda t, v: v[0] * 3, "input"),
    ]
    with Frames(graph) as frames:
        frames.submit(1, input=10)
        run = frames.wait()[1]
    assert run.data == {"input": 10, "left": 20, "right": 30, "sum": 50}
    assert run.error is None


def test_independent_branches_run_at_once():
    """Each branch waits for the other: one after the other, neither would end."""
    meeting = threading.Barrier(2)
    branches = [vertex(name, lambda t, v: meeting.wait(WAIT) + 1, "input") for name in ("left", "right")]
    with Frames(branches, workers=2) as frames:
        frames.submit(1, input=0)
        assert frames.wait()[1].error is None


def test_several_frames_are_in_flight():
    """The second vertex holds frame 1 until the first one is at frame 3."""
    third = threading.Event()
    graph = [
        vertex("first", lambda t, v: third.set() or 1 if t.version == 3 else 1, "input"),
        vertex("second", lambda t, v: third.wait(WAIT) and 1, "first"),
    ]
    with Frames(graph, workers=2) as frames:
        for version in (1, 2, 3):
            frames.submit(version, input=0)
        done = frames.wait()
    assert all(run.data["second"] for run in done.values())


def test_a_processor_serves_one_frame_at_a_time():
    inside, most = [], []

    def act(trigger, values):
        inside.append(trigger.version)
        most.append(len(inside))
        time.sleep(0.001)
        inside.remove(trigger.version)
        return 1

    with Frames([vertex("only", act, "input")], workers=8) as frames:
        for version in range(20):
            frames.submit(version, input=0)
        frames.wait()
    assert set(most) == {1}


def run_random_graph(workers, frames_count=40):
    """Vertices that remember: what they give depends on the order in which they saw the frames."""
    shape, jitter = random.Random(5), random.Random(workers)
    starts, outputs = {}, {}

    def act(name):
        state = [0]

        def step(trigger, values):
            starts.setdefault(name, []).append(trigger.version)
            if jitter.random() < 0.3:
                time.sleep(jitter.random() * 5e-4)
            state[0] = (state[0] * 31 + sum(values) + trigger.version) % 1_000_003
            if (state[0] + trigger.version) % 17 == 0:
                raise ValueError("now and then")
            return state[0]

        return step

    names, graph = ["input"], []
    for number in range(12):
        name = f"v{number}"
        graph.append(vertex(name, act(name), *shape.sample(names, min(len(names), shape.randint(1, 3)))))
        names.append(name)
    shape.shuffle(graph)
    with Frames(graph, workers) as frames:
        for version in range(frames_count):
            frames.submit(version, input=version)
        done = frames.wait()
    outputs = {version: run.data for version, run in sorted(done.items())}
    return starts, outputs


def test_starts_are_in_the_order_of_versions_and_outputs_do_not_depend_on_workers(caplog):
    with caplog.at_level(logging.CRITICAL):
        runs = {workers: run_random_graph(workers) for workers in (1, 2, 8)}
    for starts, _ in runs.values():
        for versions in starts.values():
            assert all(a < b for a, b in pairwise(versions))
    assert runs[1][1] == runs[2][1] == runs[8][1]
    assert any(len(data) < 13 for data in runs[1][1].values()), "some frames failed somewhere"


def test_one_exception_costs_one_frame(caplog):
    """The sibling still runs, what needs the failed one is skipped, and the next frame runs whole."""
    timings = []

    def fail(trigger, values):
        if trigger.version == 2:
            raise ValueError("bad frame")
        return 1

    graph = [
        vertex("fails", fail, "input"),
        vertex("sibling", ones, "input"),
        vertex("after", ones, "fails"),
        vertex("last", ones, "after"),
    ]
    with Frames(graph, 2, timings.append) as frames:
        for version in (1, 2, 3):
            frames.submit(version, input=0)
        done = frames.wait()
    assert set(done[1].data) == set(done[3].data) == {"input", "fails", "sibling", "after", "last"}
    assert set(done[2].data) == {"input", "sibling"}
    assert isinstance(done[2].error, ValueError)
    assert done[2].failed_vertex == "fails"
    assert done[1].error is done[3].error is None
    status = {timing.vertex: timing.status for timing in timings if timing.version == 2}
    assert status == {
        "fails": Status.FAILED,
        "sibling": Status.OK,
        "after": Status.SKIPPED,
        "last": Status.SKIPPED,
    }
    assert "graph.fails failed at version 2" in caplog.text
    assert [one.name for one in caplog.records] == ["warploom.component.graph.fails"]


@pytest.mark.parametrize("wrong", [None, True, "ok", 0])
def test_a_processor_that_returns_no_status_fails_its_frame(wrong, caplog):
    graph = [vertex("wrong", lambda t, v: (wrong,) if t.version == 1 else 1, "input")]
    with Frames(graph, workers=1) as frames:
        frames.submit(1, input=0)
        frames.submit(2, input=0)
        done = frames.wait()
    assert isinstance(done[1].error, TypeError)
    assert f"process of Step returned {wrong!r}, not a Status" in caplog.text
    assert done[2].error is None


def test_sys_exit_in_a_processor_does_not_end_a_worker(caplog):
    def leave(trigger, values):
        if trigger.version == 1:
            raise SystemExit(2)
        return 1

    with caplog.at_level(logging.CRITICAL), Frames([vertex("leaves", leave, "input")], workers=1) as frames:
        frames.submit(1, input=0)
        frames.submit(2, input=0)
        done = frames.wait()
    assert isinstance(done[1].error, SystemExit)
    assert done[2].data["leaves"] == 1


def test_callbacks_that_raise_do_not_end_a_worker(caplog):
    def fail(event):
        raise OSError("disk full")

    finished = threading.Semaphore(0)
    engine = GraphEngine("graph", [vertex("only", ones, "input")], 1, fail)
    engine.start()
    for version in (1, 2, 3):
        engine.submit(Trigger(version), {"input": 0}, lambda run: finished.release() or fail(run))
    assert all(finished.acquire(timeout=WAIT) for _ in range(3))
    engine.stop()
    assert caplog.text.count("a callback failed") == 6


def test_optional_inputs_may_be_absent_and_needed_ones_skip():
    graph = [
        vertex("silent", lambda t, v: None, "input"),
        vertex("needs", ones, "silent"),
        vertex("copes", lambda t, v: len(v), "input", "silent", "nowhere"),
    ]
    timings = {}
    with Frames(graph, 2, lambda timing: timings.update({timing.vertex: timing.status})) as frames:
        frames.submit(1, input=0)
        data = frames.wait()[1].data
    assert data == {"input": 0, "copes": 1}
    assert timings == {"silent": Status.OK, "needs": Status.SKIPPED, "copes": Status.OK}


def test_an_input_of_the_component_that_is_missing_skips_what_needs_it():
    with Frames([vertex("only", ones, "input")]) as frames:
        frames.submit(1)
        frames.submit(2, input=0)
        done = frames.wait()
    assert done[1].data == {}
    assert done[2].data == {"input": 0, "only": 1}


def test_values_do_not_stay_in_the_ports_for_the_next_frame():
    seen = []
    graph = [vertex("only", lambda t, v: seen.append(list(v)), "input", "other")]
    with Frames(graph, workers=1) as frames:
        frames.submit(1, input=1, other=2)
        frames.submit(2, input=3)
        frames.wait()
    assert seen == [[1, 2], [3]]
    assert not any(port.present for port in graph[0].processor.ports.values())


def test_a_status_other_than_ok_is_recorded_and_what_was_written_is_given_on():
    graph = [vertex("misses", lambda t, v: (Status.MISS,), "input"), vertex("after", ones, "misses")]
    timings = {}
    with Frames(graph, 1, lambda timing: timings.update({timing.vertex: timing.status})) as frames:
        frames.submit(1, input=0)
        assert frames.wait()[1].error is None
    assert timings == {"misses": Status.MISS, "after": Status.SKIPPED}


def test_timings_tell_of_every_vertex_of_every_frame():
    timings = []
    graph = [vertex("first", ones, "input"), vertex("second", ones, "first")]
    with Frames(graph, 2, timings.append) as frames:
        for version in range(5):
            frames.submit(version, input=0)
        frames.wait()
    assert sorted((t.vertex, t.version) for t in timings) == [(n, v) for n in ("first", "second") for v in range(5)]
    for timing in timings:
        assert timing.component == "graph"
        assert timing.ready_ns <= timing.start_ns <= timing.end_ns
        assert timing.wait_ms >= 0
        assert timing.run_ms >= 0
    ends = {t.version: t.end_ns for t in timings if t.vertex == "first"}
    assert all(t.ready_ns >= ends[t.version] for t in timings if t.vertex == "second")


def test_a_worker_that_waits_keeps_no_frame_alive():
    class Payload:
        pass

    with Frames([vertex("only", ones, "input")], workers=1) as frames:
        payload = Payload()
        gone = weakref.ref(payload)
        frames.submit(1, input=payload)
        frames.wait()[1].data.clear()
        frames.done.clear()
        del payload
        until = time.monotonic() + WAIT
        while gone() is not None and time.monotonic() < until:  # the worker has yet to go to sleep
            time.sleep(0.001)
            gc.collect()
        assert gone() is None


class WaitsFor(Step):
    """Waits until the context lets the frame go on."""

    waits = True

    def __init__(self, act, gates):
        super().__init__(act)
        self.gates, self.begun = gates, []

    def begin(self, trigger, resume):
        self.begun.append(trigger.version)
        if trigger.version not in self.gates:
            return False
        self.gates[trigger.version] = resume
        return True


def wait_until(condition):
    until = time.monotonic() + WAIT
    while not condition() and time.monotonic() < until:
        time.sleep(0.001)
    assert condition()


def test_a_vertex_that_waits_gives_its_worker_back_and_keeps_the_order_of_versions():
    gates = {1: None, 3: None}
    waits = Vertex("waits", WaitsFor(ones, gates), {"a": "input"}, {"out": "waits"})
    timings = []
    with Frames([waits, vertex("beside", ones, "input")], 1, timings.append) as frames:
        for version in (1, 2, 3):
            frames.submit(version, input=0)
        wait_until(lambda: [t.version for t in timings if t.vertex == "beside"] == [1, 2, 3])
        assert waits.processor.begun == [1], "frame 2 starts behind frame 1"
        gates[1]()
        wait_until(lambda: waits.processor.begun == [1, 2, 3])
        assert sorted(frames.done) == [1, 2]
        gates[3]()
        done = frames.wait()
    assert all(run.data["waits"] == 1 for run in done.values())
    assert [t.version for t in timings if t.vertex == "waits"] == [1, 2, 3]
    first = next(t for t in timings if t.vertex == "waits")
    assert first.wait_ms > 0


def test_a_wait_that_raises_costs_its_frame_alone(caplog):
    class Raises(WaitsFor):
        def begin(self, trigger, resume):
            if trigger.version == 1:
                raise OSError("no such topic")
            return False

    with Frames([Vertex("raises", Raises(ones, {}), {"a": "input"}, {"out": "raises"})], 1) as frames:
        frames.submit(1, input=0)
        frames.submit(2, input=0)
        done = frames.wait()
    assert isinstance(done[1].error, OSError)
    assert done[2].data["raises"] == 1


def test_an_engine_starts_again_after_a_stop():
    graph = [vertex("first", ones, "input"), vertex("second", ones, "first")]
    frames = Frames(graph, workers=2)
    for cycle in range(5):
        with frames:
            frames.submit(cycle, input=0)
            frames.wait()
    assert sorted(frames.done) == [0, 1, 2, 3, 4]


def test_a_vertex_that_hangs_is_named_and_keeps_only_what_needs_it():
    """Its frame does not end and its own later frames wait; what is beside it runs on. A stop gives up on it."""
    hang, timings = threading.Event(), []
    graph = [
        vertex("hangs", lambda t, v: hang.wait(WAIT) and 1, "input"),
        vertex("after", ones, "hangs"),
        vertex("beside", ones, "input"),
    ]
    frames = Frames(graph, 2, timings.append)
    frames.engine.start()
    for version in (1, 2, 3):
        frames.submit(version, input=0)
    wait_until(lambda: [t.version for t in timings] == [1, 2, 3])
    assert {t.vertex for t in timings} == {"beside"}
    assert frames.engine.running() == {"hangs": 1}
    workers = list(frames.engine._threads)
    assert not frames.engine.stop(timeout=0.05)
    with pytest.raises(RuntimeError, match=r"graph cannot start again: \{'hangs': 1\} still runs"):
        frames.engine.start()
    hang.set()
    for worker in workers:
        worker.join(WAIT)
    assert frames.engine.running() == {}


def test_a_slow_vertex_makes_its_frames_wait_and_drops_none():
    graph = [vertex("slow", lambda t, v: time.sleep(0.002) or 1, "input"), vertex("fast", ones, "slow")]
    timings = []
    with Frames(graph, 2, timings.append) as frames:
        for version in range(20):
            frames.submit(version, input=0)
        done = frames.wait()
    assert all(run.data["fast"] == 1 for run in done.values())
    slow = [t for t in timings if t.vertex == "slow"]
    assert [t.version for t in slow] == list(range(20))
    for before, after in pairwise(slow):
        assert after.start_ns >= before.end_ns, "each waits for the one before it"
        assert after.wait_ms >= (before.end_ns - after.ready_ns) / 1e6, "and that is in its wait"


def test_what_is_left_out_of_a_frame_is_cut_in_it_alone():
    timings = []
    left_out = vertex("left_out", ones, "input")
    left_out.left_out = {(-1, 2)}
    with Frames([left_out, vertex("after", ones, "left_out")], 1, timings.append) as frames:
        for version in (1, 2, 3):
            frames.submit(version, input=0)
        frames.wait()
    statuses = {(one.vertex, one.version): one.status for one in timings}
    assert statuses["left_out", 2] is Status.CUT
    assert statuses["after", 2] is Status.SKIPPED
    assert {statuses[name, version] for name in ("left_out", "after") for version in (1, 3)} == {Status.OK}


def test_whoever_serves_the_graph_runs_it_without_a_worker():
    threads = []
    graph = [vertex(name, lambda t, v: threads.append(threading.current_thread()) or 1, "input") for name in ("a", "b")]
    engine = GraphEngine("graph", graph, 1)
    done = []
    engine.submit(Trigger(1), {"input": 0}, done.append, serves=True)
    engine.serve()
    assert len(done) == 1
    assert set(threads) == {threading.current_thread()}


def test_a_graph_of_nothing_is_refused():
    with pytest.raises(ValueError, match="the graph of 'graph' has no vertices"):
        GraphEngine("graph", [], 1)


def test_a_graph_without_workers_is_refused():
    with pytest.raises(ValueError, match="workers must be >= 1, not 0: nobody would run the graph of 'graph'"):
        GraphEngine("graph", [Vertex("vertex", Processor(), {}, {})], 0)
