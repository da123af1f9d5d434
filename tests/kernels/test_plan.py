"""Plans are kept between calls, one of each kind for a thread."""

import threading
from dataclasses import dataclass

import pytest

from warploom.kernels.plan import capacity_for, plan_for
from warploom.kernels.threads import set_thread_count, thread_count


@dataclass(frozen=True, kw_only=True)
class Plan:
    capacity: int
    device: str = "cpu"


@pytest.mark.parametrize(("count", "capacity"), [(0, 1024), (1, 1024), (1024, 1024), (1025, 2048), (124_500, 131_072)])
def test_capacity_is_the_next_power_of_two(count, capacity):
    assert capacity_for(count) == capacity


def test_the_same_configuration_gives_the_same_plan():
    plan = plan_for(Plan, capacity=8, device="cpu")
    assert plan_for(Plan, device="cpu", capacity=8) is plan
    assert plan_for(Plan, capacity=16, device="cpu") is not plan


def test_each_thread_has_its_own():
    plans = [plan_for(Plan, capacity=32)]
    thread = threading.Thread(target=lambda: plans.append(plan_for(Plan, capacity=32)))
    thread.start()
    thread.join()
    assert plans[0] is not plans[1]


def test_another_number_of_threads_gives_another_plan():
    plan = plan_for(Plan, capacity=64)
    before = thread_count()
    set_thread_count(before + 1)
    try:
        assert plan_for(Plan, capacity=64) is not plan
    finally:
        set_thread_count(before)
    assert plan_for(Plan, capacity=64) is plan


def test_the_least_recently_used_is_let_go():
    kept, dropped = plan_for(Plan, capacity=1), plan_for(Plan, capacity=2)
    for capacity in range(100, 140):
        plan_for(Plan, capacity=capacity)
        plan_for(Plan, capacity=1)
    assert plan_for(Plan, capacity=1) is kept
    assert plan_for(Plan, capacity=2) is not dropped


def test_a_plan_that_refuses_is_not_kept():
    with pytest.raises(TypeError):
        plan_for(Plan, size=3)
    with pytest.raises(TypeError):
        plan_for(Plan, size=3)
