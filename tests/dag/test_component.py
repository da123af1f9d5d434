"""The kinds of components, each on a mesh, fed and watched from outside."""

import pytest
from component_parts import BLOCK, Holding, dag, doubler, failing_at, same
from graph_parts import Doubler

from warploom.dag import BacklogConfig, DagComponent, GenericComponent, MonotonicDagComponent, Trigger
from warploom.datamesh import CommitPolicy, DataMesh, Entry, EqualVersion, ManualClock, Miss, Status

pytestmark = pytest.mark.usefixtures("no_thread_left")


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
    assert {one.name for one in caplog.records} == {"warploom.component.doubler"}


def test_how_long_a_data_process_waited_and_ran_is_told(topic, started, caplog):
    """By the mesh's clock, failed runs too; what is told raising costs nothing."""
    clock = ManualClock()
    mesh = DataMesh(clock=clock)
    number, double = topic(mesh.window("number")), topic(mesh.window("double"))
    component, told = doubler(mesh, ("fail", 2)), []
    process = component.process

    def takes_five(trigger):
        clock.advance(5)
        return process(trigger)

    def tell(timing):
        told.append(timing)
        raise RuntimeError("whoever watches fails")

    component.process, component.on_timing = takes_five, tell
    started(component)
    for version in (1, 2, 3):
        number.commit(version, version)
        double.wait_for(version)
        clock.advance(100)
    whole = [(t.component, t.vertex, t.version, t.ready_ns, t.start_ns, t.end_ns, t.epoch) for t in told]
    assert whole == [("doubler", "process", n, 105 * (n - 1), 105 * (n - 1), 105 * (n - 1) + 5, 0) for n in (1, 2, 3)]
    assert [t.status for t in told] == [Status.OK, Status.FAILED, Status.OK]
    assert double.entries == {1: 2, 3: 6}


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


def test_what_does_not_fit_the_component_is_refused_by_name():
    mesh = DataMesh()
    component = Doubler("doubler")
    with pytest.raises(ValueError, match="doubler: 'double' has no topic; topics are given for: number"):
        component.bind(mesh, {"number": "number"})
    component.bind(mesh, {"number": "number", "double": "double"})
    for trigger in ("numbr", {"all": ["number", "numbr"]}):
        with pytest.raises(ValueError, match="doubler has no input 'numbr'; it has: number"):
            component.set_trigger(trigger, BacklogConfig())
    with pytest.raises(ValueError, match="hand_off must be thread or inline, not 'direct'"):
        component.set_trigger("number", BacklogConfig(), "direct")
