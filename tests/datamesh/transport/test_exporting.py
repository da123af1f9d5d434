"""The writer's side: payloads built in place, bounded queues, readers that come, go, hang and misbehave."""

import contextlib
import gc
import logging
import os
import socket
import threading
import time

import numpy as np
import pytest

from warploom.datamesh import CommitPolicy, EqualVersion, Status
from warploom.datamesh.transport import exporting, places
from warploom.datamesh.transport.places import connect
from warploom.datamesh.transport.wire import (
    COMMIT,
    MESSAGE,
    RELEASE,
    SOON,
    pack_greeting,
    read_event,
    read_greeting,
)
from warploom.errors import ConfigError


def test_a_payload_that_is_built_in_place_is_not_copied(linked, built):
    writer, reader = linked()
    arrays = []

    def build(change):
        cloud = built(1)(change)
        arrays.append(cloud.xyz[:])
        return cloud

    assert writer.commit("topic", 1, build) is Status.OK
    reader.until(lambda counts: counts.get("received") == 1, "topic")
    assert (reader.last().xyz == 1).all()
    assert (reader.last().intensity == -1).all()
    assert reader.last().frame == "lidar"
    arrays[0][0, 0] = 5  # kept from before the commit, which is wrong, and shows that it is the same memory
    assert reader.last().xyz[0, 0] == 5
    assert writer.counts("topic")["copied"] == 0
    assert writer.counts("topic")["sent_bytes"] < 400


def test_a_payload_that_is_not_is_copied_and_counted(linked, private):
    writer, reader = linked()
    cloud = private(3)
    writer.commit("topic", 3, cloud)
    reader.until(lambda counts: counts.get("received") == 1, "topic")
    assert (reader.last().xyz == 3).all()
    assert writer.last() is cloud
    assert writer.counts("topic")["copied"] == 1
    assert writer.counts("topic")["copied_bytes"] == cloud.xyz.nbytes + cloud.intensity.nbytes


def test_a_part_of_what_was_made_for_the_most_there_can_be_is_not_copied_either(linked, built, cloud_type):
    writer, reader = linked()
    writer.commit(
        "topic",
        1,
        lambda change: cloud_type(*(array[:7] for array in vars(built(1)(change)).values() if hasattr(array, "dtype"))),
    )
    reader.until(lambda counts: counts.get("received") == 1, "topic")
    assert reader.last().xyz.shape == (7, 3)
    assert writer.counts("topic")["copied"] == 0


def test_a_topic_that_is_not_exported_takes_the_same_calls(side, built):
    alone = side("alone")
    assert alone.commit("own", 1, built(1)) is Status.OK
    assert (alone.last("own").xyz == 1).all()


def test_what_is_committed_is_read_only_on_both_sides(linked, built):
    writer, reader = linked()
    writer.commit("topic", 1, built(1))
    reader.until(lambda counts: counts.get("received") == 1, "topic")
    for one in (writer, reader):
        with pytest.raises(ValueError, match="read-only"):
            one.last().xyz[0, 0] = 2
    with pytest.raises(ValueError, match="WRITEABLE"):
        reader.last().xyz.setflags(write=True)


def test_a_type_that_cannot_be_built_in_place_says_so(linked):
    writer, _ = linked()
    with pytest.raises(TypeError, match="dict has no class method allocate"):
        writer.output("topic").allocate_change().allocate(dict)


def test_a_change_that_is_abandoned_gives_its_memory_back(linked, cloud_type):
    writer, _ = linked()

    def fails(change):
        change.allocate(cloud_type, 100)
        assert writer.counts("topic")["slabs"] == 1
        raise RuntimeError("on purpose")

    with pytest.raises(RuntimeError, match="on purpose"):
        writer.commit("topic", 1, fails)
    gc.collect()
    assert writer.counts("topic")["slabs"] == 0


def test_small_payloads_go_with_the_message(linked):
    writer, reader = linked()
    writer.commit("topic", 1, {"speed": 12.5, "position": np.arange(3.0)})
    reader.until(lambda counts: counts.get("received") == 1, "topic")
    value = reader.last()
    assert value["speed"] == 12.5
    np.testing.assert_array_equal(value["position"], np.arange(3.0))
    assert not value["position"].flags.writeable
    assert writer.counts("topic")["slabs"] == 0


def test_a_payload_of_many_small_things_needs_no_array(linked):
    writer, reader = linked()
    value = {"names": [f"object {i}" for i in range(5000)]}
    writer.commit("topic", 1, value)
    reader.until(lambda counts: counts.get("received") == 1, "topic")
    assert reader.last() == value


def test_arrays_that_are_not_in_one_piece_are_copied(linked):
    writer, reader = linked()
    points = np.arange(8000, dtype=np.float32).reshape(-1, 4)
    writer.commit("topic", 1, [points[::2, :3], points.T])
    reader.until(lambda counts: counts.get("received") == 1, "topic")
    np.testing.assert_array_equal(reader.last()[0], points[::2, :3])
    np.testing.assert_array_equal(reader.last()[1], points.T)


def test_arrays_of_a_device_arrive_as_those_of_the_host_and_their_completion_is_waited_for(linked):
    events = []

    class DeviceArray:
        def numpy(self):
            events.append("read")
            return np.full(2000, 4.0)

    class Completion:
        stream = "stream"

        def synchronize(self):
            events.append("waited")

    writer, reader = linked()
    output = writer.output("topic")
    with output.allocate_change() as change:
        change.set_version(1)
        change.value = {"image": DeviceArray()}
        change.completes_with(Completion())
        output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)
    reader.until(lambda counts: counts.get("received") == 1, "topic")
    assert (reader.last()["image"] == 4.0).all()
    assert events == ["waited", "read"]
    assert writer.counts("topic")["copied_bytes"] == 16000


def test_arrays_of_warp_on_the_cpu_can_be_the_slab_itself(linked):
    import warp as wp

    writer, reader = linked()

    def build(change):
        array = change.array(4000, np.float32)
        wp.array(array, dtype=float, device="cpu", copy=False).fill_(6.0)
        return array

    writer.commit("topic", 1, build)
    reader.until(lambda counts: counts.get("received") == 1, "topic")
    assert (reader.last() == 6.0).all()
    assert writer.counts("topic")["copied"] == 0


def test_a_payload_that_no_message_can_hold_is_counted_and_the_next_is_sent(linked, caplog):
    writer, reader = linked()
    with caplog.at_level(logging.WARNING):
        writer.commit("topic", 1, {"what": object()})
        writer.commit("topic", 2, {"what": object()})
    writer.commit("topic", 3, {"what": 1})
    reader.until(lambda counts: counts.get("received") == 1, "topic")
    assert writer.counts("topic")["not_encodable"] == 2
    assert writer.mesh.losses["topic", "link_not_encodable"] == 2
    assert caplog.text.count("is not sent: ['what']: builtins.object is not a message") == 1
    assert reader.counts("topic")["missed"] == 2
    assert reader.mesh.losses["topic", "link_missed"] == 2


def test_a_memory_that_is_full_costs_data_and_is_counted(linked):
    writer, reader = linked(memory_bytes=1 << 16)
    held = []

    def build(change):
        held.append(change.array(20000, np.uint8))
        return held[-1]

    for version in range(1, 6):
        assert writer.commit("topic", version, build) is Status.OK, "the process itself loses nothing"
    held.clear()
    writer.commit("topic", 6, {"small": 1})
    reader.until(lambda counts: counts.get("missed", 0) + counts.get("received", 0) >= 6, "topic")
    counts = writer.counts("topic")
    assert counts["no_memory"] > 0
    assert writer.mesh.losses["topic", "link_no_memory"] > 0
    assert reader.counts("topic")["missed"] == 6 - reader.counts("topic")["received"]


def test_memory_is_used_again_and_never_while_a_reader_pins_it(linked, built):
    """Far more is sent than there is memory, while the reader keeps one snapshot."""
    writer, reader = linked(capacity=4, memory_bytes=1 << 20)
    writer.commit("topic", 1, built(1, 4000))
    reader.until(lambda counts: counts.get("received") == 1, "topic")
    with reader.input("topic").access() as pinned:
        for version in range(2, 200):
            writer.commit("topic", version, built(version, 4000))
            reader.until(lambda counts, version=version: counts.get("received") == version, "topic")
            reader.until_shown(version)
            assert (reader.last().xyz == version).all()
            assert (pinned[0].xyz == 1).all()
    assert writer.counts("topic").get("no_memory", 0) == 0
    assert writer.counts("topic").get("slow", 0) == 0
    assert writer.counts("topic")["slabs"] <= 2 * 4 + 2


class TestBareArrays:
    """A payload that is one array in a slab is sent in another way than the others, to the same effect."""

    @staticmethod
    def filled(version, shape=(500, 3)):
        def build(change):
            array = change.array(shape, np.float32)
            array[:] = version
            return array

        return build

    def test_they_arrive_whatever_their_shape_and_type(self, linked):
        writer, reader = linked()
        forms = [((3,), np.float32), ((3,), np.int32), ((2, 3), np.int32), ((2, 3), np.int32), ((), np.float64)]
        for version, (shape, dtype) in enumerate(forms, 1):

            def build(change, version=version, shape=shape, dtype=dtype):
                change.array(version, np.uint8)  # so that they lie at different places of their slabs
                array = change.array(shape, dtype)
                array[...] = version
                return array

            writer.commit("topic", version, build)
            reader.until_shown(version)
            arrived = reader.last()
            assert (arrived.shape, arrived.dtype) == (shape, dtype)
            assert (arrived == version).all()
        assert writer.counts("topic")["copied"] == 0

    def test_a_reader_that_hangs_loses_the_same_and_counts_it(self, linked):
        writer, reader = linked(capacity=2, queue=3)
        hangs, go_on = threading.Event(), threading.Event()

        def hang(_):
            hangs.set()
            go_on.wait(30)

        reader.mesh.window("topic").subscribe(hang, lambda *_: None)
        try:
            writer.commit("topic", 1, self.filled(1))
            assert hangs.wait(30)
            for version in range(2, 42):
                assert writer.commit("topic", version, self.filled(version)) is Status.OK
            counts = writer.counts("topic")
            assert counts["sent"] == 2 * 2 + 3
            assert counts["slow"] == writer.mesh.losses["topic", "link_slow"] == 41 - counts["sent"]
        finally:
            go_on.set()
        reader.until(lambda counts: counts.get("received") == 2 * 2 + 3, "topic")
        writer.commit("topic", 100, self.filled(100))
        reader.until_shown(100)
        assert reader.counts("topic")["missed"] == counts["slow"]

    def test_one_of_two_readers_that_ends_costs_the_other_nothing(self, side):
        writer = side("writer", exports=["topic"], capacity=2)
        first, second = (side(name, imports=["topic"], capacity=2) for name in ("first", "second"))
        writer.until(lambda counts: counts["readers"] == 2, "topic")
        for version in range(1, 40):
            if version == 20:
                second.links.stop()
            writer.commit("topic", version, self.filled(version))
            first.until_shown(version)
            assert (first.last() == version).all()
        assert [version for _, version, _ in first.commits["topic"]] == list(range(1, 40))
        assert first.counts("topic").get("missed", 0) == 0
        assert [version for _, version, _ in second.commits["topic"]] == list(range(1, 20))

    def test_out_of_order_and_equal_versions_have_the_same_effect(self, linked):
        writer, reader = linked(capacity=3)
        for version in (10, 20, 40, 30, 20, 50):
            writer.commit("topic", version, self.filled(version), CommitPolicy.INSERT_SORTED)
        writer.commit("topic", 50, self.filled(51), equal=EqualVersion.REPLACE)
        writer.commit("topic", 60, self.filled(60), triggers=False)
        expected = writer.mesh.window("topic").snapshot()
        reader.until_shown(60)
        shown = reader.mesh.window("topic").snapshot()
        assert shown.versions == expected.versions
        assert [array[0, 0] for array in shown] == [array[0, 0] for array in expected]
        assert reader.commits["topic"][-1] == (0, 60, False)


class TestReaders:
    """Readers that come, go, hang and misbehave."""

    def test_a_reader_that_hangs_loses_data_and_the_writer_does_not_wait(self, linked, built):
        writer, reader = linked(capacity=2, queue=3)
        hangs, go_on = threading.Event(), threading.Event()

        def hang(_):
            hangs.set()
            go_on.wait(30)

        reader.mesh.window("topic").subscribe(hang, lambda *_: None)
        try:
            writer.commit("topic", 1, built(1))
            assert hangs.wait(30)
            for version in range(2, 42):
                assert writer.commit("topic", version, built(version)) is Status.OK
            counts = writer.counts("topic")
            assert counts["sent"] == 2 * 2 + 3, "what its window keeps of two epochs, and its queue"
            assert counts["slow"] == 41 - counts["sent"]
            assert writer.mesh.losses["topic", "link_slow"] == counts["slow"]
        finally:
            go_on.set()
        reader.until(lambda counts: counts.get("received") == 2 * 2 + 3, "topic")
        writer.commit("topic", 100, built(100))
        reader.until_shown(100)
        assert reader.counts("topic")["missed"] == counts["slow"]

    def test_a_new_epoch_does_not_end_what_a_reader_gets(self, linked, built):
        """Its window keeps the data of the epoch before until the new one has filled it."""
        writer, reader = linked(capacity=4, queue=1)
        for epoch in range(3):
            for version in range(1, 21):
                writer.commit("topic", version, built(version))
                reader.until_shown(version, epoch)
            if epoch < 2:
                writer.mesh.window("topic").new_epoch()
        writer.commit("topic", 1, built(1), CommitPolicy.FORCE_NEW_EPOCH)
        reader.until_shown(1, 3)
        orders = [(epoch, version) for epoch in range(3) for version in range(1, 21)]
        assert [one[:2] for one in reader.commits["topic"]] == [*orders, (3, 1)]
        counts = writer.counts("topic")
        assert counts.get("slow", 0) == counts.get("no_memory", 0) == 0
        assert counts["slabs"] <= 2 * 4 + 1

    def test_what_a_reader_may_hold_are_data_in_however_many_slabs(self, linked):
        """Each is a list of the newest arrays, which lie in slabs of their own."""
        writer, reader = linked(capacity=4, queue=1)
        arrays = []
        for version in range(1, 31):

            def build(change, version=version):
                arrays.append(change.array(1000, np.int64))
                arrays[-1][:] = version
                del arrays[:-5]
                return list(arrays)

            writer.commit("topic", version, build)
            reader.until_shown(version)
        assert [array[0] for array in reader.last()] == list(range(26, 31))
        arrays.clear()
        assert writer.counts("topic").get("slow", 0) == writer.counts("topic")["copied"] == 0
        assert writer.counts("topic")["slabs"] == 4 + 5 - 1

    def test_messages_without_slabs_are_bounded_too(self, linked):
        writer, reader = linked()
        hangs, go_on = threading.Event(), threading.Event()

        def hang(_):
            hangs.set()
            go_on.wait(30)

        reader.mesh.window("topic").subscribe(hang, lambda *_: None)
        try:
            writer.commit("topic", 1, "x" * 3000)
            assert hangs.wait(30)
            for version in range(2, 2000):
                writer.commit("topic", version, "x" * 3000)
                if writer.counts("topic").get("slow"):
                    break
            assert writer.counts("topic")["slow"] > 0
        finally:
            go_on.set()

    def test_a_reader_whose_backlog_blocks_is_waited_for(self, side, built):
        writer = side("writer", exports=["topic"], queue=1)
        reader = side("reader", imports=["topic"], capacity=1, queue=1, blocking=["topic"])
        writer.until(lambda counts: counts["readers"] == 1, "topic")
        reader.mesh.window("topic").subscribe(lambda _: time.sleep(0.002), lambda *_: None)
        for version in range(1, 101):
            writer.commit("topic", version, built(version))
        reader.until(lambda counts: counts.get("received") == 100, "topic")
        assert [version for _, version, _ in reader.commits["topic"]] == list(range(1, 101))
        assert writer.counts("topic").get("slow", 0) == 0

    def test_a_writer_that_waits_goes_on_when_its_reader_ends(self, side, built):
        writer = side("writer", exports=["topic"], queue=1)
        with connect("node", "topic") as client:
            client.send(pack_greeting({"topic": "topic", "reader": "hangs", "capacity": 1, "blocks": True}))
            writer.until(lambda counts: counts["readers"] == 1, "topic")
            thread = threading.Thread(target=lambda: [writer.commit("topic", v, built(v)) for v in range(1, 9)])
            thread.start()
            thread.join(0.3)
            assert thread.is_alive(), "it waits"
            assert writer.counts("topic")["sent"] == 2, "and who asks how it goes is answered"
        thread.join(30)
        assert not thread.is_alive()
        assert writer.counts("topic")["readers"] == 0

    @pytest.mark.parametrize("kept_s", [0.0, 0.2])
    def test_what_a_reader_held_is_free_when_it_is_not_back_in_time(self, side, kept_s, built):
        writer = side("writer", exports=["topic"], capacity=1, kept_s=kept_s)
        client = connect("node", "topic")
        client.send(pack_greeting({"topic": "topic", "reader": "dies", "capacity": 8, "blocks": False}))
        writer.until(lambda counts: counts["readers"] == 1, "topic")
        for version in range(1, 6):
            writer.commit("topic", version, built(version))
        assert writer.counts("topic")["slabs"] == 5
        client.close()
        writer.until(lambda counts: counts["readers"] == 0 and counts["slabs"] == 1, "topic")

    def test_each_of_several_readers_holds_the_same_slab(self, side, built):
        writer = side("writer", exports=["topic"], capacity=1)
        readers = [side(f"reader {n}", imports=["topic"], capacity=1) for n in range(3)]
        writer.until(lambda counts: counts["readers"] == 3, "topic")
        for version in range(1, 21):
            writer.commit("topic", version, built(version))
            for one in readers:
                one.until_shown(version)
        assert all((one.last().xyz == 20).all() for one in readers)
        gc.collect()
        writer.until(lambda counts: counts["slabs"] == 1, "topic")

    def test_who_is_no_reader_is_turned_away_and_the_others_are_served(self, linked, caplog, built):
        writer, reader = linked()
        for hello in (
            b"GET / HTTP/1.1",
            pack_greeting({"topic": "other", "reader": "x", "capacity": 1, "blocks": False}),
        ):
            with connect("node", "topic") as client:
                client.settimeout(30)
                client.send(hello)
                assert "refused" in read_greeting(client.recv(MESSAGE), ())
                assert client.recv(MESSAGE) == b""
        with connect("node", "topic"):
            pass  # says nothing
        writer.commit("topic", 1, built(1))
        reader.until(lambda counts: counts.get("received") == 1, "topic")
        assert writer.counts("topic")["readers"] == 1

    def test_a_reader_cannot_let_go_of_what_others_hold(self, linked, built):
        writer, reader = linked()
        with connect("node", "topic") as client:
            client.settimeout(30)
            client.send(pack_greeting({"topic": "topic", "reader": "bad", "capacity": 8, "blocks": False}))
            data, fds, _, _ = socket.recv_fds(client, MESSAGE, 1)
            os.close(fds[0])
            assert data
            writer.commit("topic", 1, built(1))
            while (event := read_event(client.recv(MESSAGE), 1 << 24)).kind != COMMIT:
                assert event.kind == SOON
            ((offset, _),) = event.slabs
            for _ in range(5):
                client.send(RELEASE.pack(offset))
            client.send(RELEASE.pack((1 << 64) - 1))
            client.send(b"x")
            reader.until_shown(1)
            for version in range(2, 30):
                writer.commit("topic", version, built(version))
                reader.until_shown(version)
                with reader.input("topic").access() as snapshot:
                    assert all((cloud.xyz == v).all() for v, cloud in zip(snapshot.versions, snapshot, strict=True))

    def test_a_reader_of_another_user_is_turned_away(self, side, monkeypatch):
        monkeypatch.setattr(exporting, "peer_of", lambda _: (1, 12345))
        writer = side("writer", exports=["topic"])
        with connect("node", "topic") as client:
            client.settimeout(30)
            assert client.recv(MESSAGE) == b""
        assert writer.counts("topic")["readers"] == 0


class TestAnnouncements:
    """Readers are woken when a payload is begun, to be ready when it comes."""

    @pytest.fixture
    def client(self, side):
        """A writer, and a reader that does nothing by itself: gives the kinds of the next so many messages."""
        with contextlib.ExitStack() as stack:

            def make(capacity=8, **options):
                writer = side("writer", exports=["topic"], **options)
                one = stack.enter_context(connect("node", "topic"))
                one.settimeout(30)
                hello = {"topic": "topic", "reader": "client", "capacity": capacity, "blocks": False}
                one.send(pack_greeting(hello))
                os.close(socket.recv_fds(one, MESSAGE, 1)[1][0])
                writer.until(lambda counts: counts["readers"] == 1, "topic")
                return writer, lambda count: [read_event(one.recv(MESSAGE), 1 << 24) for _ in range(count)]

            yield make

    def test_one_comes_before_its_commit_and_is_not_numbered(self, client, built):
        writer, received = client()
        writer.commit("topic", 1, built(1))
        soon, commit = received(2)
        assert (soon.kind, commit.kind, commit.number) == (SOON, COMMIT, 1)
        assert writer.counts("topic")["sent"] == 1

    def test_there_is_none_where_it_is_configured_so(self, client, built):
        writer, received = client(announce=False)
        writer.commit("topic", 1, built(1))
        assert [event.kind for event in received(1)] == [COMMIT]

    def test_there_is_none_just_after_a_commit(self, client, built, monkeypatch):
        monkeypatch.setattr(exporting, "_COLD_NS", 1 << 62)
        writer, received = client()
        for version in (1, 2):
            writer.commit("topic", version, built(version))
        assert [event.kind for event in received(2)] == [COMMIT, COMMIT]

    def test_it_says_how_long_payloads_took_to_build(self, client, monkeypatch):
        monkeypatch.setattr(exporting, "_COLD_NS", -1)
        writer, received = client()

        def build(change):
            array = change.array(1000, np.int64)
            time.sleep(0.02)
            return array

        for version in range(1, 4):
            before = time.perf_counter_ns()
            writer.commit("topic", version, build)
            after = time.perf_counter_ns()
            word = received(2)[0]
            soon, late = word.received_ns, word.committed_ns
            if version == 1:  # nothing was built before
                assert before <= soon == late <= after
            else:
                assert before + 20e6 <= soon <= late
            assert word.version < os.cpu_count(), "the core that it is built on"

    def test_a_reader_that_has_enough_to_read_is_not_woken(self, client, built, monkeypatch):
        monkeypatch.setattr(exporting, "_COLD_NS", -1)
        writer, received = client(capacity=1, queue=1)
        for version in (1, 2, 3):
            writer.commit("topic", version, built(version))
        writer.commit("topic", 4, "small")
        assert [event.kind for event in received(5)] == [SOON, COMMIT, SOON, COMMIT, COMMIT]
        assert writer.counts("topic")["slow"] == 1


def test_the_memory_of_payloads_outlives_the_export(linked, built):
    writer, reader = linked()
    writer.commit("topic", 1, built(1))
    reader.until_shown(1)
    cloud = reader.last()
    writer.links.stop()
    reader.links.stop()
    assert (cloud.xyz == 1).all()
    assert (writer.last().xyz == 1).all()
    writer.commit("topic", 2, built(2))
    assert (writer.last().xyz == 2).all()


def test_a_topic_has_one_exporter_in_a_node(side):
    side("writer", exports=["topic"])
    with pytest.raises(ConfigError, match="is exported already"):
        side("second", exports=["topic"])
    other = side("second", of="other node", exports=["topic"])
    assert other.counts("topic")["readers"] == 0


def test_nothing_is_left_open_after_the_stop(side, linked, built):
    def descriptors():
        """What is open, each by its inode: what others let go of meanwhile does not hide what is left."""
        found = set()
        for fd in os.listdir("/proc/self/fd"):
            with contextlib.suppress(OSError):
                found.add((os.readlink(f"/proc/self/fd/{fd}"), os.stat(f"/proc/self/fd/{fd}").st_ino))
        return found

    before, threads = descriptors(), set(threading.enumerate())
    writer, reader = linked()
    writer.commit("topic", 1, built(1))
    reader.until_shown(1)
    for one in (reader, writer):
        one.links.stop()
        one.mesh.window("topic").new_epoch()
        one.mesh.window("topic").new_epoch()
    gc.collect()
    assert descriptors() - before == set()
    assert set(threading.enumerate()) - threads == set()
    assert places.exported_topics("node") == []
