"""From process to process: from a commit to the start of the processor that it triggers, beside the peers."""

import numpy as np
import pytest

from warploom.bench.contest import peer, record_figure
from warploom.bench.dora_peer import send_by_dora
from warploom.bench.transport_peers import WAYS, send_all

SIZES = {"1 kB": 1_000, "100 kB": 100_000, "2 MB": 2_000_000, "20 MB": 20_000_000}
COUNT, COUNT_OF_LONG = 150, 30
EVERY = 4e-3  # [s] between data, so that the receiver sleeps when one comes
GOAL = 200.0  # [µs] of the median, whatever the size


@pytest.mark.parametrize("way", [*WAYS, "dora-rs"])
@pytest.mark.parametrize("size", SIZES)
def bench_transport(benchmark, monkeypatch, tmp_path, size, way):
    """Sends data of one size by one way; the receiver sleeps in between, as between frames of a sensor.

    Midway between two data a bare message of 64 bytes goes to a process that does nothing else: what the machine takes
    in that minute to wake a process.
    """
    package = "dora" if way == "dora-rs" else WAYS[way].package
    if package:
        peer(package)
    monkeypatch.setenv("WARPLOOM_RUN", str(tmp_path))
    count = COUNT_OF_LONG if SIZES[size] > 2_000_000 else COUNT
    taken = []
    benchmark.extra_info.update(kernel="transport", on=f"{count} of {size}")

    def send():
        arguments = SIZES[size], count, EVERY
        taken.append((send_by_dora(*arguments), None) if way == "dora-rs" else send_all(way, *arguments))

    benchmark.pedantic(send, rounds=1)
    times, bare = taken[0]
    published, begun = (times / 1e3).T
    goal = GOAL if way.startswith("warploom") and "zenoh" not in way else None
    note = f"best {published.min():.0f}, p99 {np.percentile(published, 99):.0f}; {len(published)} of {count} arrived"
    if bare is not None:
        note += f"; a bare message in between {np.median(bare) / 1e3:.0f} (best {bare.min() / 1e3:.0f})"
    name = f"{way}, {size}, commit to processor, median"
    record_figure(benchmark, name, np.median(published), "µs", goal=goal, note=note)
    record_figure(
        benchmark,
        f"{way}, {size}, with the producer's copy, median",
        np.median(begun),
        "µs",
        note=f"best {begun.min():.0f}",
    )
