"""The trace: a file that Perfetto opens, in which slices nest and arrows go forward, whatever happens to the disk."""

import errno
import json
import threading
import time
from collections import defaultdict

import pytest

from warploom.dag import Process, VertexTiming, load_module
from warploom.dag.trace import Trace
from warploom.datamesh import Status
from warploom.errors import SinkError

pytestmark = pytest.mark.usefixtures("no_thread_left")

MODULE = """\
module: chain
components:
  - name: adder
    kind: dag
    trigger: number
    inputs: {number: sensor/number}
    outputs: {text: result/text}
    workers: 2
    in_flight: 2
    graph:
      add: {processor: graph_parts.Add, in: {value: number}}
      describe: {processor: graph_parts.Describe}
      commit: {processor: warploom.dag.CommitDagProcessor, in: {value: text}, config: {output: text}}
"""


def test_every_run_of_a_vertex_is_a_slice_with_its_version_and_status(write, topic, tmp_path, caplog):
    timings: list[VertexTiming] = []
    with Trace(tmp_path / "trace.json", "chain") as trace:

        def on_timing(timing):
            timings.append(timing)
            trace.on_timing(timing)

        process = Process(
            [load_module(write(MODULE))], external={"sensor/number": int}, offline=True, context=("fail", 7),
            on_timing=on_timing,
        )  # fmt: skip
        trace.watch(process.mesh, ["sensor/number"], ["result/text"])
        number = topic(process.mesh.window("sensor/number"))
        process.start()
        for version in range(20):
            number.commit(version, version)
        process.stop()
    events = json.loads(trace.path.read_text())
    slices = [event for event in events if event["ph"] == "X" and event["cat"] == "vertex"]
    assert len(slices) == 60
    known = {(f"{t.component}.{t.vertex}", t.version): t for t in timings}
    for one in slices:
        timing = known[one["name"], one["args"]["version"]]
        assert one["args"]["status"] == timing.status.name
        assert one["ts"] == pytest.approx(timing.start_ns / 1e3, abs=0.002)
        assert one["dur"] == pytest.approx((timing.end_ns - timing.start_ns) / 1e3, abs=0.002)
    failed = [one["name"] for one in slices if one["args"]["status"] == "FAILED"]
    assert failed == ["adder.add"]
    check_waits(events, known)
    check_nesting(events)
    check_arrows(events)
    check_counters(events)
    names = {event["args"]["name"] for event in events if event["name"] == "thread_name"}
    assert {"adder-worker-0", "MainThread"} & names
    assert events[0]["args"] == {"name": "chain"}
    assert {event["tid"] for event in slices} <= {e["tid"] for e in events if e["name"] == "thread_name"}


def check_waits(events, known):
    """Each vertex's wait in the queue, from when its inputs were there to its start."""
    begins = {event["id"]: event for event in events if event["ph"] == "b"}
    ends = {event["id"]: event for event in events if event["ph"] == "e"}
    assert begins.keys() == ends.keys()
    assert len(begins) == len(known)
    for number, begin in begins.items():
        timing = known[begin["name"].removesuffix(" waits"), begin["args"]["version"]]
        assert ends[number]["ts"] - begin["ts"] == pytest.approx(timing.wait_ms * 1e3, abs=0.01)


def check_nesting(events):
    """On one thread, two slices lie one in the other or apart: else Perfetto would leave one out."""
    rows = defaultdict(list)
    for event in events:
        if event["ph"] == "X":
            rows[event["tid"]].append((event["ts"], event["ts"] + event["dur"]))
    for row in rows.values():
        open_until = []
        for start, end in sorted(row, key=lambda one: (one[0], -one[1])):
            while open_until and open_until[-1] <= start:
                open_until.pop()
            assert not open_until or end <= open_until[-1] + 1e-3
            open_until.append(end)


def check_arrows(events):
    """The arrows of a version begin at the source's commit, go forward, and each touches a slice of its thread."""
    slices = [event for event in events if event["ph"] == "X"]
    flows = defaultdict(list)
    for event in events:
        if event["ph"] in "stf":
            assert isinstance(event["id"], int)
            flows[event["id"]].append(event)
            assert any(s["tid"] == event["tid"] and s["ts"] <= event["ts"] <= s["ts"] + s["dur"] for s in slices)
    assert len(flows) == 20
    for steps in flows.values():
        steps.sort(key=lambda event: event["ts"])
        phases = "".join(step["ph"] for step in steps)
        assert phases.startswith("st"), phases
        assert phases.count("s") == 1
        assert phases.endswith("f") or phases.count("f") == 0
    assert sum(any(step["ph"] == "f" for step in steps) for steps in flows.values()) == 19


def check_counters(events):
    frames = [event["args"]["frames"] for event in events if event["name"] == "frames on their way"]
    assert frames[-1] == 0, "also the frame that failed is over"
    assert max(frames) >= 1
    latencies = [event["args"]["ms"] for event in events if event["name"] == "latency of result/text [ms]"]
    assert len(latencies) == 19
    assert min(latencies) > 0
    losses = [event for event in events if event.get("cat") == "loss"]
    assert [(event["name"], event["args"]["version"]) for event in losses] == [("adder.add: failed", 7)]


def timing(version: int) -> VertexTiming:
    now = time.perf_counter_ns()
    return VertexTiming("a", "b", version, now - 5000, now - 3000, now, Status.OK)


def test_events_of_many_threads_are_all_written(tmp_path):
    with Trace(tmp_path / "trace.json") as trace:
        threads = [
            threading.Thread(target=lambda: [trace.on_timing(timing(v)) for v in range(500)], name=f"t{i}")
            for i in range(8)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    events = json.loads(trace.path.read_text())
    assert sum(event.get("cat") == "vertex" and event["ph"] == "X" for event in events) == 4000
    assert {event["args"]["name"] for event in events if event["name"] == "thread_name"} == {f"t{i}" for i in range(8)}


def test_a_trace_that_breaks_off_is_whole_but_for_its_end(tmp_path):
    trace = Trace(tmp_path / "trace.json")
    for version in range(100):
        trace.on_timing(timing(version))
    trace._flush()
    text = trace.path.read_text()
    trace.close()
    # The format lets the closing bracket be absent.
    assert sum(event.get("cat") == "vertex" and event["ph"] == "X" for event in json.loads(text + "]")) == 100


def test_a_full_disk_ends_the_trace_and_nothing_else(tmp_path, caplog):
    trace = Trace(tmp_path / "trace.json")
    trace._file = FullDisk(trace._file)
    for version in range(10):
        trace.on_timing(timing(version))
    trace._flush()
    for version in range(10):
        trace.on_timing(timing(version))
    trace.close()
    trace.close()
    assert trace.failure == "No space left on device"
    assert trace.dropped >= 20
    assert "the trace broke off" in caplog.text


class FullDisk:
    """A file on a full disk."""

    def __init__(self, file):
        self._file = file

    def write(self, text):
        raise OSError(errno.ENOSPC, "No space left on device")

    def flush(self):
        pass

    def close(self):
        self._file.close()


def test_a_place_that_cannot_be_written_is_refused(tmp_path):
    with pytest.raises(SinkError, match="cannot be created"):
        Trace(tmp_path)
