"""Waits for a version: every way in which they end, each once, without a poll."""

import threading

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.datamesh import CommitPolicy, DataMesh, Input, ManualClock, Outcome, Output

DISCARD = CommitPolicy.DISCARD_OUT_OF_ORDER
WAIT = 20.0


class Topic:
    """A topic with both ends, on a manual clock."""

    def __init__(self, capacity=3, clock=None):
        self.clock = ManualClock() if clock is None else clock
        self.mesh = DataMesh(capacity, clock=self.clock)
        self.input, self.output = Input(), Output()
        self.input.bind("input", self.mesh.window("topic"))
        self.output.bind("output", self.mesh.window("topic"))
        self.ended = []

    def commit(self, *versions):
        for version in versions:
            with self.output.allocate_change() as change:
                change.set_version(version)
                change.value = f"v{version}"
                self.output.commit(DISCARD, change)

    def when(self, version, due_ns=1000, **options):
        return self.input.when(version, self.ended.append, due_ns=due_ns, **options)

    def outcomes(self):
        return [(waiting.version, waiting.outcome) for waiting in self.ended]


def test_what_is_there_is_found_at_once():
    topic = Topic()
    topic.commit(10)
    waiting = topic.when(10)
    assert (waiting.outcome, waiting.entry.value) == (Outcome.FOUND, "v10")
    assert topic.ended == [waiting]


def test_a_commit_ends_the_wait_for_its_version_alone():
    topic = Topic()
    waiting = topic.when(20)
    topic.commit(10)
    assert topic.ended == []
    topic.commit(20)
    assert (waiting.outcome, waiting.entry.value) == (Outcome.FOUND, "v20")


def test_a_settle_ends_the_wait():
    topic = Topic()
    topic.when(20)
    topic.output.settle(20)
    assert topic.outcomes() == [(20, Outcome.SETTLED_EMPTY)]
    topic.when(20)
    assert topic.outcomes() == [(20, Outcome.SETTLED_EMPTY)] * 2


def test_the_deadline_ends_the_wait_and_a_later_commit_does_nothing():
    topic = Topic()
    waiting = topic.when(20, due_ns=100)
    topic.clock.advance(99)
    assert topic.ended == []
    topic.clock.advance(1)
    assert topic.outcomes() == [(20, Outcome.TIMEOUT)]
    topic.commit(20)
    assert topic.outcomes() == [(20, Outcome.TIMEOUT)]
    assert waiting.entry is None
    assert topic.mesh.window("topic")._waits == []


def test_a_deadline_that_has_passed_only_looks():
    topic = Topic()
    topic.commit(10)
    for version in (10, 20):
        topic.when(version, due_ns=0)
    assert topic.outcomes() == [(10, Outcome.FOUND), (20, Outcome.TIMEOUT)]


def test_the_history_that_goes_past_a_version_ends_the_wait_for_it():
    """Evicted while it is waited for: versions beyond it fill the window, so it cannot come any more."""
    topic = Topic(capacity=2)
    topic.when(15)
    topic.commit(10, 20, 30)
    assert topic.ended == []
    topic.commit(40)
    assert topic.outcomes() == [(15, Outcome.EVICTED)]
    topic.when(10)
    assert topic.outcomes()[-1] == (10, Outcome.EVICTED)


def test_a_pinned_snapshot_keeps_what_the_wait_for_it_loses():
    topic = Topic(capacity=1)
    topic.commit(10)
    with topic.input.access() as snapshot:
        topic.commit(20)
        assert topic.when(10).outcome is Outcome.EVICTED
        assert snapshot[snapshot.version_index(10)] == "v10"


def test_within_a_tolerance_the_nearest_that_is_there_is_taken():
    topic = Topic()
    topic.commit(8, 13)
    assert topic.when(10, tolerance_ns=5).entry.version == 8
    waiting = topic.when(20, tolerance_ns=5)
    assert waiting.outcome is None
    topic.commit(14)
    assert waiting.outcome is None
    topic.commit(25)
    assert waiting.entry.version == 25


def test_a_shutdown_ends_all_waits_and_those_that_come():
    topic = Topic()
    topic.commit(5)
    topic.when(10)
    topic.when(20)
    topic.input.end_waits()
    assert sorted(topic.outcomes()) == [(10, Outcome.SHUTDOWN), (20, Outcome.SHUTDOWN)]
    assert topic.when(30).outcome is Outcome.SHUTDOWN
    assert topic.when(5).outcome is Outcome.FOUND, "what is there needs no wait"
    topic.input.allow_waits()
    assert topic.when(40).outcome is None


def test_a_new_epoch_ends_waits_for_the_old_one_and_waits_can_be_for_the_next():
    topic = Topic()
    topic.when(10)
    later = topic.when(10, epoch=1)
    topic.commit(5)
    topic.output.new_epoch()
    assert topic.outcomes() == [(10, Outcome.EVICTED)]
    topic.commit(10)
    assert (later.outcome, later.entry.epoch) == (Outcome.FOUND, 1)


def test_a_thread_waits_and_is_woken_by_the_commit():
    topic = Topic()
    results = []
    thread = threading.Thread(target=lambda: results.append(topic.input.wait(10)))
    thread.start()
    while not topic.mesh.window("topic")._waits:
        thread.join(0.001)
    topic.commit(10)
    thread.join(WAIT)
    assert [(one.outcome, one.entry.value) for one in results] == [(Outcome.FOUND, "v10")]


def test_a_thread_waits_no_longer_than_its_timeout_by_the_clock():
    topic = Topic()
    results = []
    thread = threading.Thread(target=lambda: results.append(topic.input.wait(10, 500).outcome))
    thread.start()
    while not topic.clock._due:
        thread.join(0.001)
    topic.clock.advance(500)
    thread.join(WAIT)
    assert results == [Outcome.TIMEOUT]
    assert topic.input.wait(10, 0).outcome is Outcome.TIMEOUT


EVENTS = st.lists(
    st.one_of(
        st.tuples(st.just("commit"), st.integers(0, 12)),
        st.tuples(st.just("settle"), st.integers(0, 12)),
        st.tuples(st.just("when"), st.integers(0, 12), st.integers(0, 3), st.integers(0, 60)),
        st.tuples(st.just("advance"), st.integers(0, 30)),
        st.tuples(st.just("shutdown")),
    ),
    max_size=40,
)


@given(EVENTS)
@settings(max_examples=150, deadline=None)
def test_every_wait_ends_once_and_for_a_reason_that_was_true(events):
    topic = Topic(capacity=2)
    begun, seen_settled = [], set()
    window = topic.mesh.window("topic")
    for kind, *values in events:
        if kind == "commit":
            topic.commit(*values)
        elif kind == "settle":
            topic.output.settle(*values)
            seen_settled.add(values[0])
        elif kind == "when":
            version, tolerance, after = values
            begun.append(topic.when(version, topic.clock.monotonic_ns() + after, tolerance_ns=tolerance))
        elif kind == "advance":
            topic.clock.advance(*values)
        else:
            topic.input.end_waits()
            topic.input.allow_waits()
    topic.clock.advance(100)
    assert sorted(map(id, topic.ended)) == sorted(map(id, begun))
    assert window._waits == []
    assert not topic.input._waits
    for waiting in begun:
        if waiting.outcome is Outcome.FOUND:
            assert abs(waiting.entry.version - waiting.version) <= waiting.tolerance_ns
        else:
            assert waiting.entry is None
        if waiting.outcome is Outcome.SETTLED_EMPTY:
            assert waiting.version in seen_settled
        if waiting.outcome is Outcome.EVICTED:
            assert window.state.evicted >= waiting.version + waiting.tolerance_ns


def test_many_threads_wait_and_each_is_woken_once():
    """Eight waiting threads against one that commits, with waits that begin before, while and after."""
    from warploom.datamesh import SystemClock

    topic = Topic(capacity=64, clock=SystemClock())
    versions = range(40)
    results = {number: [] for number in range(8)}
    start = threading.Barrier(9)

    def wait(number):
        start.wait(WAIT)
        results[number] = [topic.input.wait(version, 20_000_000_000).outcome for version in versions]

    threads = [threading.Thread(target=wait, args=(number,)) for number in results]
    for thread in threads:
        thread.start()
    start.wait(WAIT)
    for version in versions:
        if version % 5:
            topic.commit(version)
        else:
            topic.output.settle(version)
    for thread in threads:
        thread.join(WAIT)
    expected = [Outcome.FOUND if version % 5 else Outcome.SETTLED_EMPTY for version in versions]
    assert all(outcomes == expected for outcomes in results.values())
    topic.clock.stop()


@pytest.mark.parametrize("events", [["commit", "timeout"], ["timeout", "commit"]])
def test_of_two_events_the_first_counts(events):
    topic = Topic()
    waiting = topic.when(10, due_ns=50)
    for event in events:
        topic.commit(10) if event == "commit" else topic.clock.advance(50)
    assert waiting.outcome is (Outcome.FOUND if events[0] == "commit" else Outcome.TIMEOUT)
    assert len(topic.ended) == 1
