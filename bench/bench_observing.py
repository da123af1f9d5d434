"""What it costs a run to be watched: CPU time of the thread in which something happens, per event."""

import time

import pytest

from warploom.bench.contest import record_figure
from warploom.dag import VertexTiming
from warploom.dag.metrics import Metrics
from warploom.dag.trace import Trace
from warploom.datamesh import CommitPolicy, DataMesh, Output, Status
from warploom.datamesh.recording import Recorder

EVENTS = 2000
ROUNDS = 9


def least(benchmark, event) -> float:
    """The least CPU time of an event in several rounds [µs]."""
    taken = []

    def events():
        start = time.thread_time()
        for _ in range(EVENTS):
            event()
        taken.append(time.thread_time() - start)

    if benchmark is None:
        for _ in range(ROUNDS):
            events()
    else:
        benchmark.extra_info.update(kernel="observing", on=f"{EVENTS} events")
        benchmark.pedantic(events, rounds=ROUNDS)
    return min(taken) / EVENTS * 1e6


def a_run():
    now = time.perf_counter_ns()
    return VertexTiming("perception", "cluster", 1, now - 5000, now - 3000, now, Status.OK)


def commits(mesh: DataMesh):
    """Gives a function that commits the next version."""
    output = Output()
    output.bind("number", mesh.window("number"))
    version = 0

    def commit():
        nonlocal version
        version += 1
        change = output.allocate_change()
        change.set_version(version)
        change.value = version
        output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)

    return commit


@pytest.mark.parametrize("who", ["trace", "metrics"])
def bench_run_of_a_vertex(benchmark, tmp_path, who):
    timing = a_run()
    if who == "metrics":
        metrics = Metrics()
        cost = least(benchmark, lambda: metrics.on_timing(timing))
    else:
        with Trace(tmp_path / "trace.json") as trace:
            cost = least(benchmark, lambda: trace.on_timing(timing))
    record_figure(benchmark, f"{who}, per run of a vertex", cost, "µs", note="CPU time of the worker's thread")


@pytest.mark.parametrize("who", ["trace", "metrics", "recorder"])
def bench_commit(benchmark, tmp_path, who):
    plain = least(None, commits(DataMesh()))
    mesh = DataMesh()
    watcher = {
        "trace": lambda: Trace(tmp_path / "trace.json"),
        "metrics": Metrics,
        "recorder": lambda: Recorder(tmp_path / "a.mcap", when_full="drop"),
    }[who]()
    if who == "trace":
        watcher.watch(mesh, ["number"], [])
    else:
        watcher.watch(mesh, ["number"])
    cost = least(benchmark, commits(mesh)) - plain
    if who != "metrics":
        watcher.close()
    record_figure(
        benchmark, f"{who}, per commit", max(0.0, cost), "µs", note=f"more than the {plain:.1f} µs of a commit alone"
    )
