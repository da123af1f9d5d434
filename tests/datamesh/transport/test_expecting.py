"""For how long a reader stays awake: bounded for each datum, bounded of all time, and not where it does not help."""

import errno
import os
from concurrent.futures import ThreadPoolExecutor

import hypothesis.strategies as st
import pytest
from hypothesis import given

from warploom.datamesh.transport import expecting
from warploom.datamesh.transport.expecting import Aside, Durations, Expectation, current_core

MOST = 1_000_000


@pytest.fixture
def passes(monkeypatch):
    """Time that passes when it is told to [ns]; two cores."""
    now = [0]
    monkeypatch.setattr(expecting.time, "perf_counter_ns", lambda: now[0])
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})

    def passes(ns):
        now[0] += ns

    return passes


def test_the_next_is_expected_when_those_before_came():
    durations = Durations()
    assert durations.add(500)[0] == 500
    for took in (700, 900, 800):
        soon, late = durations.add(took)
    assert (soon, late) == (500, 900 + expecting._LATE_NS)


def test_one_that_took_long_or_little_is_forgotten():
    durations = Durations()
    for took in (1, 10**9, *[1000] * 8):
        soon, late = durations.add(took)
    assert (soon, late) == (1000, 1000 + expecting._LATE_NS)


def test_one_of_eight_that_came_early_does_not_count():
    durations = Durations()
    for took in (1000, 1100, 1200, 1300, 5, 1400, 1500, 1600):
        soon, _ = durations.add(took)
    assert soon == 1000


def test_it_begins_asleep_and_may_stay_awake_once_time_has_passed(passes):
    expectation = Expectation(MOST, 0.1)
    assert expectation.allowed == 0
    passes(1_000_000)
    expectation.came(0, False)
    assert expectation.allowed == 100_000
    passes(100_000_000)
    expectation.came(0, False)
    assert expectation.allowed == MOST


@given(st.lists(st.tuples(st.integers(0, 10**8), st.integers(0, MOST), st.booleans()), max_size=60))
def test_it_never_takes_more_than_its_share_and_what_it_saved(data):
    with pytest.MonkeyPatch.context() as patch:
        now = [0]
        patch.setattr(expecting.time, "perf_counter_ns", lambda: now[0])
        patch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
        expectation, spent = Expectation(MOST, 0.05), 0
        for pause, wanted, in_vain in data:
            awake = max(0, min(wanted, expectation.allowed))
            spent += awake
            now[0] += pause + awake
            expectation.came(awake, in_vain and awake > 0)
            assert expectation.allowed <= MOST
        assert spent <= 0.05 * now[0] + len(data)


def test_where_data_do_not_come_when_they_are_due_it_sleeps_more_and_more(passes):
    expectation = Expectation(MOST, 1.0)
    slept = []
    for _ in range(200):
        passes(10 * MOST)
        awake = max(0, expectation.allowed)
        slept.append(not awake)
        expectation.came(awake, awake > 0)
    assert sum(slept[:20]) < sum(slept[20:40]) <= sum(slept[-20:])
    assert sum(slept[-20:]) >= 19


def test_it_tries_again_where_they_do(passes):
    expectation = Expectation(MOST, 1.0)
    for number in range(60):
        passes(10 * MOST)
        awake = max(0, expectation.allowed)
        expectation.came(awake, awake > 0 and number < 20)
    assert expectation.allowed == MOST


@pytest.mark.parametrize(("most", "share", "cores"), [(0, 0.1, 2), (MOST, 0.0, 2), (MOST, 0.1, 1)])
def test_there_are_those_who_always_sleep(monkeypatch, passes, most, share, cores):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    expectation = Expectation(most, share)
    for _ in range(5):
        passes(10**9)
        expectation.came(0, False)
        assert expectation.allowed == 0


def in_a_thread(work):
    """What `work` gives, in a thread of its own, whose affinity is its own too."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(work).result()


two_cores = pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="this process has one core")


@two_cores
def test_who_waits_does_not_run_on_the_core_of_its_writer_and_afterwards_everywhere():
    def wait():
        everywhere, writers = os.sched_getaffinity(0), current_core()
        aside = Aside()
        aside.begin()
        before_any = os.sched_getaffinity(0)
        aside.avoid(writers)
        waits, here = os.sched_getaffinity(0), current_core()
        aside.end()
        after = os.sched_getaffinity(0)
        aside.begin()
        return everywhere, writers, before_any, waits, here, after, os.sched_getaffinity(0)

    everywhere, writers, before_any, waits, here, after, again = in_a_thread(wait)
    assert before_any == everywhere, "of no writer it is known where that runs"
    assert waits == again == everywhere - {writers}
    assert here != writers
    assert after == everywhere


@two_cores
def test_a_writer_that_moves_is_left_again():
    def follow():
        first, second, *_ = everywhere = sorted(os.sched_getaffinity(0))
        aside = Aside()
        seen = []
        for core in (first, first, second, first):
            aside.avoid(core)
            seen.append((core, current_core(), os.sched_getaffinity(0)))
        return set(everywhere), seen

    everywhere, seen = in_a_thread(follow)
    for core, here, waits in seen:
        assert here != core
        assert waits == everywhere - {core}


@two_cores
def test_who_was_moved_by_somebody_else_meanwhile_stays_there():
    def wait():
        first = min(os.sched_getaffinity(0))
        aside = Aside()
        aside.avoid(first)
        os.sched_setaffinity(0, {first})
        aside.end()
        moved = os.sched_getaffinity(0)
        aside.begin()
        return first, moved, os.sched_getaffinity(0)

    first, moved, waits = in_a_thread(wait)
    assert moved == waits == {first}


def test_who_may_run_nowhere_else_stays(monkeypatch):
    def refuse(*_):
        raise AssertionError("moved")

    def stay():
        here = min(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {here})
        monkeypatch.setattr(os, "sched_setaffinity", refuse)
        aside = Aside()
        for core in (here, here + 1):
            aside.avoid(core)
            aside.end()

    in_a_thread(stay)


def test_a_core_that_is_taken_away_meanwhile_is_no_error(monkeypatch):
    def refuse(*_):
        raise OSError(errno.EINVAL, "Invalid argument")

    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    aside = Aside()
    aside.avoid(0)
    aside.end()


def test_it_steps_aside_only_where_it_may_stay_awake_and_data_come_when_they_are_due(passes):
    assert not Expectation(0, 0.1).is_worth_it
    expectation = Expectation(MOST, 0.1)
    assert expectation.is_worth_it
    expectation.came(100, True)
    assert not expectation.is_worth_it
    for _ in range(2):
        passes(10**8)
        expectation.came(0, False)
    assert expectation.is_worth_it
