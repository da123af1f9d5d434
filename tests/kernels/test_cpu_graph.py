"""Recorded calls: what forks is replayed in full, at once and nested; nothing is left behind by a call that fails."""

import threading

import numpy as np
import pytest
import warp as wp

from warploom.kernels.cpu_graph import CpuGraph, is_alone
from warploom.kernels.threads import launch_parts, run_together


@wp.kernel
def _add_part(
    part: int,
    parts: int,
    # in
    values_in: wp.array(dtype=wp.int32),
    # in out
    sums: wp.array(dtype=wp.int32),
):
    n = values_in.shape[0]
    for i in range(n * part / parts, n * (part + 1) / parts):
        sums[i] = sums[i] + values_in[i]


def arrays(count, n=1000):
    values = wp.array(np.arange(n, dtype=np.int32), device="cpu")
    sums = [wp.zeros(n, dtype=wp.int32, device="cpu") for _ in range(count)]
    launch_parts(_add_part, 1, [values, wp.zeros(n, dtype=wp.int32, device="cpu")])
    return values, sums


@pytest.mark.parametrize("parts", [1, 2, 3, 7])
def test_every_part_is_replayed_once(parts):
    values, (sums,) = arrays(1)
    graph = CpuGraph(lambda: launch_parts(_add_part, parts, [values, sums]))
    assert not sums.numpy().any()
    for times in range(1, 4):
        graph.launch()
        np.testing.assert_array_equal(sums.numpy(), times * np.arange(1000))


def test_branches_may_fork_and_what_follows_waits_for_them():
    values, sums = arrays(3)

    def branch(number):
        def call():
            sums[number].zero_()
            launch_parts(_add_part, 3, [values, sums[number]])
            launch_parts(_add_part, 2, [sums[number], sums[number]])

        return call

    def call():
        values.fill_(1)
        run_together([branch(0), branch(1)])
        launch_parts(_add_part, 2, [sums[0], sums[1]])
        wp.copy(sums[2], sums[1])

    graph = CpuGraph(call)
    for _ in range(3):
        values.fill_(5)
        graph.launch()
        assert [set(array.numpy().tolist()) for array in (values, *sums)] == [{1}, {2}, {4}, {4}]


def test_a_call_that_fails_ends_the_recording():
    values, (sums,) = arrays(1)

    def fail():
        raise RuntimeError("no")

    with pytest.raises(RuntimeError, match="no"):
        CpuGraph(lambda: run_together([lambda: None, fail]))
    assert not wp.get_device("cpu").is_capturing
    launch_parts(_add_part, 2, [values, sums])
    np.testing.assert_array_equal(sums.numpy(), np.arange(1000))


def test_graphs_are_replayed_side_by_side():
    """Four threads, each with graphs of its own, twenty times each."""
    values, sums = arrays(4)
    graphs = [CpuGraph(lambda array=array: launch_parts(_add_part, 3, [values, array])) for array in sums]

    def work(graph):
        for _ in range(20):
            graph.launch()

    threads = [threading.Thread(target=work, args=(graph,)) for graph in graphs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for array in sums:
        np.testing.assert_array_equal(array.numpy(), 20 * np.arange(1000))


def test_another_thread_is_noticed():
    seen = []
    thread = threading.Thread(target=lambda: seen.append(is_alone()))
    thread.start()
    thread.join()
    assert seen == [False]
