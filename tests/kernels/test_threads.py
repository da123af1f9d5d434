"""The parts of a kernel's work at once: all of it done, errors handed on, nested and from many threads."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from functools import partial

import numpy as np
import pytest
import warp as wp

from warploom.kernels.threads import (
    PackedLaunch,
    launch_parts,
    run_in_turn,
    run_together,
    set_thread_count,
    thread_count,
)


@wp.kernel
def _square_part(
    part: int,
    parts: int,
    # in
    values_in: wp.array(dtype=wp.int32),
    # out
    squares_out: wp.array(dtype=wp.int32),
):
    n = values_in.shape[0]
    for i in range(n * part / parts, n * (part + 1) / parts):
        squares_out[i] = values_in[i] * values_in[i]


@wp.kernel
def _add(number: int, counter: wp.array(dtype=wp.int32)):
    counter[0] = counter[0] + number


@pytest.mark.parametrize("parts", [1, 2, 3, 7])
def test_every_part_is_launched(parts):
    values = np.arange(1000, dtype=np.int32)
    squares = wp.zeros(1000, dtype=wp.int32, device="cpu")

    launch_parts(_square_part, parts, [wp.array(values, device="cpu")], [squares])

    np.testing.assert_array_equal(squares.numpy(), values**2)


def test_a_capture_records_every_part():
    values = np.arange(1000, dtype=np.int32)
    squares = wp.zeros(1000, dtype=wp.int32, device="cpu")
    given = wp.array(values, device="cpu")
    launch_parts(_square_part, 3, [given], [squares])
    with wp.ScopedCapture(device="cpu") as capture:
        launch_parts(_square_part, 3, [given], [squares])
    squares.zero_()

    wp.capture_launch(capture.graph)

    np.testing.assert_array_equal(squares.numpy(), values**2)


@pytest.mark.parametrize("parts", [1, 3])
def test_a_packed_launch_takes_what_changes(parts):
    squares = wp.zeros(1000, dtype=wp.int32, device="cpu")
    launch = PackedLaunch(_square_part, parts, [None], [squares])
    for length in (1000, 700, 3):
        values = np.arange(length, dtype=np.int32) + length
        squares.fill_(-1)

        launch.launch(values_in=wp.array(values, device="cpu"))

        np.testing.assert_array_equal(squares.numpy()[:length], values**2)
        assert (squares.numpy()[length:] == -1).all()
    other = wp.zeros(1000, dtype=wp.int32, device="cpu")
    launch.launch(values_in=wp.array(np.arange(9, dtype=np.int32), device="cpu"), squares_out=other)
    assert other.numpy()[8] == 64


def test_a_packed_launch_without_parts_and_in_a_capture():
    counter = wp.zeros(1, dtype=wp.int32, device="cpu")
    launch = PackedLaunch(_add, None, [None], [counter])
    launch.launch(number=2)
    launch.launch()
    launch.launch(number=5)
    assert counter.numpy()[0] == 9
    with wp.ScopedCapture(device="cpu") as capture:
        launch.launch(number=7)
    assert counter.numpy()[0] == 9

    wp.capture_launch(capture.graph)

    assert counter.numpy()[0] == 16
    with pytest.raises(KeyError, match="nothing"):
        launch.launch(nothing=1)


def test_calls_run_at_once():
    met = threading.Barrier(3, timeout=10)

    run_together([met.wait] * 3)

    assert not met.broken


def test_series_run_side_by_side_each_in_its_order():
    met, ran = threading.Barrier(2, timeout=10), {0: [], 1: []}

    def call(part, name):
        met.wait()
        ran[part].append((name, threading.get_ident()))

    run_in_turn(*([partial(call, part, name) for part in range(2)] for name in "abc"))

    for part in range(2):
        assert [name for name, _ in ran[part]] == ["a", "b", "c"]
        assert len({thread for _, thread in ran[part]}) == 1
    with pytest.raises(ValueError, match="zip"):
        run_in_turn([lambda: None], [lambda: None] * 2)


def test_an_error_is_handed_on_after_all_calls_have_ended():
    ended = []

    def fail():
        raise OSError("no such part")

    with pytest.raises(OSError, match="no such part"):
        run_together([lambda: ended.append(0), fail, lambda: ended.append(2)])

    assert sorted(ended) == [0, 2]


def test_calls_may_run_calls_of_their_own_and_come_from_many_threads():
    done = []

    def work():
        run_together([lambda: run_together([lambda: done.append(1)] * 4)] * 4)

    callers = [threading.Thread(target=work) for _ in range(8)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(timeout=30)

    assert len(done) == 8 * 16


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_process_gets_threads_of_its_own():
    run_together([lambda: None] * 2)
    met = threading.Barrier(2, timeout=10)
    child = os.fork()
    if child == 0:
        try:
            run_together([met.wait] * 2)
            os._exit(0)
        except BaseException:
            os._exit(1)

    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_the_thread_count_can_be_set():
    before = thread_count()
    try:
        set_thread_count(3)
        assert thread_count() == 3
        with pytest.raises(ValueError, match="count must be at least 1 thread, not 0"):
            set_thread_count(0)
    finally:
        set_thread_count(before)


@pytest.mark.parametrize(("text", "expected"), [("3", "3"), ("none", "must be a number of threads from 1, not 'none'")])
def test_the_environment_sets_the_thread_count(text, expected):
    ran = subprocess.run(
        [sys.executable, "-c", "from warploom.kernels.threads import thread_count; print(thread_count())"],
        env={**os.environ, "WARPLOOM_THREADS": text},
        capture_output=True,
        text=True,
        check=False,
    )

    assert expected in ran.stdout + ran.stderr
