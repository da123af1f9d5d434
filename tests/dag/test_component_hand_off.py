"""Who runs a component: a thread of its own, or the one that commits."""

import threading

import pytest
from component_parts import WAIT, Holding, dag, doubler

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
