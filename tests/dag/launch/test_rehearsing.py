"""A rehearsal goes the way of a datum, and leaves nothing but itself."""

import threading

from warploom.dag.launch import rehearsing
from warploom.datamesh import CURRENT_EPOCH, CommitPolicy, Entry, Status


def commit(window, version, value):
    return window.commit(CommitPolicy.OVERWRITE, Entry(version, value, 1, 2, 0))


def test_each_commit_is_read_by_a_component_in_the_thread_that_commits(monkeypatch):
    ran = []
    process = rehearsing._Rehearsal.process

    def watched(component, trigger):
        ran.append((trigger.version, threading.current_thread(), process(component, trigger)))

    monkeypatch.setattr(rehearsing._Rehearsal, "process", watched)
    window = rehearsing.rehearsal()
    for version in (1, 2, 3):
        assert commit(window, version, "value") is Status.OK
    here = threading.current_thread()
    assert ran == [(version, here, Status.OK) for version in (1, 2, 3)]


def test_it_keeps_no_more_than_the_last_and_loses_nothing():
    window = rehearsing.rehearsal()
    for version in range(10):
        commit(window, version, version)
    assert list(window.snapshot(CURRENT_EPOCH)) == [9]
    assert window.losses.as_dict() == {}


def test_two_know_nothing_of_each_other():
    first, second = rehearsing.rehearsal(), rehearsing.rehearsal()
    commit(first, 1, 1)
    assert len(second.snapshot()) == 0
