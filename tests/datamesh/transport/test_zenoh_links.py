"""Topics between hosts: two meshes that only know each other by zenoh, over the loopback of this machine."""

import os
import socket
import threading
import time
import uuid

import numpy as np
import pytest

from warploom.datamesh import CommitPolicy, Miss, Outcome
from warploom.datamesh.transport import ZenohConfig
from warploom.datamesh.transport.wire import read_event
from warploom.datamesh.transport.zenoh_links import ZenohSession
from warploom.errors import ConfigError

zenoh = pytest.importorskip("zenoh")

REMOTE = {"topic": "zenoh"}


@pytest.fixture
def endpoint():
    """An endpoint of this machine that is free."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{one.getsockname()[1]}"


def config(**options):
    """Of a session that finds nobody by itself."""
    return ZenohConfig(scouting=False, **{"listen": ("tcp/127.0.0.1:0",), **options})


@pytest.fixture
def hosts(side, endpoint):
    """A writer and a reader in nodes of their own, of one domain, connected by zenoh alone."""

    def make(**options):
        writer = side(
            "writer",
            of="here",
            exports=["topic"],
            remote=REMOTE,
            zenoh=config(listen=(endpoint,), domain="car", **options),
        )
        reader = side(
            "reader",
            of="there",
            imports=["topic"],
            remote=REMOTE,
            zenoh=config(connect=(endpoint,), domain="car", **options),
        )
        writer.until(lambda counts: counts["remote_readers"] == 1, "topic")
        reader.until(lambda counts: counts["connected"] == 1, "topic")
        return writer, reader

    return make


def received(reader, count):
    reader.until(lambda counts: counts.get("received", 0) >= count, "topic")
    return reader.mesh.window("topic").snapshot()


@pytest.fixture
def multicast():
    """Skips where hosts cannot find each other: zenoh alone, as it comes, is asked."""
    try:
        with zenoh.open(zenoh.Config()) as one, zenoh.open(zenoh.Config()) as other:
            end = time.monotonic() + 5
            while other.info.zid() not in list(one.info.peers_zid()):
                if time.monotonic() > end:
                    pytest.skip("no multicast on this network: zenoh's own sessions do not find each other")
                time.sleep(0.01)
    except zenoh.ZError as error:
        pytest.skip(f"zenoh does not start as it comes: {error}")


@pytest.mark.usefixtures("multicast")
def test_hosts_without_any_configuration_find_each_other(side):
    domain = uuid.uuid4().hex  # others may be on this network
    writer = side("writer", of="here", exports=["topic"], remote=REMOTE, zenoh=ZenohConfig(domain=domain))
    reader = side("reader", of="there", imports=["topic"], remote=REMOTE, zenoh=ZenohConfig(domain=domain))
    writer.until(lambda counts: counts["remote_readers"] == 1, "topic")
    reader.until(lambda counts: counts["connected"] == 1, "topic")
    writer.commit("topic", 1, "found")
    assert received(reader, 1).last() == "found"


def test_what_one_host_commits_another_reads(hosts):
    writer, reader = hosts()
    cloud = np.arange(300_000, dtype=np.float32).reshape(-1, 4)
    writer.commit("topic", 5, {"cloud": cloud, "frame": "lidar"})
    snapshot = received(reader, 1)
    assert snapshot.versions == (5,)
    np.testing.assert_array_equal(snapshot.last()["cloud"], cloud)
    assert not snapshot.last()["cloud"].flags.writeable


def test_times_are_put_on_the_readers_clock(hosts):
    """Both meshes have the same clock here, so the times are the same, but for what reading two clocks takes."""
    writer, reader = hosts()
    received_ns = writer.mesh.clock.monotonic_ns() - 50_000_000
    output = writer.output("topic")
    with output.allocate_change() as change:
        change.set_version(5, received_ns)
        change.value = "five"
        output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)
    entry = received(reader, 1).entry(0)
    there = writer.mesh.window("topic").snapshot().entry(0)
    assert abs(entry.received_ns - received_ns) < 20_000_000
    assert abs(entry.committed_ns - there.committed_ns) < 20_000_000
    assert entry.committed_ns <= reader.mesh.clock.monotonic_ns()


def test_settles_misses_epochs_and_late_ones_cross(hosts):
    writer, reader = hosts()
    wait = reader.input("topic").when(20, lambda _: None)
    for version in (10, 30):
        writer.commit("topic", version, version)
    writer.output("topic").settle(20)
    writer.commit("topic", 15, 15, CommitPolicy.INSERT_SORTED)
    snapshot = received(reader, 4)
    assert wait.outcome is Outcome.SETTLED_EMPTY
    assert snapshot.miss(20) is Miss.SETTLED_EMPTY
    assert snapshot.versions == (10, 15, 30)
    assert reader.commits["topic"] == [(0, 10, True), (0, 30, True), (0, 15, False)]
    writer.output("topic").new_epoch()
    writer.commit("topic", 1, 1)
    snapshot = received(reader, 5)
    assert (snapshot.epoch, snapshot.versions) == (1, (1,))


def test_a_reader_that_comes_later_is_given_the_newest_which_does_not_trigger(side, endpoint):
    writer = side("writer", of="here", exports=["topic"], remote=REMOTE, zenoh=config(listen=(endpoint,), domain="car"))
    for version in (1, 2):
        writer.commit("topic", version, version)
    time.sleep(0.01)
    reader = side(
        "reader", of="there", imports=["topic"], remote=REMOTE, zenoh=config(connect=(endpoint,), domain="car")
    )
    received(reader, 1)
    assert reader.commits["topic"] == [(0, 2, False)]
    writer.commit("topic", 3, 3)
    received(reader, 2)
    assert reader.commits["topic"] == [(0, 2, False), (0, 3, True)]


def test_a_producer_that_comes_back_at_lower_versions_begins_an_epoch(side, endpoint):
    reader = None
    for life in range(2):
        writer = side(
            "writer", of="here", exports=["topic"], remote=REMOTE, zenoh=config(listen=(endpoint,), domain="car")
        )
        if reader is None:
            reader = side(
                "reader", of="there", imports=["topic"], remote=REMOTE, zenoh=config(connect=(endpoint,), domain="car")
            )
        writer.until(lambda counts: counts["remote_readers"] == 1, "topic")
        writer.commit("topic", 100 - life, life)
        assert received(reader, life + 1).epoch == life
        writer.links.stop()
        reader.until(lambda counts: counts["connected"] == 0, "topic")
    assert [order[:2] for order in reader.commits["topic"]] == [(0, 100), (1, 99)]


def test_a_reader_that_hangs_loses_the_oldest_and_they_are_counted(hosts):
    writer, reader = hosts(queue=3, history=False)  # else the first may come twice, as the newest too
    hangs, go_on = threading.Event(), threading.Event()

    def hang(_):
        hangs.set()
        go_on.wait(30)

    reader.mesh.window("topic").subscribe(hang, lambda *_: None)
    try:
        writer.commit("topic", 1, 1)
        assert hangs.wait(30)
        for version in range(2, 21):
            writer.commit("topic", version, version)
            writer.until(lambda counts, sent=version: counts["sent"] == sent, "topic")  # else its queue drops some
            reader.until(lambda counts, slow=version - 4: counts.get("slow", 0) >= slow, "topic")
        assert reader.counts("topic")["slow"] == 16
    finally:
        go_on.set()
    assert received(reader, 4).versions == (1, 18, 19, 20)
    assert reader.counts("topic")["missed"] == 16
    assert reader.mesh.losses["topic", "link_missed"] == 16


def test_while_a_link_stands_still_commits_go_on_and_what_is_dropped_is_counted(side, endpoint):
    """A host that takes nothing more holds the link up; zenoh by itself would drop what comes, and tell nobody."""
    here, there = config(listen=(endpoint,), domain="car", queue=4), config(connect=(endpoint,), domain="car", queue=99)
    stands, go_on, read = threading.Event(), threading.Event(), []

    def hold(sample):
        stands.set()
        go_on.wait(30)
        read.append(sample.payload.to_bytes())

    def numbers():
        return [read_event(data[16:], 0).number for data in read]

    writer = side("writer", of="here", exports=["topic"], remote=REMOTE, zenoh=here)
    session = ZenohSession(there, node="there")
    subscriber = session.session.declare_subscriber(session.key("topic"), hold)
    try:
        writer.until(lambda counts: counts["remote_readers"] == 1, "topic")
        writer.commit("topic", 1, "first")
        assert stands.wait(30)
        for version in range(2, 42):
            writer.commit("topic", version, np.zeros(4 << 20, np.uint8))  # 160 MB: more than sockets hold
        slow = writer.counts("topic")["slow"]
        assert 0 < slow < 40
        assert writer.mesh.losses["topic", "link_slow"] == slow
        go_on.set()
        writer.wait(lambda: numbers()[-1:] == [41], numbers)
        assert writer.counts("topic") == {**writer.counts("topic"), "sent": 41 - slow, "slow": slow}
        assert len(numbers()) == 41 - slow
        assert numbers() == sorted(set(numbers()))
    finally:
        go_on.set()
        subscriber.undeclare()
        session.close()


def test_what_waits_is_sent_before_the_writer_ends(side, endpoint):
    writer = side("writer", of="here", exports=["topic"], remote=REMOTE, zenoh=config(listen=(endpoint,), domain="car"))
    reader = side(
        "reader",
        of="there",
        imports=["topic"],
        remote=REMOTE,
        zenoh=config(connect=(endpoint,), domain="car", history=False),
    )
    writer.until(lambda counts: counts["remote_readers"] == 1, "topic")
    for version in range(1, 7):
        writer.commit("topic", version, np.zeros(1 << 20, np.uint8))
    writer.links.stop()
    assert received(reader, 6).versions == (1, 2, 3, 4, 5, 6)


def test_a_payload_that_no_message_can_hold_is_counted(hosts):
    writer, reader = hosts()
    writer.commit("topic", 1, object())
    writer.commit("topic", 2, "whole")
    assert received(reader, 1).versions == (2,)
    assert writer.mesh.losses["topic", "link_not_encodable"] == 1


@pytest.mark.parametrize("data", [b"", b"x" * 10, b"x" * 100])
def test_what_is_no_message_is_counted_and_the_next_is_read(hosts, data):
    writer, reader = hosts()
    session = writer.links._session
    session.session.put(session.key("topic"), data)
    reader.until(lambda counts: counts.get("damaged", 0) == 1, "topic")
    writer.commit("topic", 1, "whole")
    assert received(reader, 1).versions == (1,)


def test_domains_do_not_meet(side, endpoint):
    writer = side("writer", of="here", exports=["topic"], remote=REMOTE, zenoh=config(listen=(endpoint,), domain="car"))
    same, other = (
        side(name, of="there", imports=["topic"], remote=REMOTE, zenoh=config(connect=(endpoint,), domain=domain))
        for name, domain in (("same", "car"), ("other", ""))
    )
    writer.until(lambda counts: counts["remote_readers"] == 1, "topic")
    writer.commit("topic", 1, 1)
    received(same, 1)
    assert other.counts("topic") == {"connected": 0}


def test_an_endpoint_that_cannot_be_used_says_so(endpoint):
    with pytest.raises(ConfigError, match="zenoh cannot be started"):
        ZenohSession(config(listen=("tcp/256.0.0.1:1",)), node="node")


def test_two_processes_meet_over_zenoh(peer, endpoint):
    """One is killed, and comes back with lower versions; no segment of shared memory is left of it."""
    before = set(os.listdir("/dev/shm"))
    reader = peer("read", "reader", "cloud", of="there", zenoh=config(connect=(endpoint,), domain="car"))
    reader.wait_for("ready")
    writer = peer("write", "writer", "cloud", 1, 200_000, 20, 200, zenoh=config(listen=(endpoint,), domain="car"))
    writer.wait_for("ready")
    got = [reader.wait_for("read") for _ in range(5)]
    assert all(one["whole"] and one["epoch"] == 0 for one in got)
    assert [one["read"] for one in got] == sorted({one["read"] for one in got})
    writer.kill()
    again = peer("write", "writer", "cloud", 1, 200_000, 20, 200, zenoh=config(listen=(endpoint,), domain="car"))
    again.wait_for("ready")
    while (one := reader.wait_for("read"))["epoch"] == 0:
        assert one["whole"]
    assert one["epoch"] == 1
    again.kill()
    reader.kill()
    assert {name for name in set(os.listdir("/dev/shm")) - before if name.endswith(".zenoh")} == set()
