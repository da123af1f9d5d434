"""Stops of components, what hangs at one, and starts after it."""

import threading

import pytest
from component_parts import BLOCK, FIFO, WAIT, Holding, dag, doubler, same
from graph_parts import Call, Doubler

from warploom.dag import Component, DagComponent, MonotonicDagComponent, Vertex
from warploom.datamesh import CommitPolicy, DataMesh, Input, Outcome, Status

pytestmark = pytest.mark.usefixtures("no_thread_left")


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


def test_a_component_without_a_trigger_starts_and_stops():
    for component in (Component("base"), Doubler("untriggered")):
        component.start()
        component.stop()
