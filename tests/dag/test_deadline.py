"""Deadlines: what is late is counted, degraded or cut, and whoever waits is told in time."""

import threading

import pytest
from graph_parts import Call
from pydantic import ValidationError

from warploom.dag import BacklogConfig, CommitDagProcessor, DagComponent, DeadlineConfig, Trigger, Vertex
from warploom.dag.deadline import FrameDeadline
from warploom.datamesh import DataMesh, ManualClock, Miss, Status

WAIT = 20.0
MS = 1_000_000
pytestmark = pytest.mark.usefixtures("no_thread_left")


@pytest.mark.parametrize("config", [{}, {"ms": 0}, {"ms": 5, "on_miss": "hope"}])
def test_a_deadline_that_makes_no_sense_is_refused(config):
    with pytest.raises(ValidationError):
        DeadlineConfig(**config)


@pytest.mark.parametrize(
    ("on_miss", "left_out"), [("count", (False, False)), ("degrade", (False, True)), ("cut", (True, True))]
)
def test_past_the_deadline_a_vertex_runs_or_not_as_the_configuration_says(on_miss, left_out):
    clock, settled = ManualClock(), []
    clock.advance(3 * MS)
    trigger = Trigger(7, received_ns=1 * MS, epoch=2)
    deadline = FrameDeadline(
        DeadlineConfig(ms=10, on_miss=on_miss), trigger, clock, lambda *order: settled.append(order)
    )
    clock.advance(8 * MS)
    assert [deadline.leaves_out(expendable) for expendable in (False, True)] == [False, False]
    clock.advance(1)
    assert tuple(deadline.leaves_out(expendable) for expendable in (False, True)) == left_out
    assert settled == ([(7, 2)] if on_miss == "cut" else [])
    assert deadline.end()


def test_a_frame_that_is_done_in_time_is_not_settled_later():
    clock, settled = ManualClock(), []
    deadline = FrameDeadline(
        DeadlineConfig(ms=10, on_miss="cut"), Trigger(7, at_ns=0), clock, lambda *o: settled.append(o)
    )
    clock.advance(10 * MS)
    assert settled == [(7, -1)]
    deadline = FrameDeadline(
        DeadlineConfig(ms=10, on_miss="cut"), Trigger(8, at_ns=10 * MS), clock, lambda *o: settled.append(o)
    )
    assert not deadline.end()
    clock.advance(20 * MS)
    assert settled == [(7, -1)]


class Graph:
    """A slow vertex, which moves the clock; then an expendable one, and a commit of what the slow one gave."""

    def __init__(self, topic, on_miss, slow_ms, deadline_ms=50):
        self.clock = ManualClock()
        self.mesh = DataMesh(clock=self.clock)
        self.timings, self.hang = [], threading.Event()
        self.hang.set()
        self.component = DagComponent("dag")
        self.component.add_handles(["input"], ["output"])
        self.component.bind(self.mesh, {"input": "input", "output": "output"})
        slow, extra, commit = Call(), Call(), CommitDagProcessor()
        slow.name, extra.name = "slow", "extra"

        def act(trigger, value):
            self.clock.advance(slow_ms * MS if trigger.version == 1 else 0)
            assert self.hang.wait(WAIT)
            return value

        slow.context, extra.context = {"slow": act}, {"extra": lambda trigger, value: value}
        slow.place, slow.losses = "dag.slow", self.mesh.losses
        commit.component_outputs = self.component.outputs
        commit.init(CommitDagProcessor.Config(output="output"))
        vertices = [
            Vertex("slow", slow, {"value": "input"}, {"result": "slow"}),
            Vertex("extra", extra, {"value": "slow"}, {"result": "extra"}, expendable=True),
            Vertex("commit", commit, {"value": "slow"}, {}),
        ]
        deadline = DeadlineConfig(ms=deadline_ms, on_miss=on_miss)
        self.component.set_graph(vertices, workers=1, in_flight=1, on_timing=self.timings.append, deadline=deadline)
        self.component.set_trigger("input", BacklogConfig(policy="fifo", depth=10))
        self.input, self.output = topic(self.mesh.window("input")), topic(self.mesh.window("output"))

    def statuses(self, version):
        return {one.vertex: one.status for one in self.timings if one.version == version}


@pytest.mark.parametrize(
    ("on_miss", "statuses", "committed"),
    [
        ("count", {"slow": Status.OK, "extra": Status.OK, "commit": Status.OK}, {1: "a", 2: "b"}),
        ("degrade", {"slow": Status.OK, "extra": Status.CUT, "commit": Status.OK}, {1: "a", 2: "b"}),
        ("cut", {"slow": Status.OK, "extra": Status.CUT, "commit": Status.CUT}, {2: "b"}),
    ],
)
def test_a_slow_frame_is_counted_degraded_or_cut_and_the_next_runs_whole(on_miss, statuses, committed, topic):
    graph = Graph(topic, on_miss, slow_ms=51)
    graph.component.start()
    graph.input.commit(1, "a")
    graph.output.wait_for(1)
    graph.input.commit(2, "b")
    graph.output.wait_for(1, 2)
    graph.component.stop()
    assert graph.statuses(1) == statuses
    assert set(graph.statuses(2).values()) == {Status.OK}
    assert graph.output.entries == committed
    assert graph.mesh.losses.as_dict() == {"dag": {"deadline": 1}}


def test_a_frame_that_is_in_time_is_whole(topic):
    graph = Graph(topic, "cut", slow_ms=50)
    graph.component.start()
    graph.input.commit(1, "a")
    graph.component.stop()
    assert graph.output.entries == {1: "a"}
    assert graph.mesh.losses.as_dict() == {}


def test_who_waits_for_a_frame_in_which_a_vertex_hangs_is_told_at_its_deadline(topic):
    """Not when the vertex comes back; the frames behind it run then."""
    graph = Graph(topic, "cut", slow_ms=51)
    graph.hang.clear()
    graph.component.start()
    graph.input.commit(1, "a")
    graph.output.wait_for(1)
    assert graph.mesh.window("output").snapshot().miss(1) is Miss.SETTLED_EMPTY
    graph.input.commit(2, "b")
    assert graph.component._engine.running() == {"slow": 1}
    graph.hang.set()
    graph.output.wait_for(1, 2)
    graph.component.stop()
    assert graph.output.entries == {2: "b"}
    assert graph.output.settled == [1]


def test_a_vertex_has_a_deadline_of_its_own_which_is_counted():
    from warploom.dag import GraphEngine

    timings, done = [], threading.Event()
    slow = Call()
    slow.name, slow.place = "slow", "graph.slow"
    slow.context = {"slow": lambda trigger, value: threading.Event().wait(0.003)}
    engine = GraphEngine("graph", [Vertex("slow", slow, {"value": "input"}, {}, deadline_ns=1 * MS)], 1, timings.append)
    engine.start()
    engine.submit(Trigger(5), {"input": 0}, lambda run: done.set())
    assert done.wait(WAIT)
    engine.stop()
    assert timings[0].late
    assert slow.losses.as_dict() == {"graph.slow": {"deadline": 1}}
