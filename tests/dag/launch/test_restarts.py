from hypothesis import given
from hypothesis import strategies as st

from warploom.dag.launch.restarts import Restarts
from warploom.dag.launch.schema import BackOffSpec, RestartsSpec


def restarts(limit=5, window=60.0, **back_off):
    return Restarts(BackOffSpec(**back_off), RestartsSpec(limit=limit, window_s=window))


def test_waits_grow_by_the_factor_up_to_the_longest():
    one = restarts(first_s=0.5, factor=2.0, max_s=3.0)
    assert [one.died(float(t)) for t in range(6)] == [0.5, 1.0, 2.0, 3.0, 3.0, None]
    assert one.count == 5


def test_deaths_outside_the_window_count_no_more():
    one = restarts(limit=1, window=10.0, first_s=0.5)
    assert one.died(0.0) == 0.5
    assert one.died(10.0) == 0.5
    assert one.died(19.9) is None


def test_without_restarts_the_first_death_is_the_end():
    assert restarts(limit=0).died(0.0) is None


@given(
    deaths=st.lists(st.integers(0, 100), min_size=1, max_size=60),  # whole seconds, whose differences are exact
    limit=st.integers(0, 10),
    window=st.integers(1, 50),
    factor=st.floats(1.0, 100.0),
)
def test_never_more_restarts_within_the_window_than_the_limit(deaths, limit, window, factor):
    one = restarts(limit=limit, window=window, factor=factor, first_s=0.5, max_s=30.0)
    allowed = []
    for now in sorted(deaths):
        wait = one.died(now)
        # Counted here from the definition: the deaths of the last `window` seconds, this one included.
        within = sum(now - window < t <= now for t in sorted(deaths)[: len(allowed) + 1])
        allowed.append(wait is not None)
        assert (wait is not None) == (within <= limit)
        assert wait is None or 0.5 <= wait <= 30.0


def test_many_deaths_overflow_nothing():
    one = restarts(limit=10_000, window=86400.0, factor=100.0, max_s=7.0)
    assert {one.died(0.0) for _ in range(5000)} == {0.5, 7.0}
