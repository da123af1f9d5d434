"""Clocks: calls come when they are due, in order; the manual one moves by hand and can be set back."""

import threading
import time

import pytest

from warploom.datamesh import ManualClock, SystemClock

WAIT = 20.0
MS = 1_000_000


def test_a_manual_clock_calls_in_the_order_in_which_calls_are_due_each_at_its_time():
    clock, calls = ManualClock(1000), []
    for due in (300, 100, 200, 400):
        clock.call_at(due, lambda due=due: calls.append((due, clock.monotonic_ns(), clock.now_ns())))
    clock.advance(300)
    assert calls == [(100, 100, 1100), (200, 200, 1200), (300, 300, 1300)]
    clock.advance(99)
    assert len(calls) == 3
    clock.advance(1)
    assert calls[-1][0] == 400


def test_calls_made_by_calls_are_within_the_same_advance():
    clock, calls = ManualClock(), []

    def again():
        calls.append(clock.monotonic_ns())
        clock.call_at(clock.monotonic_ns() + 10, again)

    clock.call_at(10, again)
    clock.advance(35)
    assert calls == [10, 20, 30]


def test_a_step_moves_the_time_of_versions_and_makes_no_call():
    clock, calls = ManualClock(1000), []
    clock.call_at(10, lambda: calls.append(1))
    clock.step(-500)
    assert (clock.now_ns(), clock.monotonic_ns(), calls) == (500, 0, [])
    clock.step(10_000)
    assert (clock.now_ns(), calls) == (10_500, [])


def test_time_does_not_go_back_by_an_advance():
    with pytest.raises(ValueError, match="by_ns must be >= 0, not -1"):
        ManualClock().advance(-1)


@pytest.mark.parametrize("make", [ManualClock, SystemClock])
def test_a_cancelled_call_is_not_made_and_one_that_raises_disturbs_no_other(make, caplog):
    clock, calls, last = make(), [], threading.Event()
    start = clock.monotonic_ns()
    clock.call_at(start + 2 * MS, lambda: calls.append("cancelled")).cancel()
    clock.call_at(start + 3 * MS, lambda: 1 // 0)
    clock.call_at(start + 4 * MS, last.set)
    if isinstance(clock, ManualClock):
        clock.advance(4 * MS)
    assert last.wait(WAIT)
    assert calls == []
    assert "ZeroDivisionError" in caplog.text


def test_the_systems_clock_calls_not_before_it_is_due_and_leaves_no_thread():
    clock, calls, done = SystemClock(), [], threading.Event()
    start = clock.monotonic_ns()

    def call(due, last):
        calls.append((due, clock.monotonic_ns() - start))
        if last:
            done.set()

    def schedule():  # in the clock's thread, so that none is made before all are known, however busy the machine is
        for due in (20 * MS, 5 * MS, 10 * MS):
            clock.call_at(start + due, lambda due=due: call(due, due == 20 * MS))

    clock.call_at(start, schedule)
    assert done.wait(WAIT)
    assert [due for due, _ in calls] == [5 * MS, 10 * MS, 20 * MS]
    assert all(at >= due for due, at in calls)
    until = time.monotonic() + WAIT
    while clock._thread is not None and time.monotonic() < until:
        time.sleep(0.001)
    assert clock._thread is None
    again = threading.Event()
    clock.call_at(clock.monotonic_ns(), again.set)
    assert again.wait(WAIT)


@pytest.mark.parametrize("make", [ManualClock, SystemClock])
def test_a_tidy_clock_keeps_what_is_due_and_no_thread_for_what_is_not(make):
    clock, called = make(), threading.Event()
    start = clock.monotonic_ns()
    far = [clock.call_at(start + 3600 * 1000 * MS, lambda: None) for _ in range(100)]
    clock.call_at(start + 5 * MS, called.set)
    for timer in far:
        timer.cancel()
    clock.tidy()
    assert len(clock._due) <= 1
    if make is ManualClock:
        clock.advance(5 * MS)
    assert called.wait(WAIT)
    clock.tidy()
    assert make is ManualClock or clock._thread is None


def test_a_stopped_clock_makes_no_call_that_was_due():
    clock, calls = SystemClock(), []
    clock.call_at(clock.monotonic_ns() + 3600 * 1000 * MS, lambda: calls.append(1))
    thread = clock._thread
    clock.stop()
    assert not thread.is_alive()
    assert calls == []
