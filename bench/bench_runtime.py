"""The mesh and the engine: commits, the way from a commit to the start of a processor, the engine's own time."""

import queue
import sys
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest

from warploom.bench.contest import record_figure
from warploom.dag import (
    BacklogConfig,
    DagComponent,
    DataProcessComponent,
    DeadlineConfig,
    GraphEngine,
    In,
    Out,
    Processor,
    ProcessorHarness,
    Trigger,
    Vertex,
)
from warploom.datamesh import CommitPolicy, DataMesh, Input, Output, Status

DISCARD = CommitPolicy.DISCARD_OUT_OF_ORDER
HAND_OFFS = 2000
SWITCH_INTERVAL = 100e-6  # what a process sets while it runs
EVERY = 0.5e-3  # [s] between commits, so that the component sleeps when one comes


class Component(DataProcessComponent):
    """Notes how long ago its datum, a time, was committed."""

    sent: Input[int]

    def process(self, trigger):
        """Notes it."""
        now = time.perf_counter_ns()
        with self.sent.access() as snapshot:
            self.context.append(now - snapshot[snapshot.version_index(trigger.version)])
        return Status.OK


class Noting(Processor):
    """The same in a graph."""

    sent: In[int]

    def process(self, trigger):
        """Notes it."""
        self.context.append(time.perf_counter_ns() - self.sent.value)
        return Status.OK


class Nothing(Processor):
    """Gives on what it takes."""

    a: In[object]
    b: In[object] = In(optional=True)
    out: Out[object]

    def process(self, trigger):
        """Gives it on."""
        self.out.value = self.a.value
        return Status.OK


class Works(Nothing):
    """Computes in NumPy for a while."""

    def process(self, trigger):
        """Computes, then gives on."""
        until = time.perf_counter_ns() + 100_000
        while time.perf_counter_ns() < until:
            self.context.sum()
        return super().process(trigger)


def output_of(mesh, topic):
    output = Output()
    output.bind("output", mesh.window(topic))
    return output


def commit(output, version, value=None):
    """Commits the time at which it does so, unless another value is given."""
    change = output.allocate_change()
    change.set_version(version)
    change.value = time.perf_counter_ns() if value is None else value
    output.commit(DISCARD, change)


@contextmanager
def busy_thread(wanted):
    """A thread that computes in Python all the time, if wanted."""
    running = wanted

    def spin():
        number = 0
        while running:
            number += 1

    thread = threading.Thread(target=spin)
    if wanted:
        thread.start()
    yield
    running = False
    if wanted:
        thread.join()


@contextmanager
def switch_interval(seconds):
    before = sys.getswitchinterval()
    sys.setswitchinterval(seconds)
    yield
    sys.setswitchinterval(before)


def bench_commit(benchmark):
    """Commits to one topic, read by nobody, with all that belongs to one: allocate, version, value, commit."""
    mesh = DataMesh()
    output = output_of(mesh, "topic")
    each, state = 2000, [0]

    def commits():
        start = time.thread_time()
        for version in range(state[0], state[0] + each):
            commit(output, version, version)
        state[0] += each
        taken.append(time.thread_time() - start)

    taken = []
    benchmark.extra_info.update(kernel="commit", on=f"{each} commits")
    benchmark.pedantic(commits, rounds=40, warmup_rounds=3)
    best, median = min(taken) / each * 1e6, np.median(taken) / each * 1e6
    note = f"one core; {1e6 / best:,.0f} a second; median {median:.1f} µs"
    record_figure(benchmark, "commit, best of 40", best, "µs", goal=10.0, note=note)


class Bare:
    """A thread that waits for a plain condition variable: what the machine itself needs to wake one, in this minute."""

    def __init__(self):
        self.taken = []
        self._condition, self._sent = threading.Condition(), []
        self._thread = threading.Thread(target=self._serve)

    def _serve(self):
        while True:
            with self._condition:
                while not self._sent:
                    self._condition.wait()
                at = self._sent.pop()
            if at is None:
                return
            self.taken.append(time.perf_counter_ns() - at)

    def send(self, at):
        """Wakes it; `at` is now."""
        with self._condition:
            self._sent.append(at)
            self._condition.notify()

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self.send(None)
        self._thread.join()


def _calls_of(depth):
    """A function that calls another, and so on, of some thirty bytecodes each; the innermost notes how long it took."""
    lines = []
    for number in range(depth):
        deeper = f"f{number + 1}(at, taken)" if number < depth - 1 else "taken.append(now() - at)"
        lines += [
            f"def f{number}(at, taken):",
            f"    a = (at, {number}); b = a[0]; c = b if b > 0 else 0; d = c == b",
            "    if d and a: e = len(a)",
            f"    return {deeper}",
        ]
    names = {"now": time.perf_counter_ns}
    exec("\n".join(lines), names)
    return names["f0"]


plain_calls = _calls_of(30)
"""As many calls as lie between a commit and an inline start, which touch nothing but their own arguments."""


def record_hand_off(benchmark, name, taken, bare=None):
    microseconds = np.array(taken) / 1e3
    median, p99 = np.median(microseconds), np.percentile(microseconds, 99)
    least, tenth = microseconds.min(), np.percentile(microseconds, 10)
    note, note99, goals = f"of {len(taken)}; least {least:.0f} µs, best tenth below {tenth:.0f} µs", "", (None, None)
    if bare is not None:
        goals, floor = (40.0, 1000.0), np.array(bare) / 1e3
        middle, tail = np.median(floor), np.percentile(floor, 99)
        note += f"; {median / middle:.2f} × a bare wake between the same commits ({middle:.0f} µs)"
        note99 = f"bare {tail:.0f} µs"
    record_figure(benchmark, f"{name}, median", median, "µs", goal=goals[0], note=note)
    record_figure(benchmark, f"{name}, p99", p99, "µs", goal=goals[1], note=note99)


@pytest.mark.parametrize("beside", ["idle", "busy"])
@pytest.mark.parametrize("interval", [SWITCH_INTERVAL, 5e-3])
def bench_condition_variable(benchmark, interval, beside):
    """What a thread that waits for a plain condition variable needs, with Python's switch interval and with ours."""
    bare = Bare()

    def hand_offs():
        with bare, busy_thread(beside == "busy"):
            for _ in range(HAND_OFFS):
                time.sleep(EVERY)
                bare.send(time.perf_counter_ns())

    benchmark.extra_info.update(kernel="condition variable", on=beside)
    with switch_interval(interval):
        benchmark.pedantic(hand_offs, rounds=1)
    name = f"plain condition variable, {beside}, threads switch every {interval * 1e3:g} ms"
    record_hand_off(benchmark, name, bare.taken)


@pytest.mark.parametrize("beside", ["idle", "busy"])
@pytest.mark.parametrize("hand_off", ["inline", "thread"])
@pytest.mark.parametrize("kind", ["data", "dag"])
def bench_hand_off(benchmark, kind, hand_off, beside):
    """From before a commit to within the processor that it triggers, after a pause: caches are cold, the core idle.

    In turn with what the machine itself needs in that minute: bare wakes of a thread, and plain calls in this one.
    """
    mesh, taken, bare, plain = DataMesh(), [], Bare(), []
    if kind == "data":
        component = Component("component", taken)
    else:
        component = DagComponent("component")
        component.add_handles(["sent"], [])
    component.bind(mesh, {"sent": "sent"})
    if isinstance(component, DagComponent):
        processor = Noting()
        processor.context = taken
        component.set_graph([Vertex("vertex", processor, {"sent": "sent"}, {})], workers=2, in_flight=1)
    component.set_trigger("sent", BacklogConfig(policy="fifo", depth=20), hand_off)
    output = output_of(mesh, "sent")

    def hand_offs():
        component.start()
        with bare, busy_thread(beside == "busy"):
            for number in range(HAND_OFFS):
                time.sleep(EVERY)
                commit(output, number)
                time.sleep(EVERY)
                bare.send(time.perf_counter_ns())
                time.sleep(EVERY)
                plain_calls(time.perf_counter_ns(), plain)
        component.stop()

    benchmark.extra_info.update(kernel=f"hand-off, {kind}, {hand_off}", on=beside)
    with switch_interval(SWITCH_INTERVAL):
        benchmark.pedantic(hand_offs, rounds=1)
    record_hand_off(benchmark, f"commit to start, {kind}, {hand_off}, {beside}", taken, bare.taken)
    if kind == "data":
        between = f"between those commits ({hand_off}, {beside})"
        record_hand_off(benchmark, f"floor: a bare wake of a thread {between}", bare.taken)
        note = f"least {min(plain) / 1e3:.0f} µs; they touch nothing but their arguments"
        record_figure(benchmark, f"floor: 30 plain calls {between}", np.median(plain) / 1e3, "µs", note=note)


@pytest.mark.parametrize("kind", ["data", "dag"])
def bench_hand_off_cpu(benchmark, kind):
    """The same way inline and without a pause: what is ours in it, whatever the machine needs to wake up."""
    mesh, taken = DataMesh(), []
    if kind == "data":
        component = Component("component", taken)
    else:
        component = DagComponent("component")
        component.add_handles(["sent"], [])
    component.bind(mesh, {"sent": "sent"})
    if isinstance(component, DagComponent):
        processor = Noting()
        processor.context = taken
        component.set_graph([Vertex("vertex", processor, {"sent": "sent"}, {})], workers=1, in_flight=1)
    component.set_trigger("sent", BacklogConfig(policy="fifo", depth=20), "inline")
    output, state = output_of(mesh, "sent"), [0]

    def hand_offs():
        for version in range(state[0], state[0] + 100):
            commit(output, version)
        state[0] += 100

    component.start()
    benchmark.extra_info.update(kernel=f"hand-off, {kind}, inline", on="100 commits")
    benchmark.pedantic(hand_offs, rounds=40, warmup_rounds=3)
    component.stop()
    each = np.array(taken) / 1e3
    best, name = each.reshape(-1, 100).mean(axis=1).min(), f"commit to start, {kind}, inline, without a pause"
    record_figure(benchmark, f"{name}, best 100", best, "µs", goal=40.0, note=f"least {each.min():.1f} µs")
    record_figure(benchmark, f"{name}, median", np.median(each), "µs", goal=40.0)


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("shape", ["chain", "branches"])
def bench_engine(benchmark, shape, workers):
    """Frames through 20 vertices that do nothing: what the engine costs per vertex, start to end of the frame."""
    vertices = []
    for number in range(20):
        source = "input" if number == 0 or shape == "branches" else f"v{number - 1}"
        vertices.append(Vertex(f"v{number}", Nothing(), {"a": source}, {"out": f"v{number}"}))
    engine = GraphEngine("graph", vertices, workers)
    done, version = threading.Semaphore(0), [0]

    def frame():
        version[0] += 1
        engine.submit(Trigger(version[0]), {"input": 0}, lambda run: done.release())
        done.acquire()

    engine.start()
    benchmark.extra_info.update(kernel=f"engine, {workers} workers", on=f"20 vertices, {shape}")
    with switch_interval(SWITCH_INTERVAL):
        benchmark.pedantic(frame, rounds=1000, warmup_rounds=50)
    engine.stop()
    if benchmark.stats is not None:
        median = benchmark.stats.stats.median / 20 * 1e6
        name = f"engine per vertex, {shape}, {workers} workers"
        record_figure(benchmark, name, median, "µs", goal=30.0, note="a frame of 20, from its submission to its end")


def bench_deadlines(benchmark):
    """20 vertices with 0.1 ms of work each, in five branches at 100 Hz on two workers; and that work in one thread."""
    mesh, timings = DataMesh(), []
    component = DagComponent("component")
    component.add_handles(["sent"], [])
    component.bind(mesh, {"sent": "sent"})
    data, vertices = np.ones(20_000), []
    for number in range(20):
        processor = Works()
        processor.context = data
        source = "sent" if number < 5 else f"v{number - 5}"
        vertices.append(Vertex(f"v{number}", processor, {"a": source}, {"out": f"v{number}"}))
    component.set_graph(
        vertices,
        workers=2,
        in_flight=1,
        on_timing=lambda timing: timings.append((threading.get_ident(), timing)),
        deadline=DeadlineConfig(ms=10.0),
    )
    component.set_trigger("sent", BacklogConfig())
    output, frames, plain_ms = output_of(mesh, "sent"), 300, []
    waiting = queue.SimpleQueue()

    def plain():
        harness = ProcessorHarness(Works, context=data).feed(a=0)
        for at in iter(waiting.get, None):
            if time.perf_counter_ns() - at > 10e6:  # left out, as the backlog leaves out what comes too late
                continue
            for _ in range(20):
                harness.run()
            plain_ms.append((time.perf_counter_ns() - at) / 1e6)

    def at_100_hz(send, first, last):
        start = time.perf_counter()
        for number in range(first, last):
            time.sleep(max(0.0, start + (number - first) / 100 - time.perf_counter()))
            send(number)

    def run():
        component.start()
        thread = threading.Thread(target=plain)
        thread.start()
        for first in range(0, frames, 50):  # in turn, as the machine is not the same at all times
            at_100_hz(lambda number: commit(output, number, number), first, first + 50)
            at_100_hz(lambda number: waiting.put(time.perf_counter_ns()), first, first + 50)
        waiting.put(None)
        thread.join()
        component.stop()

    benchmark.extra_info.update(kernel="deadlines", on="20 vertices at 100 Hz")
    with switch_interval(SWITCH_INTERVAL):
        benchmark.pedantic(run, rounds=1)
    losses = mesh.losses.as_dict().get("component", {})
    missed = losses.get("deadline", 0) + losses.get("backlog", 0)
    frames_of, gaps = {}, []
    for thread, timing in timings:
        frames_of.setdefault(timing.version, []).append((thread, timing))
    for run_of in frames_of.values():
        of_worker = {}
        for thread, timing in run_of:  # a worker's, one after the other: what lies between two of them is the engine
            before = of_worker.get(thread)
            if before is not None and timing.ready_ns <= before.end_ns:
                gaps.append((timing.start_ns - before.end_ns) / 1e3)
            of_worker[thread] = timing
    spans = [
        (max(t.end_ns for _, t in run_of) - min(t.ready_ns for _, t in run_of)) / 1e6 for run_of in frames_of.values()
    ]
    plain_missed = frames - sum(taken <= 10.0 for taken in plain_ms)
    note = (
        f"of {frames} frames, 10 ms each; a plain thread with the same work, in turn with it, missed {plain_missed}; "
        f"done in {np.median(spans):.1f} ms (median), {np.percentile(spans, 99):.1f} ms (p99), "
        f"the plain thread in {np.median(plain_ms):.1f} and {np.percentile(plain_ms, 99):.1f} ms"
    )
    record_figure(benchmark, "deadlines missed, 20 vertices at 100 Hz", missed, "", goal=0.0, note=note)
    note = f"p99 {np.percentile(gaps, 99):.0f} µs, of {len(gaps)} times that a worker found the next vertex ready"
    record_figure(
        benchmark, "engine between two vertices of that graph, median", np.median(gaps), "µs", goal=30.0, note=note
    )
