"""From process to process: from a commit to the start of the processor that it triggers, beside the peers."""

import numpy as np
import pytest

from warploom.bench.contest import peer, record_figure
from warploom.bench.dora_peer import send_by_dora
from warploom.bench.transport_peers import WAYS, send_all

SIZES = {"1 kB": 1_000, "2 MB": 2_000_000, "20 MB": 20_000_000}
GOAL = 200.0  # [µs] of the median, whatever the size
EVERY = 4e-3  # [s] from one to the next: the receiver sleeps, and what it needs leaves the processor's caches
COUNT = 100
PACES = {"back to back": (0.0, 200), "1 kHz": (1e-3, 200), "10 Hz": (0.1, 20)}  # [s] from one to the next, and how many
SLEEPING = "warploom, spin_us: 0"  # what staying awake takes and gives is measured at other paces
PACED = ("warploom", SLEEPING, "zenoh", "iceoryx2", "POSIX shared memory")


@pytest.mark.parametrize("way", [*(way for way in WAYS if way != SLEEPING), "dora-rs"])
@pytest.mark.parametrize("size", SIZES)
def bench_transport(benchmark, monkeypatch, tmp_path, size, way):
    """Sends data of one size by one way, each after the one before has arrived and a pause of 4 ms.

    Midway between two data a bare message of 64 bytes goes to a process that does nothing else: what the machine takes
    in that minute to wake a process.
    """
    _measure(benchmark, monkeypatch, tmp_path, way, size, EVERY, COUNT, size)


@pytest.mark.parametrize("way", PACED)
@pytest.mark.parametrize("pace", PACES)
def bench_transport_paces(benchmark, monkeypatch, tmp_path, pace, way):
    """The same for 2 MB at other paces: streams in which more stays in the caches, and the pace of a LiDAR."""
    every, count = PACES[pace]
    _measure(benchmark, monkeypatch, tmp_path, way, "2 MB", every, count, f"2 MB, {pace}")


def _measure(benchmark, monkeypatch, tmp_path, way, size, every, count, on):
    package = "dora" if way == "dora-rs" else WAYS[way].package
    if package:
        peer(package)
    monkeypatch.setenv("WARPLOOM_RUN", str(tmp_path))
    taken = []
    benchmark.extra_info.update(kernel="transport", on=f"{count} of {on}")

    def send():
        arguments = SIZES[size], count, every
        taken.append((send_by_dora(*arguments), None, None) if way == "dora-rs" else send_all(way, *arguments))

    benchmark.pedantic(send, rounds=1)
    times, bare, share = taken[0]
    if not len(times):
        pytest.skip(f"{way}: none of {count} data of {on} arrived")
    published, begun = (times / 1e3).T
    goal = GOAL if way == "warploom" else None
    note = f"best {published.min():.0f}, p99 {np.percentile(published, 99):.0f}; {len(published)} of {count} arrived"
    if bare is not None:
        message = np.median(bare) / 1e3
        note += f"; {np.median(published) / message:.1f} × a bare message in between, {message:.0f}"
        note += f" (best {bare.min() / 1e3:.0f})"
    record_figure(
        benchmark, f"{way}, {on}, commit to processor, median", np.median(published), "µs", goal=goal, note=note
    )
    record_figure(
        benchmark,
        f"{way}, {on}, with the producer's copy, median",
        np.median(begun),
        "µs",
        note=f"best {begun.min():.0f}",
    )
    if share is not None:
        record_figure(benchmark, f"{way}, {on}, the receiver's share of a core", 100 * share, "%")
