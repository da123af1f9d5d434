"""The kinds of components, each on a mesh, fed and watched from outside."""

import threading
import time

import pytest
from graph_parts import Call, Doubler

from warploom.dag import (
    BacklogConfig,
    CommitDagProcessor,
    Component,
    DagComponent,
    GenericComponent,
    In,
    MonotonicDagComponent,
    Out,
    Processor,
    Trigger,
    Vertex,
)
from warploom.datamesh import CommitPolicy, DataMesh, Entry, EqualVersion, Input, ManualClock, Miss, Outcome, Status

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


def doubler(
    mesh, context=None, backlog=FIFO, name="doubler", topics=("number", "double"), hand_off="thread", trigger="number"
):
    component = Doubler(name, context)
    component.bind(mesh, {"number": topics[0], "double": topics[1]})
    component.set_trigger(trigger, backlog, hand_off)
    return component


def joining(mesh, trigger, backlog=FIFO, hand_off="thread", prefix=""):
    """A graph that joins the two inputs that trigger it."""
    component = DagComponent("join")
    component.add_handles(["left", "right"], ["output"])
    component.bind(mesh, {name: f"{prefix} {name}".strip() for name in ("left", "right", "output")})
    join, commit = JoinOptional(), CommitDagProcessor()
    commit.component_outputs = component.outputs
    commit.init(CommitDagProcessor.Config(output="output"))
    vertices = [
        Vertex("join", join, {"left": "left", "right": "right"}, {"joined": "joined"}),
        Vertex("commit", commit, {"value": "joined"}, {}),
    ]
    component.set_graph(vertices, workers=1, in_flight=1)
    component.set_trigger(trigger, backlog, hand_off)
    return component


class JoinOptional(Processor):
    left: In[object] = In(optional=True)
    right: In[object] = In(optional=True)
    joined: Out[object]

    def process(self, trigger):
        self.joined.value = tuple(port.value if port.present else None for port in (self.left, self.right))
        return Status.OK


class Tick(Call):
    """Takes its value, or None where time triggers."""

    value: In[object] = In(optional=True)

    def process(self, trigger):
        value = self.value.value if self.value.present else None
        self.result.value = self.context[self.name](trigger, value)
        return Status.OK


def dag(
    mesh,
    *acts,
    kind=DagComponent,
    backlog=FIFO,
    topics=("input", "output"),
    workers=2,
    in_flight=1,
    hand_off="thread",
    trigger="input",
    reads=("input",),
    **calls,
):
    """A chain of vertices `v0`, `v1` … that do `acts`, and one that commits the result of the last."""
    component = kind(calls.pop("name", "dag"))
    component.add_handles(["input"], ["output"])
    component.bind(mesh, {"input": topics[0], "output": topics[1]})
    vertices = []
    for number, act in enumerate(acts):
        processor = Call() if reads else Tick()
        processor.name, processor.context = f"v{number}", {f"v{number}": act, **calls}
        source = f"v{number - 1}" if number else "input"
        vertices.append(Vertex(processor.name, processor, {"value": source}, {"result": processor.name}))
    commit, config = CommitDagProcessor(), CommitDagProcessor.Config(output="output")
    commit.component_outputs = component.outputs
    commit.init(config)
    vertices.append(Vertex("commit", commit, {"value": f"v{len(acts) - 1}"}, {}, config=config))
    component.set_graph(vertices, workers=workers, in_flight=in_flight)
    component.set_trigger(trigger, backlog, hand_off)
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


@pytest.mark.parametrize("hand_off", ["thread", "inline"])
@pytest.mark.parametrize("kind", ["data", "dag", "monotonic"])
def test_a_component_starts_again_after_a_stop(kind, hand_off, topic):
    """Its processors are initialised and closed each time; commits in between are counted and settled."""
    mesh, calls = DataMesh(), []
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    if kind == "data":
        component = doubler(mesh, topics=("input", "output"), hand_off=hand_off)
    else:
        kinds = {"dag": DagComponent, "monotonic": MonotonicDagComponent}
        component = dag(mesh, same, kind=kinds[kind], hand_off=hand_off, in_flight=3, close=calls.append)
    for cycle in range(5):
        component.start()
        for version in range(cycle * 10, cycle * 10 + 5):
            given.commit(version, version)
        component.stop()
        given.commit(cycle * 10 + 5, 0)
    assert result.orders == [(0, cycle * 10 + number) for cycle in range(5) for number in range(6)]
    assert sorted(result.settled) == [5, 15, 25, 35, 45]
    assert mesh.losses.as_dict() == {component.name: {"shutdown": 5}}
    assert calls == ([] if kind == "data" else ["v0"] * 5)


def test_processors_are_initialised_again_before_a_second_start():
    calls = []

    class Opening(Call):
        def init(self, config):
            calls.append(("init", config))

        def close(self):
            calls.append("close")

    component = DagComponent("dag")
    component.add_handles(["input"], [])
    component.bind(DataMesh(), {"input": "input"})
    processor = Opening()
    processor.init("config")
    component.set_graph([Vertex("v", processor, {"value": "input"}, {}, config="config")], workers=1, in_flight=1)
    component.set_trigger("input", FIFO)
    for _ in range(2):
        component.start()
        component.stop()
    assert calls == [("init", "config"), "close", ("init", "config"), "close"]


@pytest.mark.parametrize("kind", ["data", "dag"])
def test_inline_the_committing_thread_runs_the_component(kind, topic, started):
    mesh, threads = DataMesh(), []
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))

    def act(trigger, value):
        threads.append(threading.current_thread())
        return value

    if kind == "data":
        component = doubler(mesh, topics=("input", "output"), hand_off="inline")
        process = component.process
        component.process = lambda trigger: (act(trigger, 0), process(trigger))[1]
    else:
        component = dag(mesh, act, act, hand_off="inline", workers=1)
    started(component)
    for version in (1, 2, 3):
        given.commit(version, version)
        if kind == "data":
            assert version in result.entries, "it is done when the commit comes back"
    result.wait_for(1, 2, 3)
    assert threading.current_thread() in threads
    if kind == "data":
        assert set(threads) == {threading.current_thread()}
    assert result.settled == []


def test_inline_two_threads_that_commit_do_not_run_a_component_at_once(topic, started):
    """What comes while it runs is taken up by the thread that runs it; nothing is lost, nothing runs twice."""
    mesh, inside, most = DataMesh(window_capacity=500), [], []
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    component = doubler(
        mesh, topics=("input", "output"), hand_off="inline", backlog=BacklogConfig(policy="fifo", depth=400)
    )
    process = component.process

    def watched(trigger):
        inside.append(1)
        most.append(len(inside))
        process(trigger)
        inside.pop()
        return Status.OK

    component.process = watched
    started(component)
    counter = iter(range(400))
    lock = threading.Lock()

    def commit():
        while True:
            with lock:
                version = next(counter, None)
                if version is None:
                    return
                given.window.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, Entry(version, version, 0, 0))

    threads = [threading.Thread(target=commit) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(WAIT)
    result.wait_for(*range(400))
    assert set(most) == {1}
    assert mesh.losses.as_dict() == {}


def test_inline_a_chain_runs_through_without_deep_recursion(topic):
    """A burst behind a slow frame is served in a loop, not each frame within the one before it."""
    mesh = DataMesh(window_capacity=600)
    hold = Holding(0)
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    component = dag(mesh, hold, hand_off="inline", backlog=BacklogConfig(policy="fifo", depth=500), workers=1)
    component.start()
    first = threading.Thread(target=given.commit, args=(0,))
    first.start()
    hold.wait_until_held(0)
    for version in range(1, 500):
        given.commit(version, version)
    hold.release(0)
    first.join(WAIT)
    component.stop()
    assert result.events == list(range(500))
    assert mesh.losses.as_dict() == {}


def test_any_runs_for_each_input_with_the_data_of_the_one_that_triggered(topic, started):
    mesh = DataMesh()
    component = joining(mesh, {"any": ["left", "right"]})
    left, right, result = (topic(mesh.window(name)) for name in ("left", "right", "output"))
    started(component)
    left.commit(10, "l")
    result.wait_for(10)
    right.commit(20, "r")
    result.wait_for(20)
    left.commit(20, "l")
    assert result.entries == {10: ("l", None), 20: (None, "r")}
    assert mesh.losses.as_dict() == {}


def test_all_runs_with_the_data_of_all_inputs_and_settles_what_stays_incomplete(topic, started):
    mesh = DataMesh(window_capacity=8)
    component = joining(mesh, {"all": ["left", "right"], "tolerance_ms": 2e-6})
    left, right, result = (topic(mesh.window(name)) for name in ("left", "right", "output"))
    started(component)
    for version in (10, 20, 30):
        left.commit(version, f"l{version}")
    right.commit(12, "r12")
    right.commit(29, "r29")
    result.wait_for(10, 20, 30)
    assert result.entries == {10: ("l10", "r12"), 30: ("l30", "r29")}
    assert result.settled == [20]
    assert mesh.losses.as_dict() == {"join": {"incomplete": 1}}


@pytest.mark.parametrize("kind", ["data", "dag"])
def test_a_component_runs_by_time_on_the_clock(kind, topic):
    clock = ManualClock(1_000_000_000)
    mesh, ran = DataMesh(clock=clock), []
    result = topic(mesh.window("output"))
    if kind == "data":
        component = doubler(mesh, topics=("input", "output"), trigger={"period_ms": 100})
        component.process = lambda trigger: ran.append((trigger.epoch, trigger.version)) or Status.OK
    else:
        component = dag(mesh, lambda t, v: ran.append((t.epoch, t.version)), trigger={"period_ms": 100}, reads=())
    component.start()
    expected = []
    for number in range(1, 4):
        clock.advance(100_000_000)
        expected.append((0, 1_000_000_000 + number * 100_000_000))
        assert result.wait_for_orders(expected[-1])
    clock.step(-2_000_000_000 + 700_000_000)
    clock.advance(100_000_000)
    assert result.wait_for_orders((1, 100_000_000))
    component.stop()
    assert ran == [*expected, (1, 100_000_000)]
    clock.advance(1_000_000_000)
    assert len(ran) == 4


def test_by_the_machines_clock_a_component_ticks_stops_and_leaves_no_thread(topic):
    mesh, ran = DataMesh(), []
    result = topic(mesh.window("output"))
    component = dag(mesh, lambda t, v: ran.append(t.version), trigger={"period_ms": 2}, reads=())
    for _ in range(2):
        component.start()
        seen = len(result.entries) + 3
        until = time.monotonic() + WAIT
        while len(result.entries) < seen and time.monotonic() < until:
            time.sleep(0.001)
        component.stop()
    assert ran == sorted(set(ran))
    assert len(ran) >= 6
    assert all(version > 1_700_000_000 * 10**9 for version in ran), "versions are the time of day"


@pytest.mark.parametrize(("overrun", "expected"), [("skip", [1, 5]), ("coalesce", [1, 4, 5])])
def test_a_component_slower_than_its_ticks_skips_or_coalesces_and_never_bursts(overrun, expected, topic):
    clock = ManualClock()
    mesh = DataMesh(clock=clock)
    hold = Holding(100_000_000)
    result = topic(mesh.window("output"))
    component = dag(mesh, hold, trigger={"period_ms": 100, "overrun": overrun}, reads=())
    component.start()
    clock.advance(100_000_000)
    hold.wait_until_held(100_000_000)
    clock.advance(300_000_000)
    hold.release(100_000_000)
    result.wait_for(*(number * 100_000_000 for number in range(1, 5)))
    while component._is_busy():
        threading.Event().wait(0.001)
    clock.advance(100_000_000)
    result.wait_for(500_000_000)
    component.stop()
    assert hold.started == [number * 100_000_000 for number in expected]
    lost = {"overrun": 3} if overrun == "skip" else {"backlog": 2}
    assert mesh.losses.as_dict() == {"dag": lost}


def test_what_hangs_at_the_stop_is_named_counted_and_left_to_itself(topic, caplog, monkeypatch):
    """The other vertices are closed, what waits is settled, and the component does not start again meanwhile."""
    monkeypatch.setattr(DagComponent, "stop_timeout_s", 0.05)
    mesh, closed = DataMesh(), []
    hold = Holding(1)
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    component = dag(mesh, same, hold, close=closed.append)
    component.start()
    for version in (1, 2):
        given.commit(version)
    hold.wait_until_held(1)
    workers = list(component._engine._threads)
    component.stop()
    assert "dag: v1 hangs at version 1 since the stop" in caplog.text
    assert mesh.losses.as_dict() == {"dag": {"hung": 1, "shutdown": 1}}
    assert result.settled == [2]
    assert closed == ["v0"]
    with pytest.raises(RuntimeError, match=r"dag cannot start again: \{'v1': 1\} still runs"):
        component.start()
    hold.release(1)
    for worker in workers:
        worker.join(WAIT)


@pytest.mark.parametrize("last", ["settled", "out of order", "evicted"])
def test_a_stop_does_not_wait_for_what_does_not_run(last, topic, monkeypatch):
    """What waits behind the last frame is settled, and the stop comes back when that is done."""
    monkeypatch.setattr(DagComponent, "stop_timeout_s", 3600.0)
    mesh = DataMesh(window_capacity=1 if last == "evicted" else 8)
    hold = Holding(10)
    given, result = topic(mesh.window("input")), topic(mesh.window("output", 8))
    component = dag(mesh, hold, kind=MonotonicDagComponent)
    component.start()
    given.commit(10)
    hold.wait_until_held(10)
    if last == "settled":
        given.settle(20)
    elif last == "out of order":
        given.commit(5, policy=CommitPolicy.OVERWRITE)
    else:
        given.commit(20)
        given.commit(30)
        given.commit(40)
    stopper = threading.Thread(target=component.stop, daemon=True)
    stopper.start()
    hold.release(10)
    stopper.join(WAIT)
    assert not stopper.is_alive()
    expected = {"settled": {10, 20}, "out of order": {5, 10}, "evicted": {10, 20, 30, 40}}[last]
    assert set(result.events) == expected


def test_a_frame_that_cannot_start_is_counted_and_settled_and_the_next_runs(topic, started, caplog):
    """The device failed while it wrote what triggered."""

    class Broken:
        stream = None

        def synchronize(self):
            raise OSError("device lost")

    mesh = DataMesh()
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    started(dag(mesh, same))
    given.window.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, Entry(1, "a", 0, 0, completion=Broken()))
    given.commit(2, "b")
    result.wait_for(1, 2)
    assert result.entries == {2: "b"}
    assert mesh.losses.as_dict() == {"dag": {"failed": 1}}
    assert "device lost" in caplog.text


def test_what_hung_at_a_stop_and_came_back_does_not_go_on_and_the_component_starts_again(topic, monkeypatch):
    monkeypatch.setattr(DagComponent, "stop_timeout_s", 0.05)
    mesh, after = DataMesh(), []
    hold = Holding(1)
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    component = dag(mesh, hold, lambda trigger, value: after.append(trigger.version))
    component.start()
    given.commit(1)
    hold.wait_until_held(1)
    workers = list(component._engine._threads)
    component.stop()
    hold.release(1)
    for worker in workers:
        worker.join(WAIT)
    assert after == []
    component.start()
    given.commit(2)
    result.wait_for(2)
    component.stop()
    assert after == [2]


def test_all_inline_and_blocking_takes_several_versions_that_one_commit_completes(topic, started):
    """The backlog has room for one, and the thread that completes three runs them itself."""
    mesh = DataMesh()
    for hand_off in ("inline", "thread"):
        component = joining(mesh, {"all": ["left", "right"], "tolerance_ms": 5e-6}, BLOCK, hand_off, hand_off)
        started(component)
        left, right, result = (topic(mesh.window(f"{hand_off} {name}")) for name in ("left", "right", "output"))
        for version in (10, 12, 14):
            left.commit(version, version)
        assert result.events == []
        right.commit(13, "r")
        result.wait_for(10, 12, 14)
        assert result.entries == {10: (10, "r"), 12: (12, "r"), 14: (14, "r")}


def test_a_data_process_that_hangs_at_the_stop_is_left_to_itself(topic, monkeypatch):
    monkeypatch.setattr(Doubler, "stop_timeout_s", 0.05)
    mesh, hang, reached = DataMesh(), threading.Event(), threading.Event()
    given = topic(mesh.window("number"))
    component = doubler(mesh)
    component.process = lambda trigger: (reached.set(), hang.wait(WAIT))[1]
    component.start()
    given.commit(1, 1)
    assert reached.wait(WAIT)
    thread = component._thread
    component.stop()
    assert mesh.losses.as_dict() == {"doubler": {"hung": 1}}
    with pytest.raises(RuntimeError, match="cannot start again: it hangs at version 1"):
        component.start()
    hang.set()
    thread.join(WAIT)


def test_a_data_process_may_wait_in_its_thread_and_a_stop_ends_that(topic):
    mesh, outcomes, waits = DataMesh(), [], threading.Event()
    given, side = topic(mesh.window("number")), topic(mesh.window("side"))
    component = doubler(mesh)
    component.inputs["side"] = Input()
    component.inputs["side"].bind("side", mesh.window("side"))

    def process(trigger):
        waits.set()
        waiting = component.inputs["side"].wait(trigger.version)
        outcomes.append((waiting.outcome, waiting.entry and waiting.entry.value))
        return Status.OK

    component.process = process
    for cycle in range(2):
        component.start()
        given.commit(cycle * 10 + 1)
        assert waits.wait(WAIT)
        side.commit(cycle * 10 + 1, "there")
        given.commit(cycle * 10 + 2)
        while len(outcomes) < cycle * 2 + 1:
            threading.Event().wait(0.001)
        component.stop()
    assert outcomes == [(Outcome.FOUND, "there"), (Outcome.SHUTDOWN, None)] * 2


def test_a_producer_that_comes_back_at_a_lower_version_is_followed_by_the_whole_chain(topic, started):
    mesh = DataMesh()
    ran = []
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    started(dag(mesh, lambda t, v: ran.append((t.epoch, t.version)), kind=MonotonicDagComponent))
    for version in (10, 20, 5, 6):
        given.commit(version, policy=CommitPolicy.FORCE_NEW_EPOCH)
        assert result.wait_for_orders((int(version < 10), version))
    assert ran == [(0, 10), (0, 20), (1, 5), (1, 6)]
    assert mesh.losses.as_dict() == {}


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
