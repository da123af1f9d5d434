"""The mesh and the engine: commits, the way from a commit to the start of a processor, the engine's own time."""

import gc
import itertools
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
    frozen_heap,
)
from warploom.datamesh import CommitPolicy, DataMesh, Input, Output, Status

DISCARD = CommitPolicy.DISCARD_OUT_OF_ORDER
HAND_OFFS = 1500
ROUND = 100  # hand-offs without a pause, of ours and of the bare one in turn
SWITCH_INTERVAL = 100e-6  # what a `Process` sets while it runs
PAUSE = 0.5e-3  # [s] before a commit: the core sleeps meanwhile, and caches hold other things


class Taken(list):
    """How long each hand-off took [ns]; `noted` has an item for each."""

    def __init__(self):
        super().__init__()
        self.noted = queue.SimpleQueue()

    def append(self, taken):
        """Notes one."""
        super().append(taken)
        self.noted.put(None)


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
    """Computes in NumPy for a while, and notes how long its thread was without a core meanwhile."""

    def process(self, trigger):
        """Computes, then gives on."""
        data, without_core = self.context
        start, worked = time.perf_counter_ns(), time.thread_time_ns()
        while time.perf_counter_ns() < start + 100_000:
            data.sum()
        worked = time.thread_time_ns() - worked
        without_core.append((trigger.version, time.perf_counter_ns() - start - worked))
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


@contextmanager
def as_in_a_process():
    """What a running `Process` sees to: threads switch sooner, and the collector leaves alone what was there."""
    with switch_interval(SWITCH_INTERVAL), frozen_heap():
        yield


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
        self.taken = Taken()
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
    """Rows for median and p99; with what a bare condition variable took between the same hand-offs, and the ratio."""
    ours = np.array(taken) / 1e3
    median, p99 = np.median(ours), np.percentile(ours, 99)
    note = f"least {ours.min():.0f} µs, best tenth below {np.percentile(ours, 10):.0f} µs"
    note99, goals = "", (None, None)
    if bare is not None:
        goals, floor = (40.0, 1000.0), np.array(bare) / 1e3
        middle, tail = np.median(floor), np.percentile(floor, 99)
        note = f"{median / middle:.2f} × a bare condition variable in turn with it ({middle:.0f} µs); {note}"
        note99 = f"{p99 / tail:.2f} × the bare one ({tail:.0f} µs)"
    record_figure(benchmark, f"{name}, median", median, "µs", goal=goals[0], note=note)
    record_figure(benchmark, f"{name}, p99", p99, "µs", goal=goals[1], note=note99)


@pytest.mark.parametrize("beside", ["idle", "busy"])
@pytest.mark.parametrize("interval", [SWITCH_INTERVAL, 5e-3])
def bench_condition_variable(benchmark, interval, beside):
    """What a thread that waits for a plain condition variable needs, with Python's switch interval and with ours."""
    bare = Bare()

    def hand_offs():
        with bare, busy_thread(beside == "busy"):
            for _ in range(HAND_OFFS // 4):
                time.sleep(PAUSE)
                bare.send(time.perf_counter_ns())
                bare.taken.noted.get()

    benchmark.extra_info.update(kernel="condition variable", on=beside)
    with switch_interval(interval):
        benchmark.pedantic(hand_offs, rounds=1)
    name = f"plain condition variable, {beside}, threads switch every {interval * 1e3:g} ms"
    record_hand_off(benchmark, name, bare.taken)


def component_of(kind, mesh, taken, hand_off):
    """A component that notes how old its datum is, as data process or as a graph of one vertex."""
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
    return component


@pytest.mark.parametrize("beside", ["idle", "busy"])
@pytest.mark.parametrize("hand_off", ["inline", "thread"])
@pytest.mark.parametrize("kind", ["data", "dag"])
def bench_hand_off(benchmark, kind, hand_off, beside):
    """From before a commit to within the processor that it triggers, one after the other and after pauses.

    In turn with what the machine itself needs in that minute: wakes of a thread by a bare condition variable, and plain
    calls in this thread.
    """
    mesh, taken, bare, plain = DataMesh(), Taken(), Bare(), []
    component = component_of(kind, mesh, taken, hand_off)
    output, number = output_of(mesh, "sent"), itertools.count()

    def ours():
        commit(output, next(number))
        taken.noted.get()

    def bare_wake():
        bare.send(time.perf_counter_ns())
        bare.taken.noted.get()

    def hand_offs():
        component.start()
        with bare, busy_thread(beside == "busy"):
            for _ in range(HAND_OFFS // ROUND):
                for one in (ours, bare_wake):
                    for _ in range(ROUND):
                        one()
            for _ in range(HAND_OFFS):
                for one in (ours, bare_wake, lambda: plain_calls(time.perf_counter_ns(), plain)):
                    time.sleep(PAUSE)
                    one()
        component.stop()

    benchmark.extra_info.update(kernel=f"hand-off, {kind}, {hand_off}", on=beside)
    with as_in_a_process():
        benchmark.pedantic(hand_offs, rounds=1)
    name, warm = f"commit to start, {kind}, {hand_off}, {beside}", len(bare.taken) - HAND_OFFS
    record_hand_off(benchmark, f"{name}, without a pause", taken[ROUND:warm], bare.taken[ROUND:warm])
    record_hand_off(benchmark, f"{name}, after a pause", taken[warm:], bare.taken[warm:])
    if kind == "data" and hand_off == "inline":
        note = f"least {min(plain) / 1e3:.0f} µs; they touch nothing but their arguments"
        name = f"floor: 30 plain calls after such a pause, {beside}"
        record_figure(benchmark, name, np.median(plain) / 1e3, "µs", note=note)


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
    with as_in_a_process():
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
    data, vertices, without_core = np.ones(20_000), [], []
    for number in range(20):
        processor = Works()
        processor.context = data, without_core
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
        harness = ProcessorHarness(Works, context=(data, [])).feed(a=0)
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

    def full_pass():
        """How many objects the garbage collector looks at, and how long that holds all threads up [ms]."""
        start = time.perf_counter_ns()
        gc.collect()
        return len(gc.get_objects()), (time.perf_counter_ns() - start) / 1e6

    passes = [full_pass()]

    def run():
        component.start()
        thread = threading.Thread(target=plain)
        thread.start()
        for first in range(0, frames, 50):  # in turn, as the machine is not the same at all times
            at_100_hz(lambda number: commit(output, number, number), first, first + 50)
            at_100_hz(lambda number: waiting.put(time.perf_counter_ns()), first, first + 50)
        passes.append(full_pass())
        waiting.put(None)
        thread.join()
        component.stop()

    benchmark.extra_info.update(kernel="deadlines", on="20 vertices at 100 Hz")
    with as_in_a_process():
        benchmark.pedantic(run, rounds=1)
    losses = mesh.losses.as_dict().get("component", {})
    late, dropped = losses.get("deadline", 0), losses.get("backlog", 0)
    stood = dict.fromkeys((version for version, _ in without_core), 0)
    for version, nanoseconds in without_core:
        stood[version] = max(stood[version], nanoseconds)
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
    for version, run_of in frames_of.items():  # the way to the first vertex is one more wake that may be late
        stood[version] = max(stood[version], min(t.start_ns - t.ready_ns for _, t in run_of))
    starved = sum(stood[version] > 5e6 for version, span in zip(frames_of, spans, strict=True) if span > 10.0)
    plain_missed = frames - sum(taken <= 10.0 for taken in plain_ms)
    note = (
        f"of {frames} frames, 10 ms each: {late} late, {dropped} left out behind them; in {starved} of the late ones a "
        f"worker stood without a core for over 5 ms; a plain thread with the same work, in turn with it, missed "
        f"{plain_missed}; "
        f"done in {np.median(spans):.1f} ms (median), {np.percentile(spans, 99):.1f} ms (p99), {max(spans):.1f} ms "
        f"(longest), the plain thread in {np.median(plain_ms):.1f}, {np.percentile(plain_ms, 99):.1f} and "
        f"{max(plain_ms):.1f} ms"
    )
    record_figure(benchmark, "deadlines missed, 20 vertices at 100 Hz", late + dropped, "", goal=0.0, note=note)
    note = f"p99 {np.percentile(gaps, 99):.0f} µs, of {len(gaps)} times that a worker found the next vertex ready"
    record_figure(
        benchmark, "engine between two vertices of that graph, median", np.median(gaps), "µs", goal=30.0, note=note
    )
    (all_objects, all_ms), (objects, own_ms) = passes
    note = f"over {objects:,} objects; without `frozen_heap` {all_ms:.0f} ms, over {all_objects:,}"
    record_figure(benchmark, "full pass of the garbage collector beside that graph", own_ms, "ms", note=note)
