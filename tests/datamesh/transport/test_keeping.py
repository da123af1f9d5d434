"""What is kept for a reader that was killed, until it is back."""

import socket
import threading

import pytest

from warploom.datamesh.transport.places import connect
from warploom.datamesh.transport.wire import MESSAGE, pack_greeting, read_event


class Killed:
    """A reader that ends without a word, as one does that is killed."""

    def __init__(self, side, **options):
        self._make = lambda **others: side("reader", imports=["topic"], **options, **others)
        self.side = self._make()

    def kill(self, writer):
        link = self.side.links._imports["topic"]
        link._stopping.set()
        link._socket.shutdown(socket.SHUT_RDWR)
        writer.until(lambda counts: counts["readers"] == 0, "topic")

    def back(self, **others):
        self.side = self._make(**others)
        return self.side


def test_all_of_it_comes_in_order_and_triggers_once(side, built):
    writer = side("writer", exports=["topic"], capacity=4, queue=2, history=2)
    reader = Killed(side, capacity=4, queue=2)
    writer.until(lambda counts: counts["readers"] == 1, "topic")
    for version in range(1, 11):
        writer.commit("topic", version, built(version))
        reader.side.until_shown(version)
    reader.kill(writer)
    for version in range(11, 51):
        writer.commit("topic", version, built(version))
    back = reader.back()
    back.until_shown(50)
    first = back.commits["topic"][0][1]
    assert first <= 7, "what it may not have read comes again"
    assert back.commits["topic"] == [(0, version, version > 10) for version in range(first, 51)]
    assert all((cloud.xyz == v).all() for v, cloud in enumerate(back.shown(), 47))
    counts = writer.counts("topic")
    assert counts.get("slow", 0) == counts.get("away", 0) == counts["kept"] == 0
    writer.commit("topic", 51, built(51))
    back.until_shown(51)
    assert back.commits["topic"][-1] == (0, 51, True)


def test_what_is_committed_while_it_catches_up_comes_behind(side, built):
    writer = side("writer", exports=["topic"], capacity=2, queue=1)
    reader = Killed(side, capacity=2, queue=1)
    writer.until(lambda counts: counts["readers"] == 1, "topic")
    reader.kill(writer)
    for version in range(1, 31):
        writer.commit("topic", version, built(version))
    reads = threading.Event()
    back = reader.back(reads=reads)
    back.wait(lambda: back.commits["topic"])
    for version in range(31, 61):
        writer.commit("topic", version, built(version))
    assert len(back.commits["topic"]) == 1
    reads.set()
    back.until_shown(60)
    assert [version for _, version, _ in back.commits["topic"]] == list(range(1, 61))


def test_killed_while_it_catches_up_it_still_misses_nothing(side, built):
    writer = side("writer", exports=["topic"], capacity=2, queue=1)
    reader = Killed(side, capacity=2, queue=1)
    writer.until(lambda counts: counts["readers"] == 1, "topic")
    reader.kill(writer)
    for version in range(1, 41):
        writer.commit("topic", version, built(version))
    with connect("node", "topic") as client:  # it reads some, and is killed
        client.settimeout(30)
        client.send(pack_greeting({"topic": "topic", "reader": "reader", "capacity": 2, "blocks": False}))
        client.recv(MESSAGE)
        seen = {read_event(client.recv(MESSAGE), 1 << 24).version for _ in range(3)}
    writer.until(lambda counts: counts["readers"] == 0, "topic")
    back = reader.back()
    back.until_shown(40)
    assert seen == {1, 2, 3}
    assert {version for _, version, _ in back.commits["topic"]} >= set(range(4, 41))


def test_too_much_is_lost_from_its_beginning_and_counted(side, built):
    writer = side("writer", exports=["topic"], capacity=4, kept=10)
    reader = Killed(side)
    writer.until(lambda counts: counts["readers"] == 1, "topic")
    reader.kill(writer)
    for version in range(1, 31):
        writer.commit("topic", version, built(version))
    assert writer.counts("topic")["away"] == 20
    assert writer.mesh.losses["topic", "link_away"] == 20
    back = reader.back()
    back.until_shown(30)
    assert [version for _, version, _ in back.commits["topic"]] == list(range(21, 31))


def test_its_size_is_bounded_too(side, built):
    writer = side("writer", exports=["topic"], capacity=1, kept_bytes=5 * 12000)
    reader = Killed(side)
    writer.until(lambda counts: counts["readers"] == 1, "topic")
    reader.kill(writer)
    for version in range(1, 31):
        writer.commit("topic", version, built(version, 1000))
    assert writer.counts("topic")["kept"] <= 5
    assert writer.counts("topic")["slabs"] <= 6


@pytest.mark.parametrize("options", [{"kept": 0}, {"kept_s": 0.0}])
def test_without_it_there_is_the_history(side, options, built):
    writer = side("writer", exports=["topic"], capacity=4, history=2, **options)
    reader = Killed(side)
    writer.until(lambda counts: counts["readers"] == 1, "topic")
    reader.kill(writer)
    for version in range(1, 31):
        writer.commit("topic", version, built(version))
    back = reader.back()
    back.until_shown(30)
    assert [version for _, version, _ in back.commits["topic"]] == [29, 30]
    assert writer.counts("topic")["kept"] == 0


def test_for_who_says_good_bye_nothing_is_kept(side, built):
    writer = side("writer", exports=["topic"])
    reader = side("reader", imports=["topic"])
    reader.until(lambda counts: counts["connected"], "topic")
    reader.links.stop()
    writer.until(lambda counts: counts["readers"] == 0, "topic")
    writer.commit("topic", 1, built(1))
    assert writer.counts("topic")["kept"] == 0


def test_memory_that_is_needed_is_not_kept(side, built):
    writer = side("writer", exports=["topic"], capacity=1, memory_bytes=1 << 20, kept=1000)
    reader = Killed(side, capacity=1, memory_bytes=1 << 20)
    writer.until(lambda counts: counts["readers"] == 1, "topic")
    reader.kill(writer)
    for version in range(1, 101):
        writer.commit("topic", version, built(version, 4000))
    counts = writer.counts("topic")
    assert counts["away"] > 0
    assert counts["away"] + counts["kept"] == 100
    assert counts["slabs"] <= 16
    assert counts.get("no_memory", 0) == 0
    back = reader.back()
    back.until_shown(100)
    assert (back.last().xyz == 100).all()
