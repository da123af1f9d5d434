"""What a contest writes beside a time, with a timer that only counts."""

import numpy as np
import pytest

from warploom.bench.contest import ONE_THREAD, Contender, Contest, SelfTimed, contenders, peer, record_score
from warploom.kernels.threads import set_thread_count, thread_count


class Timer:
    """As pytest-benchmark's fixture is used here."""

    def __init__(self):
        self.extra_info = {}
        self.group = None
        self.calls = 0

    def __call__(self, call):
        for _ in range(5):
            call()
        self.calls = 5

    def pedantic(self, call, rounds):
        for _ in range(rounds):
            call()
        self.calls = rounds


@pytest.fixture
def two_threads():
    before = thread_count()
    set_thread_count(2)
    yield
    set_thread_count(before)


def run(contender, calls, **options):
    timer = Timer()
    Contest(timer, None).run(contender, calls, kernel="k", on="x", size=3, **options)
    return timer


CALLS = {"warploom": lambda device: lambda: 1, "scipy": lambda device: lambda: 2}


@pytest.mark.usefixtures("two_threads")
def test_ours_may_use_the_threads_that_kernels_may_use():
    info = run(Contender("warploom"), CALLS, how="asked for").extra_info
    assert info["threads"] == 2
    assert info["how"] == "asked for"
    assert "goal" not in info


@pytest.mark.usefixtures("two_threads")
def test_a_peer_has_its_own_threads_its_goal_and_how_it_agrees_with_ours():
    agree = "{} is not {}".format
    info = run(Contender("scipy"), CALLS, agree=agree, goals={"scipy": 0.1}, threads={"open3d": 2}).extra_info
    assert (info["threads"], info["goal"], info["accuracy"]) == (1, 0.1, "1 is not 2")


@pytest.mark.usefixtures("two_threads")
def test_one_thread_is_the_function_with_one_and_leaves_the_number_as_it_was():
    seen = []

    def prepare(device):
        seen.append(thread_count())
        return lambda: seen.append(thread_count())

    info = run(Contender(ONE_THREAD), {"warploom": prepare}).extra_info
    assert len(seen) > 5
    assert set(seen) == {1}
    assert (info["who"], info["threads"]) == (ONE_THREAD, 1)
    assert thread_count() == 2


def test_one_thread_is_skipped_where_there_is_no_more():
    before = thread_count()
    set_thread_count(1)
    try:
        with pytest.raises(pytest.skip.Exception, match="one CPU thread is all"):
            run(Contender(ONE_THREAD), CALLS)
    finally:
        set_thread_count(before)


def test_a_timer_of_the_peers_own_counts_the_timed_calls_alone():
    ticks = iter(range(1, 1_000_000))
    timed = SelfTimed(lambda: None, lambda: float(next(ticks)))
    timer = run(Contender("scipy"), {"scipy": lambda device: timed})
    assert len(timed.taken) == timer.calls == 5
    assert timer.extra_info["own_timer_s"] == np.median(timed.taken) > 5  # calls before these were only watched


def test_who_is_ours():
    ours = [
        parameter.values[0].who for parameter in contenders("scipy", one_thread=True) if parameter.values[0].is_ours
    ]
    assert ours == ["warploom", "warploom plan", ONE_THREAD, "warploom", "warploom plan"]
    assert ONE_THREAD not in [parameter.values[0].who for parameter in contenders("scipy")]


def test_a_peer_that_is_not_installed_is_skipped_by_its_name():
    with pytest.raises(pytest.skip.Exception, match="abacus-py cannot be imported here"):
        peer("abacus", "abacus-py")


def test_scores_are_plain_numbers():
    timer = Timer()
    record_score(timer, "f1", on="x", ours=np.float32(1), theirs=None, peer="p", unit="%")
    (score,) = timer.extra_info["scores"]
    assert type(score["ours"]) is float
    assert score["theirs"] is None
