"""Components whose frames come faster than they run."""

import pytest
from component_parts import BLOCK, Holding, dag, same

from warploom.dag import BacklogConfig
from warploom.datamesh import DataMesh

pytestmark = pytest.mark.usefixtures("no_thread_left")


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
