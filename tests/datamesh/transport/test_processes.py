"""Topics between real processes, which are killed at any moment."""

import os
import time

import pytest

from warploom.datamesh.transport import exported_topics, reap, run_folder

CLOUD = 2_000_000
LIFE = 10_000_000  # versions from the beginning of one life to that of the next: more than it can commit


def descriptors(pid):
    return len(os.listdir(f"/proc/{pid}/fd"))


def shared_memory(pid):
    """The memories of topics that a process maps."""
    with open(f"/proc/{pid}/maps") as maps:
        return sum("memfd:warploom" in line for line in maps)


def is_zombie(pid):
    try:
        with open(f"/proc/{pid}/stat") as stat:
            return stat.read().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return False


def read_on(reader, count=3):
    """What a reader gets next, each whole."""
    got = [reader.wait_for("read") for _ in range(count)]
    assert all(one["whole"] for one in got), got
    return got


def orders(got):
    return [(one["epoch"], one["read"]) for one in got]


def test_what_one_process_commits_another_reads(peer):
    reader = peer("read", "reader", "cloud")
    reader.wait_for("ready")
    writer = peer("write", "writer", "cloud", 1, CLOUD, 5, 20)
    got = [reader.wait_for("read") for _ in range(20)]
    assert all(one["whole"] for one in got)
    assert orders(got) == [(0, version) for version in range(1, 21)]
    counters = writer.wait_for("counters")["counters"]["cloud"]
    assert counters["copied"] == 0
    assert counters["sent"] == 20


def kill_writers(peer, times):
    """A reader goes on while its producer is killed at any moment of its work, again and again."""
    reader = peer("read", "reader", "cloud")
    reader.wait_for("ready")
    last = (-1, -1)
    before = None
    for life in range(times):
        # Every third life begins anew at low versions, the others go on.
        first = 1 if life % 3 == 2 else LIFE * (life + 1)
        writer = peer("write", "writer", "cloud", first, CLOUD, 1, 100_000)
        writer.wait_for("ready")
        got = orders(read_on(reader))
        while not first <= got[0][1] < first + LIFE:  # of the life before
            got = orders(read_on(reader))
        assert got[0] > last
        time.sleep(0.001 * (life % 7))
        writer.kill()
        last = max(got)
        if life == 1:
            before = descriptors(reader.pid) - shared_memory(reader.pid)  # each memory that it still shows has one
    assert last[0] == times // 3
    one_being_connected = 1
    assert descriptors(reader.pid) - shared_memory(reader.pid) <= before + one_being_connected
    assert shared_memory(reader.pid) <= 1 + 8 + 1, "of lives of which it still shows something"
    assert exported_topics("node") == []
    assert reap("node") == [str(run_folder("node") / "links" / f"cloud.{kind}") for kind in ("socket", "order")]
    assert list((run_folder("node") / "links").iterdir()) == []


def kill_readers(peer, times):
    """A producer goes on while its reader is killed at any moment; what that held is free again."""
    writer = peer("write", "writer", "cloud", 1, CLOUD, 2, 100_000)
    writer.wait_for("ready")
    before = None
    for life in range(times):
        reader = peer("read", "reader", "cloud")
        read_on(reader)
        time.sleep(0.001 * (life % 7))
        reader.kill()
        assert not is_zombie(reader.pid)
        if life == 1:
            before = descriptors(writer.pid)
    writer.wait_for("committed")
    end = time.monotonic() + 10
    while descriptors(writer.pid) > before and time.monotonic() < end:
        time.sleep(0.01)
    assert descriptors(writer.pid) <= before
    assert shared_memory(writer.pid) == 1


def kill_relays(peer, times):
    """Three in a row: the one in the middle is killed; the last one sees each version at most once, in order."""
    last = peer("read", "last", "result")
    writer = peer("write", "writer", "cloud", 1, CLOUD, 4, 100_000)
    for one in (last, writer):
        one.wait_for("ready")
    got = []
    for life in range(times):
        relay = peer("relay", "relay", "cloud", "result")
        relay.wait_for("ready")
        got += orders(read_on(last))
        time.sleep(0.001 * (life % 7))
        relay.kill()
    assert got == sorted(set(got)), "in their order, and none twice"
    assert {epoch for epoch, _ in got} == {0}, "its versions go on, and so does the epoch"
    assert writer.process.poll() is None
    assert last.process.poll() is None


def kill_recorders(peer, times):
    """What is committed while the one that notes it is dead is kept for it: all is noted, in one of its lives."""
    # Of which 40 s fit into its memory: a recorder is back before, also on a machine that is busy.
    peer("write", "writer", "cloud", 1, 100_000, 20, 1_000_000).wait_for("ready")
    noted = set()
    for life in range(times + 1):
        recorder = peer("note", "recorder", "cloud")
        got = [recorder.wait_for("noted") for _ in range(5)]
        while got[-1]["late"] > 1.0 and (life % 3 == 0 or life == times):  # the others die before they have caught up
            got.append(recorder.wait_for("noted"))
        time.sleep(0.001 * (life % 7))
        recorder.kill()
        noted |= {one["noted"] for one in (*got, *recorder.rest()) if "noted" in one}  # it may say so before `ready`
    assert noted == set(range(min(noted), max(noted) + 1))


CAMPAIGNS = {"writer": kill_writers, "reader": kill_readers, "relay": kill_relays, "recorder": kill_recorders}


@pytest.mark.parametrize("who", CAMPAIGNS)
def test_whoever_is_killed_the_others_go_on(peer, who):
    CAMPAIGNS[who](peer, 3)


@pytest.mark.campaign
@pytest.mark.parametrize("who", CAMPAIGNS)
def test_whoever_is_killed_a_hundred_times_the_others_go_on(peer, who):
    CAMPAIGNS[who](peer, 100)


def test_nothing_is_left_when_all_are_killed_at_once(peer):
    before = set(os.listdir("/dev/shm"))
    peers = [peer("read", "reader", "cloud"), peer("write", "writer", "cloud", 1, CLOUD, 1, 100_000)]
    for one in peers:
        one.wait_for("ready")
    read_on(peers[0])
    for one in peers:
        one.kill()
    assert set(os.listdir("/dev/shm")) == before
    assert [os.path.basename(path) for path in reap("node")] == ["cloud.socket", "cloud.order"]
    assert reap("node") == []
    assert list((run_folder("node") / "links").iterdir()) == []


def test_two_nodes_side_by_side_do_not_meet(peer):
    """The same names of processes and topics, and runtime files in the same place."""
    readers = {node: peer("read", "reader", "cloud", of=node) for node in ("node", "other")}
    for one in readers.values():
        one.wait_for("ready")
    peer("write", "writer", "cloud", LIFE, 8000, 1, 100_000).wait_for("ready")
    peer("write", "writer", "cloud", 1, 8000, 1, 100_000, of="other").wait_for("ready")
    for node, first in (("node", LIFE), ("other", 1)):
        got = orders(read_on(readers[node], 10))
        assert all(epoch == 0 and first <= version < first + 100_000 for epoch, version in got)
