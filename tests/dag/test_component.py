"""The kinds of components, each on a mesh, fed and watched from outside."""

import threading

import pytest
from graph_parts import Call, Doubler

from warploom.dag import (
    BacklogConfig,
    CommitDagProcessor,
    Component,
    DagComponent,
    GenericComponent,
    MonotonicDagComponent,
    Trigger,
    Vertex,
)
from warploom.datamesh import CommitPolicy, DataMesh, EqualVersion, Miss, Status

WAIT = 20.0
FIFO, BLOCK = BacklogConfig(policy="fifo", depth=30), BacklogConfig(policy="block")
pytestmark = pytest.mark.usefixtures("no_thread_left")


@pytest.fixture
def started():
    """Starts components, and stops them at the end in the order in which they are given."""
    components = []

    def start(*new):
        components.extend(new)
        for component in reversed(new):
            component.start()

    yield start
    for component in components:
        component.stop()


def doubler(mesh, context=None, backlog=FIFO, name="doubler", topics=("number", "double")):
    component = Doubler(name, context)
    component.bind(mesh, {"number": topics[0], "double": topics[1]})
    component.set_trigger("number", backlog)
    return component


def dag(mesh, *acts, kind=DagComponent, backlog=FIFO, topics=("input", "output"), workers=2, in_flight=1, **calls):
    """A chain of vertices `v0`, `v1` … that do `acts`, and one that commits the result of the last."""
    component = kind(calls.pop("name", "dag"))
    component.add_handles(["input"], ["output"])
    component.bind(mesh, {"input": topics[0], "output": topics[1]})
    vertices = []
    for number, act in enumerate(acts):
        processor = Call()
        processor.name, processor.context = f"v{number}", {f"v{number}": act, **calls}
        source = f"v{number - 1}" if number else "input"
        vertices.append(Vertex(processor.name, processor, {"value": source}, {"result": processor.name}))
    commit = CommitDagProcessor()
    commit.component_outputs = component.outputs
    commit.init(CommitDagProcessor.Config(output="output"))
    vertices.append(Vertex("commit", commit, {"value": f"v{len(acts) - 1}"}, {}))
    component.set_graph(vertices, workers=workers, in_flight=in_flight)
    component.set_trigger("input", backlog)
    return component


class Holding:
    """An act that holds the frames that it is told to, until they are released."""

    def __init__(self, *versions):
        self.held = {version: threading.Event() for version in versions}
        self.reached = {version: threading.Event() for version in versions}
        self.started = []

    def __call__(self, trigger, value):
        self.started.append(trigger.version)
        if trigger.version in self.held:
            self.reached[trigger.version].set()
            assert self.held[trigger.version].wait(WAIT)
        return value

    def wait_until_held(self, version):
        assert self.reached[version].wait(WAIT)

    def release(self, version):
        self.held[version].set()


def same(trigger, value):
    return value


def failing_at(*versions):
    def act(trigger, value):
        if trigger.version in versions:
            raise ValueError("bad frame")
        return value

    return act


def test_a_data_process_runs_for_each_message(topic, started):
    mesh = DataMesh()
    number, double = topic(mesh.window("number")), topic(mesh.window("double"))
    started(doubler(mesh))
    for version in (1, 2, 3):
        number.commit(version, version * 10)
    double.wait_for(1, 2, 3)
    assert double.entries == {1: 20, 2: 40, 3: 60}
    assert double.settled == []
    assert mesh.losses.as_dict() == {}


@pytest.mark.parametrize("how", ["fail", "exit"])
def test_an_exception_in_a_data_process_costs_that_frame_alone(how, topic, started, caplog):
    mesh = DataMesh()
    number, double = topic(mesh.window("number")), topic(mesh.window("double"))
    started(doubler(mesh, (how, 2)))
    for version in (1, 2, 3):
        number.commit(version, version)
    double.wait_for(1, 2, 3)
    assert double.entries == {1: 2, 3: 6}
    assert double.settled == [2]
    assert mesh.losses.as_dict() == {"doubler": {"failed": 1}}
    assert "doubler failed at version 2" in caplog.text


def test_a_failed_frame_is_settled_through_the_whole_chain(topic, started, caplog):
    """Whoever waits at the end learns of every version, once, and in the order of versions."""
    mesh = DataMesh()
    first = dag(mesh, failing_at(2, 5), name="first", topics=("a", "b"))
    second = doubler(mesh, name="second", topics=("b", "c"))
    third = dag(mesh, same, same, name="third", topics=("c", "d"), kind=MonotonicDagComponent)
    a, d = topic(mesh.window("a")), topic(mesh.window("d"))
    started(first, second, third)
    for version in range(1, 7):
        a.commit(version, version)
    d.wait_for(*range(1, 7))
    assert d.events == [1, 2, 3, 4, 5, 6]
    assert d.settled == [2, 5]
    assert mesh.window("d").snapshot().miss(5) is Miss.SETTLED_EMPTY
    assert mesh.losses.as_dict() == {"first.v0": {"failed": 2}}


def test_a_settle_from_outside_is_passed_on(topic, started):
    mesh = DataMesh()
    a, d = topic(mesh.window("input")), topic(mesh.window("output"))
    started(dag(mesh, same))
    a.commit(1, "x")
    a.settle(2)
    a.commit(3, "y")
    d.wait_for(1, 2, 3)
    assert d.entries == {1: "x", 3: "y"}
    assert d.settled == [2]


def test_a_graph_reads_the_trigger_version_not_the_newest(topic, started):
    mesh = DataMesh()
    hold = Holding(1)
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    started(dag(mesh, hold, in_flight=2))
    for version in (1, 2, 3):
        given.commit(version, f"v{version}")
    hold.wait_until_held(1)
    hold.release(1)
    result.wait_for(1, 2, 3)
    assert result.entries == {1: "v1", 2: "v2", 3: "v3"}


def test_latest_runs_the_newest_of_what_came_meanwhile(topic, started):
    """While frame 1 runs, 2 to 5 come: 5 runs, the others are counted and settled."""
    mesh = DataMesh()
    hold = Holding(1)
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    started(dag(mesh, hold, backlog=BacklogConfig()))
    given.commit(1)
    hold.wait_until_held(1)
    for version in (2, 3, 4, 5):
        given.commit(version)
    hold.release(1)
    result.wait_for(1, 2, 3, 4, 5)
    assert hold.started == [1, 5]
    assert sorted(result.settled) == [2, 3, 4]
    assert mesh.losses.as_dict() == {"dag": {"backlog": 3}}


@pytest.mark.parametrize(("drop", "run"), [("oldest", [1, 4, 5]), ("newest", [1, 2, 3])])
def test_fifo_keeps_as_many_as_its_depth(drop, run, topic, started):
    mesh = DataMesh()
    hold = Holding(1)
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    started(dag(mesh, hold, backlog=BacklogConfig(policy="fifo", depth=2, drop=drop)))
    given.commit(1)
    hold.wait_until_held(1)
    for version in (2, 3, 4, 5):
        given.commit(version)
    hold.release(1)
    result.wait_for(1, 2, 3, 4, 5)
    assert hold.started == run
    assert mesh.losses.as_dict() == {"dag": {"backlog": 2}}


@pytest.mark.parametrize("workers", [1, 2, 8])
def test_block_runs_every_frame_in_order(workers, topic, started):
    mesh = DataMesh(window_capacity=4)
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    started(dag(mesh, same, same, backlog=BLOCK, workers=workers, in_flight=3))
    for version in range(200):
        given.commit(version, version)
    result.wait_for(*range(200))
    assert result.events == list(range(200))
    assert mesh.losses.as_dict() == {}


def test_a_chain_that_blocks_runs_every_frame_with_one_worker_each(topic, started):
    mesh = DataMesh(window_capacity=4)
    chain = [dag(mesh, same, name=f"c{i}", topics=(f"t{i}", f"t{i + 1}"), backlog=BLOCK, workers=1) for i in range(4)]
    given, result = topic(mesh.window("t0")), topic(mesh.window("t4"))
    started(*chain)
    for version in range(100):
        given.commit(version, version)
    result.wait_for(*range(100))
    assert result.entries == {version: version for version in range(100)}


def test_frames_in_flight_are_as_many_as_allowed(topic, started):
    """Frames 1 and 2 are in the graph at once, 3 is not, although there are workers enough."""
    mesh = DataMesh()
    first, second = Holding(), Holding(1, 3)
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    started(dag(mesh, first, second, workers=8, in_flight=2))
    for version in (1, 2, 3):
        given.commit(version)
    second.wait_until_held(1)
    assert 3 not in first.started
    second.release(1)
    second.wait_until_held(3)
    second.release(3)
    result.wait_for(1, 2, 3)
    assert first.started == second.started == [1, 2, 3]


def test_a_monotonic_graph_has_one_frame_at_a_time_whatever_is_configured(topic, started):
    mesh = DataMesh()
    events = []

    def note(where):
        return lambda trigger, value: events.append((trigger.version, where)) or value

    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    acts = [note(where) for where in "abc"]
    started(dag(mesh, *acts, kind=MonotonicDagComponent, workers=8, in_flight=8))
    for version in range(20):
        given.commit(version)
    result.wait_for(*range(20))
    assert events == [(version, where) for version in range(20) for where in "abc"]


def test_a_monotonic_graph_drops_what_is_not_newer_than_the_last_started(topic, started, caplog):
    """Also when the last one failed."""
    mesh = DataMesh()
    ran = []
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    act = failing_at(30)
    started(dag(mesh, lambda t, v: ran.append(t.version) or act(t, v), kind=MonotonicDagComponent))
    for version, policy in ((10, None), (30, None), (20, CommitPolicy.OVERWRITE), (40, None)):
        given.commit(version, policy=policy)
        result.wait_for(version)
    assert ran == [10, 30, 40]
    assert mesh.losses.as_dict() == {
        "dag": {"out_of_order": 1},
        "dag.v0": {"failed": 1},
        "input": {"overwritten": 1},
    }


def test_a_new_epoch_takes_a_whole_chain_back_to_lower_versions(topic, started):
    """Also those that keep order: a recording that loops is run again, and nothing of the first pass is lost."""
    mesh = DataMesh()
    first = dag(mesh, same, name="first", topics=("a", "b"), backlog=BLOCK, in_flight=2)
    second = doubler(mesh, name="second", topics=("b", "c"), backlog=BLOCK)
    third = dag(mesh, same, same, name="third", topics=("c", "d"), kind=MonotonicDagComponent, backlog=BLOCK)
    a, d = topic(mesh.window("a")), topic(mesh.window("d"))
    started(first, second, third)
    for _ in range(3):
        for version in range(20):
            a.commit(version, version)
        a.new_epoch()
    assert d.wait_for_orders((2, 19))
    assert d.orders == [(epoch, version) for epoch in range(3) for version in range(20)]
    assert mesh.losses.as_dict() == {}


def test_a_version_that_comes_again_does_not_run_again(topic, started):
    """Replaced, inserted after all, or in the settled: once per component and version."""
    mesh = DataMesh()
    hold = Holding()
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    started(dag(mesh, hold))
    for version in (10, 20, 30):
        given.commit(version, version)
    given.commit(20, "again", equal=EqualVersion.REPLACE)
    given.commit(5, "late", CommitPolicy.INSERT_SORTED, triggers=True)
    given.commit(30, "again", equal=EqualVersion.REPLACE)
    given.commit(40, 40)
    result.wait_for(5, 10, 20, 30, 40)
    assert sorted(hold.started) == [5, 10, 20, 30, 40]
    assert result.window.snapshot().versions == (10, 20, 30, 40)
    assert mesh.losses.as_dict() == {"input": {"replaced": 2}, "output": {"out_of_order": 1}}


def test_a_trigger_evicted_before_it_ran_is_counted_and_settled(topic, started):
    mesh = DataMesh(window_capacity=1)
    hold = Holding(1)
    given, result = topic(mesh.window("input")), topic(mesh.window("output", 8))
    started(dag(mesh, hold))
    given.commit(1)
    hold.wait_until_held(1)
    given.commit(2)
    given.commit(3)
    hold.release(1)
    result.wait_for(1, 2, 3)
    assert hold.started == [1, 3]
    assert result.settled == [2]
    assert mesh.losses.as_dict() == {"dag": {"trigger evicted": 1}}


def test_a_late_insertion_into_the_history_runs_nothing_and_is_settled(topic, started):
    """Whoever waits for the version learns that nothing will come of it."""
    mesh = DataMesh()
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    started(dag(mesh, same))
    given.commit(10, "a")
    given.commit(30, "b")
    assert given.commit(20, "late", CommitPolicy.INSERT_SORTED) is Status.OK
    given.commit(40, "c")
    result.wait_for(10, 20, 30, 40)
    assert result.entries == {10: "a", 30: "b", 40: "c"}
    assert result.settled == [20]


def test_stop_finishes_what_waits(topic):
    mesh = DataMesh()
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    component = dag(mesh, same, in_flight=2)
    component.start()
    for version in range(30):
        given.commit(version, version)
    component.stop()
    assert result.events == list(range(30))


@pytest.mark.parametrize("workers", [1, 2])
def test_stop_frees_a_producer_that_is_blocked(workers, topic):
    """Every frame that was committed ran, or was counted and settled."""
    mesh = DataMesh()
    hold = Holding(1)
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    component = dag(mesh, hold, backlog=BLOCK, workers=workers)
    component.start()
    producer = threading.Thread(target=lambda: [given.commit(version) for version in range(1, 11)])
    producer.start()
    hold.wait_until_held(1)
    stopper = threading.Thread(target=component.stop)
    stopper.start()
    producer.join(WAIT)
    assert not producer.is_alive()
    hold.release(1)
    stopper.join(WAIT)
    assert not stopper.is_alive()
    assert sorted(result.events) == list(range(1, 11))
    assert len(result.settled) == mesh.losses["dag", "shutdown"] > 0


def test_commits_after_the_stop_are_counted_and_settled(topic):
    mesh = DataMesh()
    given, result = topic(mesh.window("number")), topic(mesh.window("double"))
    component = doubler(mesh)
    component.start()
    component.stop()
    given.commit(1, 1)
    assert result.settled == [1]
    assert mesh.losses.as_dict() == {"doubler": {"shutdown": 1}}


def test_a_chain_that_was_stopped_still_settles_to_its_end(topic):
    mesh = DataMesh()
    chain = [doubler(mesh, name=f"c{i}", topics=(f"t{i}", f"t{i + 1}")) for i in range(3)]
    given, result = topic(mesh.window("t0")), topic(mesh.window("t3"))
    for component in reversed(chain):
        component.start()
    for component in chain:
        component.stop()
    given.commit(1, 1)
    assert result.settled == [1]
    assert mesh.losses.as_dict() == {"c0": {"shutdown": 1}}


def test_stop_closes_all_processors_even_when_one_fails(caplog):
    closed = []

    def close(name):
        closed.append(name)
        if name == "v0":
            raise OSError("device busy")

    component = dag(DataMesh(), same, same, close=close)
    component.start()
    component.stop()
    assert closed == ["v0", "v1"]
    assert "dag.v0 failed to close" in caplog.text


def test_names_of_the_configuration_do_not_shadow_the_component():
    component = DagComponent("dag")
    component.add_handles(["context", "start"], ["settle", "name"])
    assert component.name == "dag"
    assert callable(component.start)
    assert callable(component.settle)
    assert set(component.inputs) == {"context", "start"}


def test_a_plain_class_becomes_a_component():
    calls = []

    class Plain:
        def __init__(self, rate):
            self.rate = rate

        def start(self):
            calls.append("start")

    component = GenericComponent("plain", Plain, {"rate": 10})
    component.start()
    component.stop()
    assert component.instance.rate == 10
    assert calls == ["start"]


def test_a_data_process_must_say_what_it_does():
    with pytest.raises(NotImplementedError):
        super(Doubler, Doubler("d")).process(Trigger(1))


def test_a_component_without_a_trigger_starts_and_stops():
    for component in (Component("base"), Doubler("untriggered")):
        component.start()
        component.stop()
