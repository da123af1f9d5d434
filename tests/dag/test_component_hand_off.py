"""Who runs a component: a thread of its own, or the one that commits."""

import threading

import pytest
from component_parts import BLOCK, FIFO, WAIT, Holding, dag, doubler, same

from warploom.dag import BacklogConfig
from warploom.datamesh import CommitPolicy, DataMesh, Entry, Status

pytestmark = pytest.mark.usefixtures("no_thread_left")


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


@pytest.mark.parametrize("backlog", [FIFO, BLOCK], ids=["fifo", "block"])
@pytest.mark.parametrize("hand_off", ["inline", "thread"])
def test_what_is_committed_while_a_graph_stops_is_run_or_settled(hand_off, backlog, topic):
    mesh = DataMesh(window_capacity=64)
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    component = dag(mesh, same, hand_off=hand_off, backlog=backlog, workers=2, in_flight=2)
    component.stop_timeout_s = WAIT
    stops, committed = 15, []

    def commit():
        while not ended.is_set():
            committed.append(len(committed))
            given.commit(committed[-1], committed[-1])

    for number in range(stops):
        ended = threading.Event()
        component.start()
        producer = threading.Thread(target=commit)
        producer.start()
        result.wait_for(len(committed) + number % 7)
        component.stop()
        ended.set()
        producer.join(WAIT)
    losses = mesh.losses.as_dict().get("dag", {})
    assert sorted(result.events) == committed
    assert len(result.settled) == sum(losses.values())
    assert set(losses) <= {"shutdown", "backlog", "trigger evicted"}, "the producer runs on, over what waits"
    assert sorted(result.entries) == list(result.entries), "frames enter in their order"


def test_a_frame_that_need_not_wait_is_told_of_as_taken_and_one_that_cannot_start_is_settled(topic, started):
    mesh, taken = DataMesh(), []
    given, result = topic(mesh.window("input")), topic(mesh.window("output"))
    component = dag(mesh, same)

    def on_taken(trigger):
        taken.append(trigger.version)
        if trigger.version == 2:
            raise OSError("it cannot be noted")

    component.backlog.on_taken = on_taken
    started(component)
    for version in (1, 2, 3):
        given.commit(version, version)
        result.wait_for(version)
    assert taken == [1, 2, 3]
    assert result.settled == [2]
    assert mesh.losses.as_dict() == {"dag": {"failed": 1}}
