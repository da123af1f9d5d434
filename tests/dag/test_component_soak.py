"""Eight threads commit to a chain of graphs under random delays: every frame ends once, and every loss is counted."""

import itertools
import random
import threading
import time

import pytest
from component_parts import dag

from warploom.dag import BacklogConfig, DagComponent, MonotonicDagComponent
from warploom.datamesh import DataMesh, Status

pytestmark = pytest.mark.usefixtures("no_thread_left")
THREADS, FEWEST = 8, 20


def run(topic, seconds, seed, backlog, hand_off):
    """What was kept of the commits, the result's topic, the losses, and the versions that were made to fail."""
    mesh, failed, lock = DataMesh(window_capacity=64), [], threading.Lock()
    chance = random.Random(seed)

    def act(trigger, value):
        with lock:
            delay, fails = chance.random() * 3e-4, chance.random() < 0.05
        if delay > 1e-4:
            time.sleep(delay)
        if fails:
            failed.append(trigger.version)
            raise RuntimeError("made to fail")
        return value

    backlog = BacklogConfig(policy=backlog, depth=8)
    names = {"workers": 2, "backlog": backlog, "hand_off": hand_off}
    first = dag(mesh, act, act, topics=("input", "middle"), in_flight=2, kind=DagComponent, name="first", **names)
    last = dag(mesh, act, topics=("middle", "output"), kind=MonotonicDagComponent, name="last", **names)
    source, result = topic(mesh.window("input")), topic(mesh.window("output"))
    versions, kept = itertools.count(1), []

    def commit(number):
        jitter = random.Random(seed * 100 + number)
        end = time.monotonic() + seconds
        # On a machine with much else to do, for as long as it takes to see something.
        while time.monotonic() < end or (len(kept) <= FEWEST and time.monotonic() < end + 30):
            version = next(versions)
            time.sleep(jitter.random() * 2e-3)
            status = source.commit(version, version)
            with lock:
                kept.extend([version] * (status is Status.OK))

    last.start()
    first.start()
    threads = [threading.Thread(target=commit, args=(number,)) for number in range(THREADS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(seconds + 60)
    first.stop()
    last.stop()
    return kept, result, mesh.losses.as_dict(), failed


def check(topic, seconds, seed, backlog, hand_off):
    kept, result, losses, failed = run(topic, seconds, seed, backlog, hand_off)
    assert len(kept) > FEWEST
    assert set(kept) <= set(result.events), "what was kept was committed or settled to the end"
    assert list(result.entries) == sorted(result.entries), "in the order of versions"
    assert all(result.entries[version] == version for version in result.entries)
    assert not set(result.entries) & set(result.settled)
    assert sum(reasons.get("failed", 0) for reasons in losses.values()) == len(failed)
    lost = sum(sum(reasons.values()) for place, reasons in losses.items() if place != "input")
    assert len(kept) == len(result.entries) + lost, "what did not come out was counted, once"
    if backlog == "block":
        assert lost == len(failed), "and nothing but what failed was lost"


CASES = [("latest", "thread"), ("fifo", "thread"), ("block", "thread"), ("fifo", "inline"), ("block", "inline")]


@pytest.mark.parametrize(("backlog", "hand_off"), CASES)
def test_every_frame_of_eight_threads_ends_once_and_every_loss_is_counted(backlog, hand_off, topic, caplog):
    caplog.set_level("CRITICAL")
    check(topic, 0.5, 1, backlog, hand_off)


@pytest.mark.campaign
@pytest.mark.parametrize(("backlog", "hand_off"), CASES)
def test_the_same_for_a_minute_in_all(backlog, hand_off, topic, caplog):
    caplog.set_level("CRITICAL")
    check(topic, 12.0, 2, backlog, hand_off)
