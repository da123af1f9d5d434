"""Counters and histograms, against NumPy's quantiles of the same values."""

import threading

import numpy as np
import pytest

from warploom.dag import VertexTiming
from warploom.dag.metrics import Histogram, Metrics
from warploom.datamesh import CommitPolicy, DataMesh, Output, Status


@pytest.mark.parametrize("seed", range(4))
def test_quantiles_are_within_two_percent_of_the_values(seed):
    rng = np.random.default_rng(seed)
    values = np.exp(rng.normal(rng.uniform(-3, 5), rng.uniform(0.1, 2.0), 20_000))
    histogram = Histogram()
    for value in values:
        histogram.observe(float(value))
    for q in (0.0, 0.1, 0.5, 0.9, 0.99, 0.999):
        exact = np.quantile(values, q, method="inverted_cdf")
        assert histogram.quantile(q) == pytest.approx(exact, rel=0.0201)
    assert histogram.quantile(1.0) == pytest.approx(values.max(), rel=0.0201)
    assert histogram.max == values.max()
    assert histogram.count == len(values)
    assert histogram.total == pytest.approx(values.sum())
    for bound in (0.01, 1.0, 100.0):
        assert histogram.below(bound * 0.96) <= (values <= bound).sum() <= histogram.below(bound * 1.04)


def test_an_empty_histogram_and_extreme_values():
    histogram = Histogram()
    assert np.isnan(histogram.quantile(0.5))
    assert histogram.as_dict() == {"count": 0}
    for value in (-1.0, 0.0, 1e-9, 1e12):
        histogram.observe(value)
    assert histogram.quantile(0.5) <= 1e-3
    assert histogram.as_dict()["max"] == 1e12
    with pytest.raises(ValueError, match="between 0 and 1"):
        histogram.quantile(1.5)


def commit(mesh, topic, version, received_ns):
    output = Output()
    output.bind(topic, mesh.window(topic))
    with output.allocate_change() as change:
        change.set_version(version, received_ns)
        change.value = version
        output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)


def test_commits_losses_and_the_latency_from_reception_are_counted():
    mesh, metrics = DataMesh(), Metrics()
    metrics.watch(mesh, ["a", "b"])
    for version in range(10):
        commit(mesh, "a", version, mesh.clock.monotonic_ns() - 50_000_000)
    commit(mesh, "a", 3, 0)
    mesh.window("b").settle(4)
    told = metrics.as_dict()
    assert told["commits"] == {"a": 10}
    assert told["settled"] == {"b": 1}
    assert told["losses"] == {"a": {"duplicate": 1}}
    assert told["latency_ms"]["a"]["count"] == 10
    assert told["latency_ms"]["a"]["p50"] > 48, "the reception was 50 ms before the commit"
    assert told["latency_ms"]["b"] == {"count": 0}


def test_runs_of_vertices_are_counted_by_status_from_any_thread():
    metrics = Metrics()

    def run(status):
        for version in range(250):
            metrics.on_timing(VertexTiming("c", "v", version, 1_000_000, 3_000_000, 7_000_000, status))

    threads = [threading.Thread(target=run, args=(status,)) for status in [Status.OK] * 3 + [Status.FAILED]]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    told = metrics.as_dict()
    assert told["runs"] == {"c.v": {"failed": 250, "ok": 750}}
    assert told["wait_ms"]["c.v"]["p50"] == pytest.approx(2.0, rel=0.02)
    assert told["run_ms"]["c.v"]["p99"] == pytest.approx(4.0, rel=0.02)
    assert told["run_ms"]["c.v"]["count"] == 1000


def test_the_text_for_prometheus_has_cumulative_buckets():
    mesh, metrics = DataMesh(), Metrics()
    metrics.watch(mesh, ['odd"topic'])
    for wait in (0.05, 0.2, 3.0, 30.0, 9999.0):
        metrics.on_timing(VertexTiming("c", "v", 1, 0, int(wait * 1e6), int(wait * 1e6) + 1000, Status.OK))
    mesh.losses.count("c", "backlog", 1, 4)
    commit(mesh, 'odd"topic', 1, mesh.clock.monotonic_ns())
    lines = metrics.prometheus().splitlines()
    assert 'warploom_commits_total{topic="odd\\"topic"} 1' in lines
    assert 'warploom_losses_total{place="c",reason="backlog"} 4' in lines
    assert 'warploom_vertex_runs_total{vertex="c.v",status="ok"} 5' in lines
    counts = [int(line.split()[-1]) for line in lines if line.startswith("warploom_vertex_wait_milliseconds_bucket")]
    assert counts == sorted(counts)
    assert (counts[0], counts[-1]) == (1, 5)
    assert 'warploom_vertex_wait_milliseconds_count{vertex="c.v"} 5' in lines
