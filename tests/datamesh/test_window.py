"""Windows and snapshots: history, misses, epochs, settling, threads. Policies and the state machine: test_policy."""

import random
import threading
import time

import numpy as np
import pytest

from warploom.datamesh import CommitPolicy, Entry, EqualVersion, LossCounters, Miss, Reorder, Status, Window

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
    assert snapshot.entry(1) == entry(20)._replace(epoch=0)
    assert [snapshot.until(v) for v in (9, 10, 29, 30, 31)] == [-1, 0, 1, 2, 2]
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
    with pytest.raises(AttributeError):
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
    window.subscribe(lambda e: None, lambda version, epoch: told.append(version))
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
    assert len(window.state.settled) == len(window.state.gone) == 256
    assert window.snapshot().miss(5999) is Miss.SETTLED_EMPTY


def test_a_new_epoch_starts_over_and_the_one_before_is_kept_until_it_has_filled_the_window():
    window = filled([100, 200, 300], capacity=2)
    window.settle(250)
    assert window.new_epoch() == window.epoch == 1
    assert len(window.snapshot()) == 0
    assert window.snapshot().miss(250) is Miss.FUTURE
    assert window.commit(DISCARD, entry(100)) is Status.OK
    assert (window.snapshot().epoch, window.snapshot().versions) == (1, (100,))
    before = window.snapshot(0)
    assert (before.epoch, before.versions, before.miss(250), before.miss(100)) == (
        0,
        (200, 300),
        Miss.SETTLED_EMPTY,
        Miss.EVICTED,
    )
    window.commit(DISCARD, entry(110))
    assert window.snapshot(0).versions == (200, 300)
    window.commit(DISCARD, entry(120))
    assert window.snapshot(0).versions == ()
    assert window.snapshot(0).miss(300) is Miss.EVICTED
    assert before.versions == (200, 300), "a held snapshot keeps what it shows"
    assert window.snapshot(7).miss(300) is Miss.FUTURE


def test_an_entry_of_a_newer_epoch_takes_the_window_into_it_and_one_of_an_older_is_out_of_order():
    losses = LossCounters()
    window = filled([100, 200], losses=losses)
    told = []
    window.subscribe(lambda e: told.append((e.epoch, e.version)), lambda version, epoch: told.append((epoch, version)))
    assert window.commit(DISCARD, entry(50)._replace(epoch=3)) is Status.OK
    for policy in (DISCARD, INSERT, CommitPolicy.OVERWRITE):
        assert window.commit(policy, entry(300)._replace(epoch=0)) is Status.OUT_OF_ORDER
    assert window.commit(CommitPolicy.REJECT, entry(300)._replace(epoch=2)) is Status.REJECTED
    window.settle(60, 4)
    assert told == [(3, 50), (4, 60)]
    assert window.epoch == 4
    assert losses.as_dict() == {"topic": {"out_of_order": 3, "rejected": 1}}


def test_the_epoch_before_can_still_be_settled_by_those_at_work_on_it():
    window = filled([100, 200])
    window.new_epoch()
    told = []
    window.subscribe(lambda e: None, lambda version, epoch: told.append((epoch, version)))
    for version in (150, 150, 200):
        window.settle(version, 0)
    window.settle(150)
    assert told == [(0, 150), (1, 150)]
    assert window.snapshot(0).miss(150) is window.snapshot().miss(150) is Miss.SETTLED_EMPTY


def test_new_epoch_does_not_go_back():
    window = filled([1])
    assert window.new_epoch(5) == 5
    assert window.new_epoch(3) == 5
    assert window.new_epoch() == 6


def test_a_producer_that_comes_back_at_a_lower_version_begins_an_epoch():
    """The policy of a producer whose clock may step: in order it appends, back in time it begins anew."""
    window = Window("topic", 8)
    statuses = [window.commit(CommitPolicy.FORCE_NEW_EPOCH, entry(v)) for v in (100, 200, 50, 60, 60, 10)]
    assert statuses == [Status.OK] * 4 + [Status.DUPLICATE, Status.OK]
    assert (window.epoch, window.snapshot().versions, window.snapshot(1).versions) == (2, (10,), (50, 60))


def test_who_unsubscribes_is_told_no_more():
    window, told = Window("topic"), []
    end = window.subscribe(lambda e: told.append(e.version), lambda version, epoch: told.append(version))
    window.commit(DISCARD, entry(1))
    window.settle(2)
    end()
    window.commit(DISCARD, entry(3))
    window.settle(4)
    assert told == [1, 2]


def test_a_subscriber_that_raises_keeps_the_others_from_nothing(caplog):
    window, told = Window("topic"), []

    def fail(*event):
        raise OSError("disk full")

    window.subscribe(fail, fail)
    window.subscribe(lambda e: told.append(e.version), lambda version, epoch: told.append(version))
    assert window.commit(DISCARD, entry(1)) is Status.OK
    window.settle(2)
    assert told == [1, 2]
    assert caplog.text.count("OSError: disk full") == 2


class Event:
    """Stands in for an event of a device."""

    def __init__(self, stream):
        self.stream, self.calls = stream, []

    def synchronize(self):
        self.calls.append("synchronize")

    def wait_on(self, stream):
        self.calls.append(("wait_on", stream))


@pytest.mark.parametrize(
    ("reading_on", "calls"), [(None, ["synchronize"]), ("other", [("wait_on", "other")]), ("own", [])]
)
def test_who_reads_on_the_host_or_on_another_stream_waits_for_the_device_and_nobody_else(reading_on, calls):
    window, event = Window("topic"), Event("own")
    window.subscribe(lambda e: e.value, lambda version, epoch: None)
    window.commit(DISCARD, entry(1)._replace(completion=event))
    snapshot = window.snapshot(stream=reading_on)
    assert snapshot.entry(0).value == "v1"
    assert snapshot.version_index(1) == 0
    assert event.calls == [], "who does not read the value does not wait"
    assert snapshot[0] == "v1"
    assert event.calls == calls
    assert [snapshot.last(), *snapshot] == ["v1", "v1"]
    assert event.calls == calls * 3


def commit_and_read(seconds_or_rounds, seed, threads=8, capacity=16):
    """Threads commit with random delays and policies, others read; gives what broke an invariant."""
    losses = LossCounters()
    window = Window("topic", capacity, losses)
    problems, statuses, told = [], [], []
    window.subscribe(lambda e: told.append((e.epoch, e.version, e.triggers)), lambda version, epoch: None)
    start, done = threading.Barrier(threads + 2), threading.Event()
    until = time.monotonic() + seconds_or_rounds if isinstance(seconds_or_rounds, float) else None
    policies = (DISCARD, DISCARD, INSERT, CommitPolicy.REJECT, Reorder(200_000, 3))

    def commit(number):
        jitter = random.Random(seed * 100 + number)
        start.wait(10)
        step = 0
        while (step < seconds_or_rounds) if until is None else (time.monotonic() < until):
            version = step * threads + number
            status = window.commit(jitter.choice(policies), entry(version), EqualVersion(jitter.randrange(2)))
            statuses.append(status)
            if jitter.random() < 0.05:
                window.settle(version + jitter.randrange(64))
            if jitter.random() < 0.3:
                time.sleep(jitter.random() * 2e-4)
            step += 1

    def read():
        start.wait(10)
        while not done.is_set():
            snapshot = window.snapshot()
            versions = snapshot.versions
            sound = list(versions) == sorted(set(versions)) and len(versions) <= capacity
            if not sound or [f"v{v}" for v in versions] != list(snapshot):
                problems.append(versions)
            if any(snapshot.miss(v) is not None or snapshot.version_index(v) < 0 for v in versions):
                problems.append(("miss", versions))
            time.sleep(0)

    writers = [threading.Thread(target=commit, args=(number,)) for number in range(threads)]
    readers = [threading.Thread(target=read) for _ in range(2)]
    for thread in (*writers, *readers):
        thread.start()
    for thread in writers:
        thread.join(120)
    done.set()
    for thread in readers:
        thread.join(10)
    window.flush()
    window.clock.stop()
    rising = [(epoch, version) for epoch, version, triggers in told if triggers]
    if rising != sorted(set(rising)):
        problems.append("triggers do not rise")
    kept = len({(epoch, version) for epoch, version, _ in told})
    counted = sum(losses.as_dict().get("topic", {}).values())
    return problems, len(statuses), kept, counted


def test_what_is_called_after_commits_that_follow_each_other_waits_for_the_last_of_them():
    window, calls = Window("topic"), []
    window.subscribe(
        lambda entry: calls.append(entry.version), lambda version, _: calls.append(-version), lambda: calls.append("!")
    )
    window.commit(DISCARD, entry(1))
    window.put_off(True)
    window.commit(DISCARD, entry(2))
    window.settle(3)
    window.commit(DISCARD, entry(4))
    window.put_off(False)
    window.put_off(False)
    window.commit(DISCARD, entry(5))
    assert calls == [1, "!", 2, -3, 4, "!", 5, "!"]


def test_eight_threads_commit_and_read_without_a_torn_snapshot():
    """Versions are sorted, unique and at most `capacity`; every commit is kept or counted; triggers rise."""
    problems, commits, kept, counted = commit_and_read(150, seed=1)
    assert not problems
    assert commits == 8 * 150 == kept + counted


@pytest.mark.campaign
def test_eight_threads_commit_and_read_for_a_minute():
    problems, commits, kept, counted = commit_and_read(60.0, seed=2)
    assert not problems
    assert commits == kept + counted
