"""Windows and snapshots: history, misses, policies, threads; checked against a plain dictionary."""

import threading
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from warploom.datamesh import CommitPolicy, Entry, LossCounters, Miss, Status, Window

DISCARD, INSERT = CommitPolicy.DISCARD_OUT_OF_ORDER, CommitPolicy.INSERT_SORTED


def entry(version, value=None):
    return Entry(version, f"v{version}" if value is None else value, version, version)


def filled(versions, capacity=8, policy=DISCARD, losses=None):
    window = Window("topic", capacity, losses)
    for version in versions:
        window.commit(policy, entry(version))
    return window


def test_a_snapshot_of_an_empty_window_holds_nothing():
    snapshot = Window("topic").snapshot()
    assert len(snapshot) == 0
    assert list(snapshot) == []
    assert snapshot.version_index(0) == snapshot.before(5) == snapshot.after(5) == snapshot.nearest(5, 10) == -1
    assert snapshot.miss(0) is Miss.FUTURE
    with pytest.raises(LookupError, match="the window is empty"):
        snapshot.last()


def test_a_snapshot_is_read_by_version():
    snapshot = filled([10, 20, 30]).snapshot()
    assert snapshot.versions == (10, 20, 30)
    assert list(snapshot) == ["v10", "v20", "v30"]
    assert snapshot[snapshot.version_index(20)] == "v20"
    assert snapshot.entry(1) == entry(20)
    assert snapshot.last() == "v30"
    assert [snapshot.version_index(v) for v in (9, 10, 11, 30, 31)] == [-1, 0, -1, 2, -1]


def test_before_and_after_are_strict():
    snapshot = filled([10, 20, 30]).snapshot()
    assert [snapshot.before(v) for v in (10, 11, 20, 31)] == [-1, 0, 0, 2]
    assert [snapshot.after(v) for v in (9, 10, 29, 30)] == [0, 1, 2, -1]


@pytest.mark.parametrize(
    ("version", "max_age", "index"),
    [(10, 0, 0), (14, 4, 0), (14, 3, -1), (15, 5, 0), (16, 5, 1), (99, 68, -1), (99, 69, 2), (0, 10, 0)],
)
def test_nearest_is_bounded_in_age_and_takes_the_older_of_two(version, max_age, index):
    assert filled([10, 20, 30]).snapshot().nearest(version, max_age) == index


def test_the_index_of_a_miss_reads_nothing():
    """-1 is not Python's "last": a datum of another frame must not come of a version that is not there."""
    snapshot = filled([10, 20]).snapshot()
    with pytest.raises(IndexError, match="not there"):
        snapshot[snapshot.version_index(15)]
    with pytest.raises(IndexError):
        snapshot[2]


def test_overflow_evicts_the_lowest_version():
    snapshot = filled([1, 2, 3, 4], capacity=2).snapshot()
    assert snapshot.versions == (3, 4)
    assert snapshot.miss(2) is Miss.EVICTED
    assert snapshot.miss(1) is Miss.EVICTED


def test_a_window_of_one_keeps_the_newest():
    window = filled([1, 2, 3], capacity=1)
    assert window.snapshot().versions == (3,)
    assert window.commit(INSERT, entry(2)) is Status.OUT_OF_ORDER
    assert window.commit(DISCARD, entry(3)) is Status.DUPLICATE
    assert window.snapshot().versions == (3,)


@pytest.mark.parametrize("capacity", [0, -1])
def test_a_window_without_room_is_refused(capacity):
    with pytest.raises(ValueError, match=r"capacity of window 'topic' must be >= 1"):
        Window("topic", capacity)


def test_every_miss_has_its_reason():
    window = filled([10, 20, 30], capacity=2)
    window.settle(25)
    window.settle(40)
    snapshot = window.snapshot()
    reasons = {version: snapshot.miss(version) for version in (10, 5, 22, 25, 30, 35, 40)}
    assert reasons == {
        10: Miss.EVICTED,
        5: Miss.EVICTED,
        22: Miss.NEVER,
        25: Miss.SETTLED_EMPTY,
        30: None,
        35: Miss.FUTURE,
        40: Miss.SETTLED_EMPTY,
    }


@pytest.mark.parametrize(
    ("policy", "version", "status", "versions", "triggers"),
    [
        (DISCARD, 15, Status.OUT_OF_ORDER, (10, 20), False),
        (DISCARD, 5, Status.OUT_OF_ORDER, (10, 20), False),
        (DISCARD, 10, Status.DUPLICATE, (10, 20), False),
        (DISCARD, 20, Status.DUPLICATE, (10, 20), False),
        (DISCARD, 25, Status.OK, (10, 20, 25), True),
        (INSERT, 15, Status.OK, (10, 15, 20), False),
        (INSERT, 5, Status.OK, (5, 10, 20), False),
        (INSERT, 10, Status.DUPLICATE, (10, 20), False),
        (INSERT, 20, Status.DUPLICATE, (10, 20), False),
        (INSERT, 25, Status.OK, (10, 20, 25), True),
    ],
)
def test_policies_on_older_equal_and_newer(policy, version, status, versions, triggers):
    """What is not kept is counted; only a commit of the newest version triggers."""
    losses = LossCounters()
    window = filled([10, 20], losses=losses)
    told = []
    window.subscribe(lambda e: told.append(e.version), told.append)
    assert window.commit(policy, entry(version, "late")) is status
    snapshot = window.snapshot()
    assert snapshot.versions == versions
    assert told == ([version] if triggers else [])
    assert losses.as_dict() == ({} if status is Status.OK else {"topic": {status.name.lower(): 1}})
    if status is Status.DUPLICATE:
        assert snapshot[snapshot.version_index(version)] == f"v{version}", "the first one stays"


def test_inserting_below_a_full_window_does_not_succeed_into_nothing():
    window = filled([10, 20], capacity=2)
    assert window.commit(INSERT, entry(5)) is Status.OUT_OF_ORDER
    assert window.snapshot().versions == (10, 20)
    assert window.commit(INSERT, entry(15)) is Status.OK
    assert window.snapshot().versions == (15, 20)
    assert window.commit(INSERT, entry(10)) is Status.OUT_OF_ORDER, "evicted is gone for good"


def test_a_held_snapshot_keeps_what_it_shows():
    window = filled([1, 2], capacity=2)
    held = window.snapshot()
    filling = [window.commit(DISCARD, entry(version)) for version in range(3, 50)]
    window.settle(1)
    assert not any(filling)
    assert held.versions == (1, 2)
    assert list(held) == ["v1", "v2"]
    assert held.miss(1) is None
    assert window.snapshot().versions == (48, 49)


def test_entries_cannot_be_changed():
    with pytest.raises(FrozenInstanceError):
        filled([1]).snapshot().entry(0).value = "other"


def test_what_is_committed_is_read_only_and_what_is_refused_is_not():
    window = Window("topic")
    kept, refused = np.zeros(3), np.zeros(3)
    window.commit(DISCARD, Entry(2, kept, 0, 0))
    window.commit(DISCARD, Entry(1, refused, 0, 0))
    refused[0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        kept[0] = 1.0


def test_settle_tells_once_and_only_of_versions_without_a_datum():
    window = filled([10, 20, 30], capacity=2)
    told = []
    window.subscribe(lambda e: None, told.append)
    for version in (20, 30, 40, 40, 25):
        window.settle(version)
    window.settle(10)  # committed, and evicted since: it is not empty
    assert told == [40, 25]
    assert window.snapshot().miss(10) is Miss.EVICTED


def test_a_datum_after_all_takes_back_its_settle():
    window = filled([10], capacity=1)
    window.settle(20)
    assert window.commit(DISCARD, entry(20)) is Status.OK
    assert window.commit(DISCARD, entry(30)) is Status.OK
    assert window.snapshot().miss(20) is Miss.EVICTED


def test_the_memory_of_settled_and_evicted_versions_is_bounded():
    window = Window("topic", 2)
    for version in range(0, 6000, 2):
        window.commit(DISCARD, entry(version))
        window.settle(version + 1)
    assert len(window._state.settled) == len(window._evicted) == 256
    assert window.snapshot().miss(5999) is Miss.SETTLED_EMPTY


def test_a_new_epoch_starts_over():
    window = filled([100, 200, 300], capacity=2)
    window.settle(250)
    old = window.snapshot()
    assert window.new_epoch() == 1
    assert len(window.snapshot()) == 0
    assert window.snapshot().miss(250) is Miss.FUTURE
    assert window.commit(DISCARD, entry(100)) is Status.OK
    assert (old.epoch, window.snapshot().epoch) == (0, 1)
    assert old.versions == (200, 300)


def test_eight_threads_commit_and_read_without_a_torn_snapshot():
    """Versions are sorted, unique and at most `capacity`; each commit is kept or counted; subscribers see them rise."""
    losses = LossCounters()
    window = Window("topic", 16, losses)
    rounds, threads = 150, 8
    triggered, problems, statuses = [], [], []
    window.subscribe(lambda e: triggered.append(e.version), lambda version: None)
    start = threading.Barrier(threads + 1)

    def commit(number):
        start.wait(10)
        policy = INSERT if number % 2 else DISCARD
        statuses.extend([window.commit(policy, entry(step * threads + number)) for step in range(rounds)])

    def read():
        start.wait(10)
        while len(statuses) < rounds * threads:
            snapshot = window.snapshot()
            versions = snapshot.versions
            sound = list(versions) == sorted(set(versions)) and len(versions) <= 16
            if not sound or [f"v{v}" for v in versions] != list(snapshot):
                problems.append(versions)

    workers = [threading.Thread(target=commit, args=(number,)) for number in range(threads)]
    workers.append(threading.Thread(target=read))
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(30)
    assert not problems
    assert triggered == sorted(set(triggered))
    assert len(statuses) == rounds * threads
    assert losses["topic", "out_of_order"] == statuses.count(Status.OUT_OF_ORDER)
    assert window.snapshot().versions[-1] == rounds * threads - 1


class WindowMachine(RuleBasedStateMachine):
    """A window against a dictionary of everything that it should hold."""

    versions = st.integers(0, 30)

    def __init__(self):
        super().__init__()
        self.capacity = 3
        self.window = Window("topic", self.capacity)
        self.model, self.gone, self.settled = {}, set(), set()
        self.held = []

    def is_full(self):
        return len(self.model) == self.capacity

    @rule(version=versions, policy=st.sampled_from(CommitPolicy), value=st.integers())
    def commit(self, version, policy, value):
        newest = max(self.model, default=-1)
        if version in self.model:
            expected = Status.DUPLICATE
        elif version < newest and (policy is DISCARD or (self.is_full() and version < min(self.model))):
            expected = Status.OUT_OF_ORDER
        else:
            expected = Status.OK
            self.model[version] = value
            self.settled.discard(version)
            if len(self.model) > self.capacity:
                self.gone.add(min(self.model))
                del self.model[min(self.model)]
        assert self.window.commit(policy, entry(version, value)) is expected

    @rule(version=versions)
    def settle(self, version):
        self.window.settle(version)
        if version not in self.model and version not in self.gone:
            self.settled.add(version)

    @rule()
    def hold(self):
        self.held.append((self.window.snapshot(), dict(self.model)))

    @precondition(lambda self: len(self.model) > 1)
    @rule()
    def new_epoch(self):
        self.window.new_epoch()
        self.model, self.gone, self.settled = {}, set(), set()

    @invariant()
    def shows_the_model(self):
        snapshot = self.window.snapshot()
        assert snapshot.versions == tuple(sorted(self.model))
        for version in range(31):
            index = snapshot.version_index(version)
            assert (snapshot[index] if index >= 0 else None) == self.model.get(version)
            assert snapshot.before(version) == sum(v < version for v in self.model) - 1
            assert (snapshot.miss(version) is None) == (version in self.model)
            assert (snapshot.miss(version) is Miss.SETTLED_EMPTY) == (version in self.settled)

    @invariant()
    def held_snapshots_do_not_change(self):
        for snapshot, model in self.held:
            assert dict(zip(snapshot.versions, snapshot, strict=True)) == model


WindowMachine.TestCase.settings = settings(max_examples=40, stateful_step_count=25, deadline=None)
TestWindowAgainstADictionary = WindowMachine.TestCase
