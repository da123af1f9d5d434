"""Triggers of commits and of time, without a component: what is offered, in which order, and what is counted."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.dag.triggering import AllTrigger, AnyTrigger, TimeTrigger
from warploom.datamesh import CommitPolicy, DataMesh, Input, ManualClock, Output

DISCARD, INSERT = CommitPolicy.DISCARD_OUT_OF_ORDER, CommitPolicy.INSERT_SORTED
MS = 1_000_000


class Topics:
    """Some inputs of one component, with the outputs that feed them."""

    def __init__(self, *names, capacity=8):
        self.clock = ManualClock()
        self.mesh = DataMesh(capacity, clock=self.clock)
        self.inputs, self.outputs, self.offered = {}, {}, []
        for name in names:
            self.inputs[name], self.outputs[name] = Input(), Output()
            self.inputs[name].bind(name, self.mesh.window(name))
            self.outputs[name].bind(name, self.mesh.window(name))

    def any(self):
        AnyTrigger(self.inputs, self.offered.append)
        return self

    def all(self, tolerance_ns=0):
        AllTrigger(
            self.inputs, self.offered.append, tolerance_ns=tolerance_ns, place="component", losses=self.mesh.losses
        )
        return self

    def commit(self, name, version, policy=DISCARD, **options):
        with self.outputs[name].allocate_change() as change:
            change.set_version(version, received_ns=version * 7)
            change.value = version
            return self.outputs[name].commit(policy, change, **options)

    def settle(self, name, version):
        self.outputs[name].settle(version)

    def taken(self):
        """What was offered since: version, and whether it is settled."""
        taken = [(one.version, one.settled) for one in self.offered]
        self.offered.clear()
        return taken


RUNS, SETTLED = False, True


def test_a_trigger_says_version_epoch_time_of_reception_and_input():
    topics = Topics("lidar").any()
    topics.outputs["lidar"].new_epoch()
    topics.clock.advance(500)
    topics.commit("lidar", 10)
    (trigger,) = topics.offered
    assert trigger == (10, 70, False, 1, 500, {"lidar": 10})


def test_a_late_insertion_is_settled_unless_it_says_that_it_triggers():
    topics = Topics("a").any()
    topics.commit("a", 10)
    topics.commit("a", 5, INSERT)
    topics.commit("a", 7, INSERT, triggers=True)
    assert topics.taken() == [(10, RUNS), (5, SETTLED), (7, RUNS)]


def test_any_on_two_windows_with_one_version_triggers_once():
    topics = Topics("a", "b").any()
    topics.commit("a", 10)
    topics.commit("b", 10)
    topics.commit("b", 11)
    assert topics.taken() == [(10, RUNS), (11, RUNS)]


def test_any_is_settled_when_no_input_can_have_the_version_any_more():
    topics = Topics("a", "b").any()
    topics.settle("a", 10)
    assert topics.taken() == [], "it may come on b"
    topics.settle("b", 10)
    assert topics.taken() == [(10, SETTLED)]
    topics.settle("a", 20)
    topics.commit("b", 20)
    assert topics.taken() == [(20, RUNS)]
    topics.settle("a", 30)
    topics.commit("b", 31)
    assert topics.taken() == [(31, RUNS), (30, SETTLED)]


def test_any_remembers_a_bounded_number_of_settled_versions():
    topics = Topics("a", "b").any()
    for version in range(1000):
        topics.settle("a", version)
    assert topics.taken() == [(version, SETTLED) for version in range(1000 - 256)]


def test_all_waits_for_the_same_version_on_every_input():
    topics = Topics("a", "b", "c").all()
    for name in ("c", "a"):
        topics.commit(name, 10)
    assert topics.taken() == []
    topics.commit("b", 10)
    assert topics.taken() == [(10, RUNS)]
    for name in ("b", "c", "a"):
        topics.commit(name, 20)
    assert topics.taken() == [(20, RUNS)]
    assert topics.mesh.losses.as_dict() == {}


def test_all_within_a_tolerance_takes_the_nearest_and_says_which():
    topics = Topics("lidar", "camera").all(tolerance_ns=5)
    topics.commit("camera", 6)
    topics.commit("camera", 13)
    topics.commit("lidar", 10)
    topics.commit("lidar", 20)
    topics.commit("camera", 24)
    assert [(one.version, one.received_ns, one.inputs) for one in topics.offered] == [
        (10, 70, {"lidar": 10, "camera": 13}),
        (20, 140, {"lidar": 20, "camera": 24}),
    ]


@pytest.mark.parametrize("how", ["settled", "passed", "late"])
def test_all_gives_up_a_version_that_an_input_cannot_have_any_more(how):
    topics = Topics("a", "b").all(tolerance_ns=2)
    if how == "late":
        topics.commit("b", 13)
    topics.commit("a", 10)
    if how == "settled":
        topics.settle("b", 10)
    elif how == "passed":
        assert topics.taken() == []
        topics.commit("b", 13)
    assert topics.taken() == [(10, SETTLED)]
    assert topics.mesh.losses.as_dict() == {"component": {"incomplete": 1}}


def test_all_with_a_dead_input_settles_what_it_can_no_longer_complete_and_stays_bounded():
    topics = Topics("a", "dead", capacity=4).all()
    for version in range(100):
        topics.commit("a", version)
    assert topics.taken() == [(version, SETTLED) for version in range(96)]
    assert topics.mesh.losses.as_dict() == {"component": {"incomplete": 96}}
    topics.commit("dead", 98)
    assert topics.taken() == [(96, SETTLED), (97, SETTLED), (98, RUNS)]


def test_all_passes_on_what_its_first_input_settles():
    topics = Topics("a", "b").all()
    topics.settle("a", 10)
    topics.settle("b", 20)
    assert topics.taken() == [(10, SETTLED)]


def test_all_does_not_mix_epochs():
    topics = Topics("a", "b").all(tolerance_ns=3)
    topics.commit("a", 10)
    topics.outputs["b"].new_epoch()
    topics.commit("b", 10)
    assert topics.taken() == [(10, SETTLED)]
    topics.outputs["a"].new_epoch()
    topics.commit("a", 10)
    assert [(one.epoch, one.version, one.settled) for one in topics.offered] == [(1, 10, RUNS)]


@given(
    st.lists(st.tuples(st.sampled_from("ab"), st.sampled_from(["commit", "settle", "insert"]), st.integers(0, 15))),
    st.sampled_from(["any", "all"]),
)
@settings(max_examples=150, deadline=None)
def test_each_version_is_offered_at_most_once_to_run_and_runs_are_of_what_was_committed(events, kind):
    topics = Topics("a", "b", capacity=30)
    getattr(topics, kind)()
    committed = {"a": set(), "b": set()}
    for name, what, version in events:
        if what == "settle":
            topics.settle(name, version)
        elif not topics.commit(name, version, DISCARD if what == "commit" else INSERT):
            committed[name].add(version)
    taken = topics.taken()
    runs = [version for version, settled in taken if not settled]
    assert len(runs) == len(set(runs))
    settled = [version for version, settled in taken if settled]
    assert len(settled) == len(set(settled))
    both = committed["a"] & committed["b"] if kind == "all" else committed["a"] | committed["b"]
    assert set(runs) <= both


class Ticks:
    """A time trigger of 100 ms on a manual clock that shows 1 s at the start."""

    def __init__(self, busy=False):
        self.clock = ManualClock(1000 * MS)
        self.mesh, self.offered, self.busy = DataMesh(clock=self.clock), [], busy
        self.source = TimeTrigger(
            self.clock,
            self.offered.append,
            period_ns=100 * MS,
            is_busy=lambda: self.busy,
            place="component",
            losses=self.mesh.losses,
        )

    def taken(self):
        taken = [(one.epoch, one.version // MS, one.settled) for one in self.offered]
        self.offered.clear()
        return taken


def test_time_triggers_every_period_on_the_clock():
    ticks = Ticks()
    ticks.source.start()
    ticks.clock.advance(99 * MS)
    assert ticks.taken() == []
    ticks.clock.advance(301 * MS)
    assert ticks.taken() == [(0, 1100 + 100 * number, RUNS) for number in range(4)]
    assert ticks.mesh.losses.as_dict() == {}


def test_ticks_are_skipped_counted_and_settled_while_the_component_is_busy():
    ticks = Ticks()
    ticks.source.start()
    ticks.clock.advance(100 * MS)
    ticks.busy = True
    ticks.clock.advance(200 * MS)
    ticks.busy = False
    ticks.clock.advance(100 * MS)
    assert ticks.taken() == [(0, 1100, RUNS), (0, 1200, SETTLED), (0, 1300, SETTLED), (0, 1400, RUNS)]
    assert ticks.mesh.losses.as_dict() == {"component": {"overrun": 2}}


def test_a_clock_that_was_held_up_gives_one_tick_and_no_burst():
    ticks = Ticks()
    ticks.source.start()
    ticks.clock._elapsed += 350 * MS  # its thread did not come to run
    ticks.clock.advance(0)
    assert ticks.taken() == [(0, 1300, RUNS)]
    assert ticks.mesh.losses.as_dict() == {"component": {"overrun": 2}}
    ticks.clock.advance(49 * MS)
    assert ticks.taken() == []
    ticks.clock.advance(1 * MS)
    assert ticks.taken() == [(0, 1400, RUNS)]


def test_a_clock_that_is_set_back_begins_an_epoch_and_one_set_forward_does_not():
    ticks = Ticks()
    ticks.source.start()
    ticks.clock.advance(200 * MS)
    ticks.clock.step(-1000 * MS)
    ticks.clock.advance(200 * MS)
    ticks.clock.step(5000 * MS)
    ticks.clock.advance(100 * MS)
    assert ticks.taken() == [
        (0, 1100, RUNS),
        (0, 1200, RUNS),
        (1, 300, RUNS),
        (1, 400, RUNS),
        (1, 5500, RUNS),
    ]


def test_a_thread_that_loses_its_core_between_two_readings_begins_no_epoch():
    """On a busy machine that happens; the clock itself goes on evenly."""
    ticks = Ticks()
    ticks.source.start()
    now_ns, losses_of_the_core = ticks.clock.now_ns, iter([0, 130, 0, 0, 260, 90, 0])

    def late_now_ns():
        ticks.clock._elapsed += next(losses_of_the_core, 0) * MS
        return now_ns()

    ticks.clock.now_ns = late_now_ns
    for _ in range(100):
        ticks.clock.advance(10 * MS)
    taken = ticks.taken()
    assert {epoch for epoch, _, _ in taken} == {0}
    versions = [version for _, version, _ in taken]
    assert versions == sorted(set(versions))
    assert all(version % 100 == 0 for version in versions), "on the grid that the first tick has begun"


def test_versions_do_not_shake_with_the_clocks_thread():
    ticks = Ticks()
    ticks.source.start()
    ticks.clock.advance(100 * MS)
    for late in (3 * MS, -2 * MS, 1 * MS):
        ticks.clock.step(late)
        ticks.clock.advance(100 * MS)
    assert [version for _, version, _ in ticks.taken()] == [1100, 1200, 1300, 1400]


def test_a_stopped_trigger_does_not_tick_and_starts_again():
    ticks = Ticks()
    ticks.source.start()
    ticks.clock.advance(100 * MS)
    ticks.source.stop()
    ticks.clock.advance(500 * MS)
    assert ticks.taken() == [(0, 1100, RUNS)]
    ticks.source.start()
    ticks.clock.advance(100 * MS)
    assert ticks.taken() == [(0, 1700, RUNS)]
