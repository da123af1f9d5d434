"""Commit policies and equal versions, each against a plain model; and a state machine of everything a window does."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from warploom.datamesh import (
    CommitPolicy,
    DataMesh,
    Entry,
    EqualVersion,
    LossCounters,
    ManualClock,
    Miss,
    Outcome,
    Output,
    Reorder,
    Status,
    Window,
)

DISCARD, INSERT, REJECT, OVERWRITE, FORCE = CommitPolicy
KEEP, REPLACE, ERROR = EqualVersion


def entry(version, value=None):
    return Entry(version, f"v{version}" if value is None else value, version, version)


def filled(losses=None, told=None, clock=None, versions=(10, 20)):
    window = Window("topic", 8, losses, clock=clock)
    for version in versions:
        window.commit(DISCARD, entry(version))
    if told is not None:
        window.subscribe(lambda e: told.append((e.version, e.triggers)), lambda version, epoch: None)
    return window


@pytest.mark.parametrize(
    ("policy", "version", "status", "versions", "triggers", "losses"),
    [
        (DISCARD, 15, Status.OUT_OF_ORDER, (10, 20), None, {"out_of_order": 1}),
        (DISCARD, 5, Status.OUT_OF_ORDER, (10, 20), None, {"out_of_order": 1}),
        (INSERT, 15, Status.OK, (10, 15, 20), False, {}),
        (INSERT, 5, Status.OK, (5, 10, 20), False, {}),
        (REJECT, 15, Status.REJECTED, (10, 20), None, {"rejected": 1}),
        (REJECT, 5, Status.REJECTED, (10, 20), None, {"rejected": 1}),
        (OVERWRITE, 15, Status.OK, (10, 15), True, {"overwritten": 1}),
        (OVERWRITE, 5, Status.OK, (5,), True, {"overwritten": 2}),
        (FORCE, 15, Status.OK, (15,), True, {}),
        (FORCE, 5, Status.OK, (5,), True, {}),
        *((policy, 25, Status.OK, (10, 20, 25), True, {}) for policy in CommitPolicy),
    ],
)
def test_every_policy_on_older_and_newer(policy, version, status, versions, triggers, losses):
    """What is not kept, and what is taken out, is counted; what is not the newest triggers nobody."""
    counters, told = LossCounters(), []
    window = filled(counters, told)
    assert window.commit(policy, entry(version, "late")) is status
    assert window.snapshot().versions == versions
    assert window.epoch == (1 if policy is FORCE and version < 20 else 0)
    assert told == ([] if triggers is None else [(version, triggers)])
    assert counters.as_dict() == ({"topic": losses} if losses else {})


@pytest.mark.parametrize("version", [10, 20])
@pytest.mark.parametrize("policy", [*CommitPolicy, Reorder(0, 0)])
@pytest.mark.parametrize("equal", EqualVersion)
def test_every_policy_on_equal_versions(policy, equal, version):
    """The choice for equal versions stands above the policy."""
    counters, told = LossCounters(), []
    window = filled(counters, told)
    if equal is ERROR:
        with pytest.raises(ValueError, match=f"version {version} is in 'topic' already"):
            window.commit(policy, entry(version, "second"), equal)
    else:
        expected = Status.OK if equal is REPLACE else Status.DUPLICATE
        assert window.commit(policy, entry(version, "second"), equal) is expected
    snapshot = window.snapshot()
    assert snapshot.versions == (10, 20)
    assert snapshot[snapshot.version_index(version)] == ("second" if equal is REPLACE else f"v{version}")
    assert told == ([(version, False)] if equal is REPLACE else [])
    assert counters.as_dict() == {"topic": {"replaced" if equal is REPLACE else "duplicate": 1}}


@pytest.mark.parametrize(("version", "says", "triggers"), [(15, True, True), (15, None, False), (25, False, False)])
def test_an_insertion_says_whether_it_triggers(version, says, triggers):
    told = []
    assert filled(told=told).commit(INSERT, entry(version), KEEP, says) is Status.OK
    assert told == [(version, triggers)]


def test_a_rejected_change_stays_open_and_can_be_committed_at_another_version():
    output = Output()
    output.bind("output", filled())
    with output.allocate_change() as change:
        change.set_version(15)
        change.value = payload = np.zeros(3)
        assert output.commit(REJECT, change) is Status.REJECTED
        payload[0] = 1.0  # still its writer's
        change.set_version(30)
        assert output.commit(REJECT, change) is Status.OK
    assert output.window.snapshot().versions == (10, 20, 30)
    assert output.window.losses.as_dict() == {"topic": {"rejected": 1}}


def test_a_rejected_change_that_is_given_up_is_counted_as_abandoned():
    output = Output()
    output.bind("output", filled())
    with output.allocate_change() as change:
        change.set_version(15)
        change.value = 1
        output.commit(REJECT, change)
    assert output.window.losses.as_dict() == {"topic": {"rejected": 1, "abandoned": 1}}


def test_who_watches_losses_may_read_and_write_the_window_that_lost():
    """The callback runs without a lock of the window, for every kind of loss."""
    counters = LossCounters()
    window, seen = filled(counters), []
    counters.on_loss(lambda topic, reason, version: (seen.append((reason, version)), window.settle(version + 1000)))
    window.commit(DISCARD, entry(5))
    window.commit(OVERWRITE, entry(15))
    window.commit(DISCARD, entry(15), REPLACE)
    assert seen == [("out_of_order", 5), ("overwritten", 20), ("replaced", 15)]
    assert window.snapshot().miss(1005) is Miss.SETTLED_EMPTY


def test_what_was_evicted_before_versions_were_overwritten_is_not_settled():
    """The version evicted last is then lower than one evicted before."""
    window = Window("topic", 3)
    for version in (1, 4, 5, 6):
        window.commit(DISCARD, entry(version))
    window.commit(OVERWRITE, entry(2))
    for version in (3, 0, 4):
        window.commit(INSERT, entry(version))
    assert window.snapshot().versions == (2, 3, 4)
    window.settle(1)
    assert window.snapshot().miss(1) is Miss.EVICTED


def test_what_is_above_an_overwriting_version_is_to_come_and_waited_for():
    window, outcomes = Window("topic", 3), []
    for version in (1, 4, 5, 6, 7):
        window.commit(DISCARD, entry(version))
    window.commit(OVERWRITE, entry(2))
    assert window.snapshot().miss(3) is Miss.FUTURE
    window.wait(3, lambda wait: outcomes.append((wait.outcome, wait.entry.version)))
    assert outcomes == []
    window.commit(DISCARD, entry(3))
    assert outcomes == [(Outcome.FOUND, 3)]


class Reordering:
    """A window under a manual clock, and the versions in the order in which its subscribers see them."""

    def __init__(self, delay_ns=100, depth=3):
        self.clock, self.losses, self.told = ManualClock(), LossCounters(), []
        self.window = Window("topic", 50, self.losses, clock=self.clock)
        self.window.subscribe(lambda e: self.told.append(e.version), lambda version, epoch: None)
        self.policy = Reorder(delay_ns, depth)

    def commit(self, *versions, equal=KEEP):
        return [self.window.commit(self.policy, entry(version), equal) for version in versions]


def test_reorder_puts_swapped_versions_in_order():
    topic = Reordering(depth=2)
    assert topic.commit(20, 10, 40, 30, 50) == [Status.OK] * 5
    assert topic.told == [10, 20, 30]
    topic.window.flush()
    assert topic.told == [10, 20, 30, 40, 50]
    assert topic.losses.as_dict() == {}


def test_reorder_holds_no_longer_than_its_delay():
    topic = Reordering(delay_ns=100)
    topic.commit(20)
    topic.clock.advance(60)
    topic.commit(10)
    topic.clock.advance(39)
    assert topic.told == []
    topic.clock.advance(1)
    assert topic.told == [10, 20], "10 goes before 20, although its own delay has not passed"
    topic.commit(30)
    topic.clock.advance(99)
    assert topic.told == [10, 20]
    topic.clock.advance(1)
    assert topic.told == [10, 20, 30]
    stamps = [topic.window.snapshot().entry(index).committed_ns for index in range(3)]
    assert stamps == [100, 100, 200], "the time that a datum was held counts as latency"


def test_reorder_drops_what_comes_later_than_it_held():
    topic = Reordering(depth=0)
    assert topic.commit(20, 10, 20) == [Status.OK, Status.OUT_OF_ORDER, Status.DUPLICATE]
    assert topic.losses.as_dict() == {"topic": {"out_of_order": 1, "duplicate": 1}}


def test_equal_versions_that_are_held():
    topic = Reordering()
    assert topic.commit(20, 20) == [Status.OK, Status.DUPLICATE]
    assert topic.window.commit(topic.policy, entry(20, "second"), REPLACE) is Status.OK
    with pytest.raises(ValueError, match="held back already"):
        topic.commit(20, equal=ERROR)
    topic.window.flush()
    assert list(topic.window.snapshot()) == ["second"]
    assert topic.losses.as_dict() == {"topic": {"duplicate": 2, "replaced": 1}}


def test_what_is_held_is_read_only_not_settled_and_goes_before_a_new_epoch():
    topic, payload = Reordering(), np.zeros(2)
    topic.window.commit(topic.policy, entry(20, payload))
    with pytest.raises(ValueError, match="read-only"):
        payload[0] = 1.0
    topic.window.settle(20)
    topic.window.new_epoch()
    topic.commit(5)
    assert topic.window.snapshot(0).versions == (20,)
    assert topic.told == [20]
    topic.window.flush()
    assert (topic.told, topic.window.snapshot().versions) == ([20, 5], (5,))


@pytest.mark.parametrize("settings", [(-1, 0), (0, -1)])
def test_a_reorder_that_makes_no_sense_is_refused(settings):
    with pytest.raises(ValueError, match="must be >= 0"):
        Reorder(*settings)


@given(st.permutations(list(range(12))), st.integers(0, 12))
@settings(max_examples=60, deadline=None)
def test_reorder_gives_rising_versions_and_loses_nothing_that_it_could_hold(versions, depth):
    topic = Reordering(depth=depth)
    statuses = topic.commit(*versions)
    topic.window.flush()
    assert topic.told == sorted(topic.told)
    dropped = statuses.count(Status.OUT_OF_ORDER)
    assert len(topic.told) + dropped == 12
    displaced = max(sum(other > version for other in versions[:place]) for place, version in enumerate(versions))
    if displaced <= depth:
        assert dropped == 0


def test_a_mesh_that_checks_finds_who_writes_after_the_commit(caplog):
    """At the release by a reader, and at the eviction; each datum once; also behind NumPy's back."""
    mesh = DataMesh(window_capacity=2, check=True)
    base = np.zeros(4)
    output = Output()
    output.bind("output", mesh.window("topic"))

    def publish(version, value):
        with output.allocate_change() as change:
            change.set_version(version)
            change.value = value
            output.commit(DISCARD, change)

    publish(1, {"view": base[1:], "note": "x"})
    publish(2, np.ones(3))
    base[2] = 5.0  # the view is read-only, and what it looks at is not
    publish(3, np.ones(3))
    publish(4, np.ones(3))
    assert mesh.losses.as_dict() == {"topic": {"modified": 1}}
    assert "the payload of version 1 was written to after its commit" in caplog.text


class StateMachine(RuleBasedStateMachine):
    """A window against a dictionary of everything that it should hold."""

    versions = st.integers(0, 30)

    def __init__(self):
        super().__init__()
        self.capacity = 3
        self.losses, self.told = LossCounters(), []
        self.window = Window("topic", self.capacity, self.losses)
        self.window.subscribe(lambda e: self.told.append((e.epoch, e.version, e.triggers)), lambda v, e: None)
        self.model, self.gone, self.settled, self.epoch = {}, set(), set(), 0
        self.expected, self.lost, self.held = [], 0, []

    def begin_epoch(self):
        self.epoch += 1
        self.model, self.gone, self.settled = {}, set(), set()

    def put(self, version, value, triggers):
        self.model[version] = value
        self.settled.discard(version)
        self.expected.append((self.epoch, version, triggers))
        if len(self.model) > self.capacity:
            self.gone.add(min(self.model))
            del self.model[min(self.model)]
        return Status.OK

    def decide(self, version, policy, equal, triggers, value):
        """What the policies say, in the words of the specification."""
        newest = max(self.model, default=-1)
        if version in self.model:
            self.lost += 1
            if equal is ERROR:
                return ValueError
            return self.put(version, value, False) if equal is REPLACE else Status.DUPLICATE
        if version > newest:
            return self.put(version, value, triggers is not False)
        full = len(self.model) == self.capacity
        if policy is INSERT and not (full and version < min(self.model)):
            return self.put(version, value, triggers is True)
        if policy is OVERWRITE:
            newer = [other for other in self.model if other > version]
            self.lost += len(newer)
            for other in newer:
                del self.model[other]
            return self.put(version, value, True)
        if policy is FORCE:
            self.begin_epoch()
            return self.put(version, value, True)
        self.lost += 1
        return Status.REJECTED if policy is REJECT else Status.OUT_OF_ORDER

    @rule(
        version=versions,
        policy=st.sampled_from(CommitPolicy),
        equal=st.sampled_from(EqualVersion),
        triggers=st.sampled_from([None, True, False]),
        value=st.integers(),
    )
    def commit(self, version, policy, equal, triggers, value):
        expected = self.decide(version, policy, equal, triggers, value)
        try:
            given = self.window.commit(policy, entry(version, value), equal, triggers)
        except ValueError:
            given = ValueError
        assert given is expected

    @rule(version=versions)
    def settle(self, version):
        self.window.settle(version)
        if version not in self.model and version not in self.gone:
            self.settled.add(version)

    @rule()
    def hold(self):
        self.held.append((self.window.snapshot(), dict(self.model)))

    @rule()
    def new_epoch(self):
        self.window.new_epoch()
        self.begin_epoch()

    @invariant()
    def shows_the_model(self):
        snapshot = self.window.snapshot()
        assert snapshot.epoch == self.epoch
        assert snapshot.versions == tuple(sorted(self.model))
        for version in range(31):
            index = snapshot.version_index(version)
            assert (snapshot[index] if index >= 0 else None) == self.model.get(version)
            assert snapshot.before(version) == sum(v < version for v in self.model) - 1
            assert (snapshot.miss(version) is None) == (version in self.model)
            assert (snapshot.miss(version) is Miss.SETTLED_EMPTY) == (version in self.settled)
            to_come = version > max(self.model, default=-1) and version not in self.settled
            assert (snapshot.miss(version) is Miss.FUTURE) == to_come

    @invariant()
    def told_and_counted_everything(self):
        assert self.told == self.expected
        assert sum(self.losses.as_dict().get("topic", {}).values()) == self.lost

    @invariant()
    def held_snapshots_do_not_change(self):
        for snapshot, model in self.held:
            assert dict(zip(snapshot.versions, snapshot, strict=True)) == model


StateMachine.TestCase.settings = settings(max_examples=60, stateful_step_count=25, deadline=None)
TestWindowAgainstADictionary = StateMachine.TestCase
