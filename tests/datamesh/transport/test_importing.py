"""The reader's side: the same windows, triggers, epochs, settles and misses as in the producer's own process."""

import gc
import logging
import os
import pathlib
import socket
import threading
import time

import numpy as np
import pytest

from warploom.dag import BacklogConfig, DataProcessComponent
from warploom.datamesh import CommitPolicy, EqualVersion, Input, Miss, Outcome, Output, Status
from warploom.datamesh.messages import encode
from warploom.datamesh.transport import exporting, importing
from warploom.datamesh.transport.places import listen
from warploom.datamesh.transport.slabs import SlabPool
from warploom.datamesh.transport.wire import COMMIT, MESSAGE, Event, pack_event, pack_greeting, pack_soon


def versions(side):
    snapshot = side.mesh.window("topic").snapshot()
    return snapshot.epoch, snapshot.versions


def same(writer, reader):
    """Waits until the reader's window shows what the writer's does."""
    count = writer.counts("topic")["sent"]
    reader.until(lambda counts: counts.get("received", 0) >= count, "topic")
    shown, expected = (one.mesh.window("topic").snapshot() for one in (reader, writer))
    assert (shown.epoch, shown.versions) == (expected.epoch, expected.versions)
    assert list(shown) == list(expected)


class TestCommits:
    """One window shows what the other does."""

    def test_times_and_versions_are_those_of_the_commit(self, linked):
        writer, reader = linked()
        output = writer.output("topic")
        with output.allocate_change() as change:
            change.set_version(7, received_ns=123)
            change.value = "seven"
            output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)
        same(writer, reader)
        there, here = (one.mesh.window("topic").snapshot().entry(0) for one in (writer, reader))
        assert here == there
        assert here.received_ns == 123

    @pytest.mark.parametrize("policy", list(CommitPolicy))
    @pytest.mark.parametrize("equal", [EqualVersion.KEEP_FIRST, EqualVersion.REPLACE])
    @pytest.mark.parametrize("triggers", [None, True, False])
    def test_every_policy_has_the_same_effect(self, linked, policy, equal, triggers):
        writer, reader = linked(capacity=3)
        seen = []
        writer.mesh.window("topic").subscribe(lambda e: seen.append((e.epoch, e.version, e.triggers)), lambda *_: None)
        for number, version in enumerate([10, 20, 40, 30, 20, 20, 50, 5, 60]):
            writer.commit("topic", version, f"{version} {number}", policy, equal=equal, triggers=triggers)
        same(writer, reader)
        assert reader.commits["topic"] == seen

    def test_a_settled_version_ends_a_wait_and_says_why_there_is_nothing(self, linked):
        writer, reader = linked()
        writer.commit("topic", 10, "ten")
        same(writer, reader)
        wait = reader.input("topic").when(20, lambda _: None)
        writer.output("topic").settle(20)
        same(writer, reader)
        assert wait.outcome is Outcome.SETTLED_EMPTY
        assert reader.mesh.window("topic").snapshot().miss(20) is Miss.SETTLED_EMPTY
        assert reader.settled["topic"] == [(0, 20)]

    def test_what_is_missing_is_missing_for_the_same_reason(self, linked):
        writer, reader = linked(capacity=2)
        for version in (10, 20, 30):
            writer.commit("topic", version, version)
        writer.output("topic").settle(25)
        same(writer, reader)
        for version in range(5, 45, 5):
            miss = writer.mesh.window("topic").snapshot().miss(version)
            assert reader.mesh.window("topic").snapshot().miss(version) is miss

    def test_a_new_epoch_of_the_producer_is_one_here(self, linked):
        writer, reader = linked()
        writer.commit("topic", 100, "before")
        writer.output("topic").new_epoch()
        writer.commit("topic", 1, "after")
        same(writer, reader)
        assert versions(reader) == (1, (1,))

    def test_a_wait_here_is_ended_by_a_commit_there(self, linked):
        writer, reader = linked()
        ended = []
        thread = threading.Thread(target=lambda: ended.append(reader.input("topic").wait(5, 30_000_000_000)))
        thread.start()
        writer.commit("topic", 5, "five")
        thread.join(30)
        assert ended[0].outcome is Outcome.FOUND
        assert ended[0].entry.value == "five"

    def test_a_component_runs_for_what_another_process_commits(self, linked):
        ran = threading.Event()

        class Doubles(DataProcessComponent):
            number: Input[int]
            double: Output[int]

            def process(self, trigger):
                with self.number.access() as snapshot, self.double.allocate_change() as change:
                    change.set_version(trigger.version)
                    change.value = 2 * snapshot[snapshot.version_index(trigger.version)]
                    status = self.double.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)
                ran.set()
                return status

        writer, reader = linked()
        component = Doubles("doubles")
        component.bind(reader.mesh, {"number": "topic", "double": "double"})
        component.set_trigger("number", BacklogConfig())
        component.start()
        try:
            writer.commit("topic", 3, 21)
            assert ran.wait(30)
        finally:
            component.stop()
        assert reader.mesh.window("double").snapshot().last() == 42


@pytest.mark.parametrize("backlog", [BacklogConfig(), BacklogConfig(policy="fifo", depth=2)])
def test_a_component_that_runs_in_the_thread_that_receives_is_given_what_its_backlog_keeps(linked, backlog):
    """As one with a thread of its own: what comes while it runs waits in its backlog, and not before the window."""
    ran, running, go_on = [], threading.Event(), threading.Event()

    class Slow(DataProcessComponent):
        number: Input[int]

        def process(self, trigger):
            with self.number.access() as snapshot:
                ran.append((trigger.version, snapshot.versions[-1]))
            running.set()
            assert go_on.wait(30)
            return Status.OK

    writer, reader = linked(capacity=8)
    component = Slow("slow")
    component.bind(reader.mesh, {"number": "topic"})
    component.set_trigger("number", backlog, "inline")
    component.start()
    writer.commit("topic", 1, 1)
    assert running.wait(30)
    for version in (2, 3, 4, 5):
        writer.commit("topic", version, version)
    writer.output("topic").settle(6)
    writer.commit("topic", 7, 7)
    go_on.set()
    last = [7] if backlog.policy == "latest" else [5, 7]
    reader.wait(lambda: len(ran) == 1 + len(last))
    assert ran == [(1, 1), *((version, 7) for version in last)]
    assert component.losses["slow", "backlog"] == 5 - len(last)
    running.clear()
    writer.commit("topic", 8, 8)
    assert running.wait(30), "it goes on as before"
    reader.links.stop()
    component.stop()
    assert [version for _, version, _ in reader.commits["topic"]] == [1, 2, 3, 4, 5, 7, 8]


class TestLives:
    """Either side ends and comes back."""

    def test_a_reader_that_comes_later_is_given_the_newest_and_they_trigger(self, side):
        writer = side("writer", exports=["topic"], history=3)
        for version in range(1, 7):
            writer.commit("topic", version, version)
        reader = side("reader", imports=["topic"])
        reader.until(lambda counts: counts.get("received") == 3, "topic")
        assert reader.commits["topic"] == [(0, 4, True), (0, 5, True), (0, 6, True)]

    def test_a_reader_that_comes_back_is_given_them_and_what_it_had_does_not_trigger_again(self, side):
        writer = side("writer", exports=["topic"])
        first = side("reader", imports=["topic"])
        writer.until(lambda counts: counts["readers"] == 1, "topic")
        for version in (1, 2):
            writer.commit("topic", version, version)
        first.until(lambda counts: counts.get("received") == 2, "topic")
        first.links.stop()
        writer.until(lambda counts: counts["readers"] == 0, "topic")
        writer.commit("topic", 3, 3)
        second = side("reader", imports=["topic"])
        second.until(lambda counts: counts.get("received") == 3, "topic")
        assert second.commits["topic"] == [(0, 1, False), (0, 2, False), (0, 3, True)]

    def test_without_history_nothing_is_given(self, side):
        writer = side("writer", exports=["topic"], history=0)
        writer.commit("topic", 1, 1)
        reader = side("reader", imports=["topic"])
        writer.until(lambda counts: counts["readers"] == 1, "topic")
        writer.commit("topic", 2, 2)
        reader.until(lambda counts: counts.get("received") == 1, "topic")
        assert versions(reader) == (0, (2,))

    @pytest.mark.parametrize(("first", "epoch", "shown"), [(11, 0, (9, 10, 11, 12)), (1, 1, (1, 2))])
    def test_a_producer_that_comes_back_goes_on_or_begins_an_epoch(self, side, first, epoch, shown):
        """Where its versions go on, they fit those of others, and the epoch stays; where they fall, it rises."""
        writer = side("writer", exports=["topic"])
        reader = side("reader", imports=["topic"])
        writer.until(lambda counts: counts["readers"] == 1, "topic")
        for version in (9, 10):
            writer.commit("topic", version, version)
        reader.until(lambda counts: counts.get("received") == 2, "topic")
        writer.links.stop()
        again = side("writer", exports=["topic"])
        again.until(lambda counts: counts["readers"] == 1, "topic")
        for version in (first, first + 1):
            assert again.commit("topic", version, version) is Status.OK
        reader.until(lambda counts: counts.get("received") == 4, "topic")
        assert versions(reader) == (epoch, shown)
        assert [order[:2] for order in reader.commits["topic"]][2:] == [(epoch, first), (epoch, first + 1)]
        assert reader.counts("topic")["connections"] == 2

    def test_all_readers_see_the_same_epoch_whenever_they_came(self, side):
        for first in (30, 20, 10):
            writer = side("writer", exports=["topic"])
            early = side(f"early {first}", imports=["topic"])
            writer.until(lambda counts: counts["readers"] >= 1, "topic")
            writer.commit("topic", first, first)
            late = side(f"late {first}", imports=["topic"])
            for one in (early, late):
                one.until(lambda counts: counts.get("received") == 1, "topic")
                assert versions(one) == (3 - first // 10, (first,))
                one.links.stop()
            writer.links.stop()

    def test_an_import_waits_for_its_producer_as_long_as_there_is_none(self, side):
        reader = side("reader", imports=["topic"])
        assert reader.counts("topic") == {"connected": 0}
        writer = side("writer", exports=["topic"])
        writer.commit("topic", 1, 1)
        reader.until(lambda counts: counts.get("received") == 1, "topic")
        assert reader.counts("topic")["connected"] == 1


class Impostor:
    """Listens as a producer does, and sends what it likes."""

    def __init__(self, node):
        self.listener = listen(node, "topic")
        self.listener.setblocking(True)
        self.listener.settimeout(30)
        self.pool = SlabPool(1 << 16)
        self.connections = []

    def accept(self, welcome=None, fds=None):
        one, _ = self.listener.accept()
        self.connections.append(one)
        one.settimeout(30)
        one.recv(MESSAGE)
        said = {"writer": "impostor", "topic": "topic", "memory": 1 << 16}
        greeting = pack_greeting(said) if welcome is None else welcome
        socket.send_fds(one, [greeting], [self.pool.fd] if fds is None else fds)
        return one

    def close(self):
        for one in (*self.connections, self.listener):
            one.close()
        self.pool.close()


@pytest.fixture
def impostor(node):
    one = Impostor(node)
    yield one
    one.close()


def commit_of(number, body, slabs=(), body_size=0):
    return pack_event(Event(COMMIT, number, 0, number, 0, number, True, True, slabs, body, body_size))


@pytest.mark.parametrize("build_s", [0.0, 0.002])
@pytest.mark.parametrize(
    ("spin_us", "share"),
    [(0.0, 0.1), (1.0, 1.0), (60e6, 1.0), (1000.0, 0.1)],
    ids=["not at all", "which then sleeps", "for long", "as by default"],
)
def test_a_reader_that_stays_awake_gets_all_and_ends(linked, monkeypatch, spin_us, share, build_s):
    monkeypatch.setattr(exporting, "_COLD_NS", -1)  # each payload that is begun is announced
    monkeypatch.setattr(importing, "_SHORT_NS", -(1 << 62))  # and is waited for
    writer, reader = linked(spin_us=spin_us, spin_share=share)

    def build(change):
        array = change.array(2000, np.int64)
        array[:] = 7
        time.sleep(build_s)
        return array

    for version in range(1, 21):
        writer.commit("topic", version, build)
        reader.until(lambda counts, version=version: counts.get("received") == version, "topic")
        assert (reader.last() == 7).all()
    assert [version for _, version, _ in reader.commits["topic"]] == list(range(1, 21))
    change = writer.output("topic").allocate_change()
    change.array(2000, np.int64)  # of which nothing comes, while the reader ends
    thread = reader.links._imports["topic"]._thread
    reader.links.stop()
    assert not thread.is_alive()


def soon_message():
    """That a commit is expected in 1 to 2 ms."""
    now = time.perf_counter_ns()
    return pack_soon(0, now + 1_000_000, now + 2_000_000)


class TestRehearsals:
    """At the word that a commit will follow, the last one is gone through again, to no effect."""

    def test_they_change_and_hold_nothing(self, linked, monkeypatch):
        values = []
        monkeypatch.setattr(exporting, "_COLD_NS", -1)  # each payload that is begun is announced
        monkeypatch.setattr(importing, "_SHORT_NS", -(1 << 62))  # and is waited for
        monkeypatch.setattr(importing, "_rehearse", lambda *_, of=importing._rehearse: values.append(of(*_)))
        writer, reader = linked(capacity=2)
        for version in range(1, 6):
            writer.commit("topic", version, lambda change: change.array(2000, np.int64))
            reader.until(lambda counts, version=version: counts.get("received") == version, "topic")
            with writer.output("topic").allocate_change() as change:  # of which nothing comes
                change.array(2000, np.int64)
            reader.wait(lambda version=version: len(values) >= 2 * version - 1)
        assert reader.commits["topic"] == [(0, version, True) for version in range(1, 6)]
        assert reader.mesh.losses["topic", "replaced"] == 0
        writer.until(lambda counts: counts["slabs"] <= 2 + 2, "topic", "the slabs of both windows")

    def test_they_do_not_keep_the_memory_of_a_writer_that_is_gone(self, side, monkeypatch):
        def memories():
            """Those that the reader has mapped; the writers, in this process too, map theirs to write."""
            lines = [line.split() for line in pathlib.Path("/proc/self/maps").read_text().splitlines()]
            return {line[4] for line in lines if line[1] == "r--s" and "memfd:warploom" in line[-2]}

        rehearsed, others = [], memories()
        monkeypatch.setattr(exporting, "_COLD_NS", -1)
        monkeypatch.setattr(importing, "_SHORT_NS", -(1 << 62))  # and is waited for
        monkeypatch.setattr(importing, "_rehearse", lambda *_, of=importing._rehearse: rehearsed.append(of(*_)))
        reader = side("reader", imports=["topic"], capacity=1)
        gc.disable()  # as between two of its full passes, which may be minutes
        try:
            for life in range(4):
                writer = side("writer", exports=["topic"], capacity=1)
                writer.until(lambda counts: counts["readers"] == 1, "topic")
                for number in range(1, 4):
                    writer.commit("topic", 10 * life + number, lambda change: change.array(2000, np.int64))
                    reader.until_shown(10 * life + number)
                writer.links.stop()
                writer.mesh.window("topic").new_epoch()
                writer.mesh.window("topic").new_epoch()
                reader.until(lambda counts: not counts["connected"], "topic")
            assert len(rehearsed) >= 4
            reader.wait(lambda: len(memories() - others) <= 1)  # that of what its window shows
        finally:
            gc.enable()

    def test_one_that_fails_costs_nothing(self, side, impostor):
        """What the last one refers to may hold something else by now."""
        reader = side("reader", imports=["topic"])
        one = impostor.accept()
        for data in (soon_message(), commit_of(1, TestDamage.BEYOND, ((0, 4096),)), soon_message(), soon_message()):
            one.send(data)
        one.send(commit_of(2, encode("whole")))
        reader.until(lambda counts: counts.get("received") == 1, "topic")
        assert versions(reader) == (0, (2,))
        assert reader.counts("topic")["damaged"] == 1, "once"
        assert reader.counts("topic")["connections"] == 1


class TestDamage:
    """Whatever comes, this process lives, says what was wrong, counts it, and reads what is whole."""

    ARRAY = np.zeros(10)
    BEYOND = encode([ARRAY], lambda array: (0, 4090))
    NOWHERE = encode([ARRAY], lambda array: (3, 0))

    @pytest.mark.parametrize(
        ("event", "message"),
        [
            (commit_of(1, b""), "truncated"),
            (commit_of(1, encode("whole")[:-1]), "truncated"),
            (commit_of(1, b"\xff\xff"), "no kind of value"),
            (commit_of(1, BEYOND, ((0, 4096),)), "an array at 4090 to 4170 of a memory of 4096 bytes"),
            (commit_of(1, NOWHERE, ((0, 4096),)), "an array in memory 3, of which there are 1 here"),
            (commit_of(1, b"", ((0, 4096),), 4096), "no kind of value"),
            (commit_of(1, encode("known").replace(b"s", b"m", 1)), "truncated"),
        ],
    )
    def test_a_payload_that_is_damaged_is_left_out(self, side, impostor, caplog, event, message):
        reader = side("reader", imports=["topic"])
        with caplog.at_level(logging.ERROR):
            one = impostor.accept()
            one.send(event)
            one.send(commit_of(2, encode("whole")))
            reader.until(lambda counts: counts.get("received") == 1, "topic")
        assert versions(reader) == (0, (2,))
        assert reader.counts("topic")["damaged"] == 1
        assert reader.mesh.losses["topic", "link_damaged"] == 1
        assert message in caplog.text

    @pytest.mark.parametrize("data", [b"x", b"\x00" * 60, commit_of(1, b"", ((1 << 60, 1),))])
    def test_after_a_message_that_is_none_both_ends_begin_anew(self, side, impostor, data):
        reader = side("reader", imports=["topic"])
        impostor.accept().send(data)
        impostor.accept().send(commit_of(1, encode("whole")))
        reader.until(lambda counts: counts.get("received") == 1, "topic")
        assert reader.counts("topic")["damaged"] == 1
        assert reader.counts("topic")["connections"] == 2

    def test_a_memory_that_is_none_is_refused(self, side, impostor, caplog, tmp_path):
        reader = side("reader", imports=["topic"])
        file = (tmp_path / "file").open("w+b")
        file.truncate(1 << 16)
        small = os.memfd_create("small", os.MFD_ALLOW_SEALING)
        try:
            with caplog.at_level(logging.WARNING):
                impostor.accept(b"\x00")
                impostor.accept(pack_greeting({"writer": 1, "topic": "topic", "memory": 5}))
                impostor.accept(fds=[])
                impostor.accept(fds=[small])
                impostor.accept(fds=[file.fileno()])
                impostor.accept().send(commit_of(1, encode("whole")))
                reader.until(lambda counts: counts.get("received") == 1, "topic")
        finally:
            os.close(small)
            file.close()
        for said in ("no kind of value", "writer of the other end is 1", "sent no memory", "where 65536 were said"):
            assert said in caplog.text

    def test_a_producer_of_another_user_is_not_believed(self, side, impostor, monkeypatch, caplog):
        monkeypatch.setattr(importing, "peer_of", lambda _: (1, 12345))
        with caplog.at_level(logging.WARNING):
            reader = side("reader", imports=["topic"])
            one, _ = impostor.listener.accept()
            with one:
                one.settimeout(30)
                assert one.recv(MESSAGE) == b""
            reader.wait(lambda: "another user" in caplog.text)

    def test_a_producer_that_does_not_answer_keeps_nobody(self, side, impostor):
        reader = side("reader", imports=["topic"])
        one, _ = impostor.listener.accept()
        with one:
            one.settimeout(30)
            one.recv(MESSAGE)
            reader.links.stop()
            assert one.recv(MESSAGE) == b"", "it has gone before it was answered"
        assert reader.links.counters() == {}


def test_what_was_received_stays_as_it_is_when_receiving_ends(side):
    """The writer goes on, and uses its memory again only as it is let go of."""
    writer = side("writer", exports=["topic"], capacity=1)
    reader = side("reader", imports=["topic"], capacity=4)
    writer.until(lambda counts: counts["readers"] == 1, "topic")

    def commit(version):
        def build(change):
            array = change.array(2000, np.int64)
            array[:] = version
            return array

        writer.commit("topic", version, build)

    for version in range(1, 5):
        commit(version)
    reader.until(lambda counts: counts.get("received") == 4, "topic")
    reader.links.end_import("topic")
    writer.until(lambda counts: counts["readers"] == 0, "topic")
    for version in range(5, 40):
        commit(version)
    snapshot = reader.mesh.window("topic").snapshot()
    assert [set(array.tolist()) for array in snapshot] == [{version} for version in range(1, 5)]
    assert writer.counts("topic")["slabs"] == 4 + 1
    del snapshot
    reader.mesh.window("topic").new_epoch()
    reader.mesh.window("topic").new_epoch()
    writer.until(lambda counts: counts["slabs"] == 1, "topic")
    assert writer.counts("topic").get("slow", 0) == writer.counts("topic")["kept"] == 0
