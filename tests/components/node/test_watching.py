"""The metric agent and the trace: what they tell of a process, and that they cost nothing when they cannot."""

import json
import os
import socket
import urllib.request

import pytest

from warploom.components.execution import ExecutionContext
from warploom.components.node.metric_agent import MetricAgent, MetricAgentConfig
from warploom.components.node.tracing import TraceWriter, TraceWriterConfig
from warploom.dag import VertexTiming
from warploom.datamesh import CommitPolicy, DataMesh, Output, Status
from warploom.datamesh.clock import ManualClock

TIMING = ("perception", "cluster", 1, 1_000_000, 2_000_000, 5_000_000, Status.OK)


def timing():
    return VertexTiming(*TIMING)


def commit(mesh, topic, version):
    output = Output()
    output.bind(topic, mesh.window(topic))
    with output.allocate_change() as change:
        change.set_version(version)
        change.value = version
        output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)


def agent(port, mesh=None, context=None):
    one = MetricAgent("agent", context or ExecutionContext())
    mesh = mesh or DataMesh()
    mesh.window("a")
    one.bind(mesh, {})
    one.init(MetricAgentConfig(port=port))
    one.start()
    return one, mesh


def test_it_answers_prometheus_with_commits_and_times_of_vertices():
    context = ExecutionContext()
    one, mesh = agent(0, context=context)
    try:
        commit(mesh, "a", 1)
        context.timings(timing())
        url = one.state()["metrics"]
        assert url.startswith("http://127.0.0.1:")
        text = urllib.request.urlopen(url, timeout=10).read().decode()
        assert 'warploom_commits_total{topic="a"} 1' in text
        assert 'warploom_vertex_runs_total{vertex="perception.cluster",status="ok"} 1' in text
        assert one.idle_because is None
    finally:
        one.stop()
    context.timings(timing())
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(url, timeout=1)


def test_without_a_port_it_is_idle_and_opens_none():
    one, _ = agent(None)
    assert one.idle_because == "no port is given: set agent.port, 0 for any that is free"
    assert one.state() == {}
    one.stop()


def test_a_port_that_is_taken_costs_the_metrics_and_nothing_else(caplog):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        one, _ = agent(taken.getsockname()[1])
        assert "cannot be used for metrics" in one.idle_because
        assert "cannot be used" in caplog.text
        one.stop()


def writer(tmp_path, context, **config):
    clock = ManualClock(1_000_000_000)
    mesh = DataMesh(clock=clock)
    one = TraceWriter("tracer", context)
    for topic in ("a", "camera", "perception/obstacles"):
        mesh.window(topic)
    one.bind(mesh, {})
    settings = TraceWriterConfig.model_validate({"file": str(tmp_path / "{name}.json"), "sources": ["a"], **config})
    one.check(settings)
    one.init(settings)
    return one, mesh, clock


def test_the_trace_holds_commits_and_vertices_until_its_time_is_over(tmp_path):
    context = ExecutionContext()
    one, mesh, clock = writer(tmp_path, context, seconds=5)
    one.start()
    commit(mesh, "a", 1)
    commit(mesh, "camera", 1_000)
    context.timings(timing())
    commit(mesh, "perception/obstacles", 1)
    clock.advance(6_000_000_000)
    one.stop()
    commit(mesh, "a", 2)
    context.timings(timing())
    events = json.loads((tmp_path / "tracer.json").read_text())
    names = [event["name"] for event in events]
    assert names.count("commit a") == 1
    assert names.count("commit camera") == 1
    assert [event["args"]["frames"] for event in events if event["name"] == "frames on their way"] == [1, 0]
    assert names.count("perception.cluster") == 1
    assert "commit perception/obstacles" in names
    assert one.idle_because == "the first 5 s are written"
    assert one.state()["events_dropped"] == 0


def test_of_the_lives_before_the_newest_traces_are_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPLOOM_RUN", str(tmp_path))
    for pid in range(1, 8):
        (tmp_path / f"trace-tracer-{pid}.json").write_text("{}")
        os.utime(tmp_path / f"trace-tracer-{pid}.json", (pid, pid))
    (tmp_path / "trace-other-1.json").write_text("{}")
    one, *_ = writer(tmp_path, ExecutionContext(), file="trace-{name}-{pid}.json")
    one.start()
    one.stop()
    own = [f"trace-tracer-{pid}.json" for pid in (4, 5, 6, 7, os.getpid())]
    assert {path.name for path in tmp_path.iterdir()} == {*own, "trace-other-1.json"}


def test_a_stop_before_that_writes_the_trace_to_its_end(tmp_path):
    one, mesh, _ = writer(tmp_path, ExecutionContext())
    one.start()
    commit(mesh, "a", 1)
    one.stop()
    assert json.loads((tmp_path / "tracer.json").read_text())


def test_zero_seconds_write_nothing(tmp_path):
    one, *_ = writer(tmp_path, ExecutionContext(), seconds=0)
    one.start()
    one.stop()
    assert list(tmp_path.iterdir()) == []
    assert one.idle_because == "tracer.seconds is 0"


def test_a_file_that_cannot_be_made_costs_the_trace_and_nothing_else(tmp_path):
    (tmp_path / "file").write_text("")
    one, *_ = writer(tmp_path, ExecutionContext(), file=str(tmp_path / "file" / "trace.json"))
    one.start()
    assert "cannot be created" in one.idle_because
    one.stop()


def test_an_unknown_placeholder_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"name.*pid.*are the placeholders, not 'node'"):
        writer(tmp_path, ExecutionContext(), file="{node}.json")


def test_a_name_alone_lies_in_the_folder_of_runs(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPLOOM_RUN", str(tmp_path))
    one, *_ = writer(tmp_path, ExecutionContext(), file="{name}.json")
    one.start()
    one.stop()
    assert (tmp_path / "tracer.json").is_file()
