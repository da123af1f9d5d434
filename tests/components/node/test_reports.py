"""What a process reports of itself: its run-time variables, and the statistics of its topics."""

import os
import threading

import pytest

from warploom.components.node.statistics import StatisticsReporter
from warploom.components.node.variables import VariableReporter
from warploom.dag import BacklogConfig, Trigger, TriggerConfig
from warploom.datamesh import CommitPolicy, DataMesh, Output
from warploom.datamesh.clock import ManualClock
from warploom.datamesh.messages.codec import decode, encode

SECOND = 1_000_000_000


def latest(mesh, topic):
    return mesh.window(topic).snapshot().last()


def test_the_variables_are_those_of_this_process():
    psutil = pytest.importorskip("psutil")
    mesh = DataMesh()
    reporter = VariableReporter("avar")
    reporter.bind(mesh, {"variables": "v"})
    reporter.process(Trigger(1))
    opened = [open(os.devnull) for _ in range(7)]  # noqa: SIM115
    blockers = [threading.Thread(target=threading.Event().wait, args=(0.5,)) for _ in range(3)]
    for thread in blockers:
        thread.start()
    reporter.process(Trigger(2))
    first, second = (mesh.window("v").snapshot()[k] for k in (0, 1))
    assert second.pid == os.getpid()
    assert second.threads >= first.threads + 3
    if second.descriptors >= 0:
        assert second.descriptors >= first.descriptors + 7
    # Within 30 %: other tests' garbage may come and go meanwhile.
    assert second.resident_mib == pytest.approx(psutil.Process().memory_info().rss / 2**20, rel=0.3)
    assert second.peak_mib >= 0.9 * second.resident_mib
    assert second.uptime_s >= first.uptime_s > 0
    assert reporter.state()["threads"] == second.threads
    assert decode(encode(second)) == second
    for file in opened:
        file.close()
    for thread in blockers:
        thread.join()


def test_before_the_first_report_there_is_no_state():
    assert VariableReporter("avar").state() == {}
    assert StatisticsReporter("statistics").state() == {}


@pytest.fixture
def watched():
    clock = ManualClock(100 * SECOND)
    mesh = DataMesh(window_capacity=4, clock=clock)
    output = Output()
    output.bind("a", mesh.window("a"))
    reporter = StatisticsReporter("statistics")
    reporter.bind(mesh, {"report": "s"})
    reporter.set_trigger(TriggerConfig(period_ms=1000), BacklogConfig(), "inline")
    reporter.start()
    yield clock, mesh, output, reporter
    reporter.stop()


def commit(output, version, received=None):
    with output.allocate_change() as change:
        change.set_version(version, received)
        change.value = version
        return output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)


def test_rates_latencies_and_losses_of_each_topic_in_each_period(watched):
    clock, mesh, output, reporter = watched
    for version in range(1, 6):
        now = clock.monotonic_ns()
        commit(output, version, now - 20_000_000 if now >= 20_000_000 else now)
        clock.advance(SECOND // 10)
    commit(output, 2)  # older than the newest: lost
    output.settle(9)
    clock.advance(SECOND // 2)
    report = latest(mesh, "s")
    row = next(row for row in report.topics if row.topic == "a")
    assert row.rate_hz == pytest.approx(5.0)
    assert (row.commits, row.settled) == (5, 1)
    assert row.latency_p99_ms == pytest.approx(20.0, rel=0.03)
    assert row.lost >= 1
    assert sum(report.losses["a"].values()) == row.lost
    clock.advance(SECOND)
    row = next(row for row in latest(mesh, "s").topics if row.topic == "a")
    assert row.rate_hz == 0.0
    assert row.commits == 5
    assert reporter.state()["topics"] == 2
    assert decode(encode(latest(mesh, "s"))).topics == latest(mesh, "s").topics


def test_a_topic_that_comes_later_is_watched_too(watched):
    clock, mesh, _, _ = watched
    clock.advance(SECOND)
    late = Output()
    late.bind("late", mesh.window("late"))
    clock.advance(SECOND)
    commit(late, 1)
    clock.advance(SECOND)
    row = next(row for row in latest(mesh, "s").topics if row.topic == "late")
    assert row.commits == 1
