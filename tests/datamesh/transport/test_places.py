"""Where the links of a node meet, and what dead processes leave there."""

import errno
import os
import signal
import socket
import stat
import threading
import time
from contextlib import suppress

import pytest

from warploom.datamesh.transport import exported_topics, places, reap, run_folder
from warploom.datamesh.transport.places import OrderFile, connect, listen, peer_of, unlisten
from warploom.errors import ConfigError


@pytest.fixture
def listening():
    """Listens; closed with the test."""
    sockets = []

    def make(node, topic):
        sockets.append(listen(node, topic))
        return sockets[-1]

    yield make
    for one in sockets:
        one.close()


def leave_a_socket(node, topic):
    """What a process leaves that is killed: a file at which nobody listens."""
    listen(node, topic).close()


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({"WARPLOOM_RUN": "{}/own", "XDG_RUNTIME_DIR": "{}/xdg"}, "own/node"),
        ({"XDG_RUNTIME_DIR": "{}/xdg"}, "xdg/warploom/node"),
    ],
)
def test_the_folder_is_its_users_alone(tmp_path, monkeypatch, environment, expected):
    monkeypatch.delenv("WARPLOOM_RUN", raising=False)
    (tmp_path / "xdg").mkdir()
    for key, value in environment.items():
        monkeypatch.setenv(key, value.format(tmp_path))
    folder = run_folder("node")
    assert folder == tmp_path / expected
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_without_settings_the_folder_is_named_after_the_user(monkeypatch):
    monkeypatch.delenv("WARPLOOM_RUN", raising=False)
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    folder = run_folder("test_places")
    try:
        assert str(folder) == f"/tmp/warploom-{os.getuid()}/test_places"
    finally:
        folder.rmdir()


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "../other", "a\0b"])
def test_a_name_that_is_none_of_a_folder_is_refused(name):
    with pytest.raises(ConfigError, match="name of a node"):
        run_folder(name)


def test_a_folder_that_leads_elsewhere_is_refused(node, tmp_path):
    folder = run_folder(node)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    folder.rmdir()
    folder.symlink_to(elsewhere)
    with pytest.raises(ConfigError, match="not a folder of this user alone"):
        run_folder(node)


def test_who_exports_a_topic_is_found_by_its_name(node, listening):
    assert connect(node, "a/b") is None
    listening(node, "a/b")
    with connect(node, "a/b") as one:
        assert peer_of(one) == (os.getpid(), os.getuid())
    assert exported_topics(node) == ["a/b"]


def test_two_nodes_do_not_meet(node, listening):
    listening(node, "a/b")
    assert connect("other", "a/b") is None
    assert exported_topics("other") == []


def test_a_topic_is_exported_once(node, listening):
    listening(node, "a/b")
    with pytest.raises(ConfigError, match=rf"'a/b' of node 'node' is exported already, by process {os.getpid()}"):
        listen(node, "a/b")


def test_the_socket_of_a_dead_process_is_taken_over(node, listening):
    leave_a_socket(node, "a/b")
    assert connect(node, "a/b") is None
    listening(node, "a/b")
    with connect(node, "a/b") as one:
        assert one is not None


def test_a_long_path_is_no_hindrance(monkeypatch, tmp_path, listening):
    monkeypatch.setenv("WARPLOOM_RUN", str(tmp_path / ("long" * 30)))
    for topic in ("a/b", "a/+ %b", 80 * "/", 80 * "a"):
        listening("node", topic)
        with connect("node", topic) as one:
            assert one is not None
        assert topic in exported_topics("node")


@pytest.mark.parametrize("topic", ["", "x" * 81])
def test_a_topic_that_cannot_be_the_name_of_a_file_is_refused(node, topic):
    with pytest.raises(ConfigError, match="cannot be exported"):
        listen(node, topic)


def test_reaping_takes_what_the_dead_left_and_names_it(node, listening):
    leave_a_socket(node, "dead")
    OrderFile(node, "dead").close()
    listening(node, "alive")
    links = run_folder(node) / "links"
    assert reap(node) == [str(links / "dead.socket")], "the orders are needed while others of the node live"
    assert exported_topics(node) == ["alive"]
    unlisten(node, "alive")
    assert reap(node, orders=False) == [], "one that is away is to come back"
    assert reap(node) == [str(links / "dead.order")]
    assert list(links.iterdir()) == []
    assert reap(node) == []


def test_reaping_leaves_a_socket_that_took_the_place_of_a_dead_one(node, monkeypatch, listening):
    """It is bound as soon as the old one is found dead."""
    leave_a_socket(node, "a")
    binding = threading.Thread(target=listening, args=(node, "a"))
    is_alive = places._is_alive

    def found(path):
        alive = is_alive(path)
        binding.start()
        binding.join(0.3)
        return alive

    monkeypatch.setattr(places, "_is_alive", found)
    reap(node)
    binding.join()
    assert connect(node, "a") is not None


def test_of_two_that_find_a_socket_dead_one_takes_its_place(node, monkeypatch, listening):
    leave_a_socket(node, "a")
    connected, both = places._connected, threading.Barrier(2)

    def found(path):
        other = connected(path)
        with suppress(threading.BrokenBarrierError):
            both.wait(0.3)
        return other

    refused = []

    def listens():
        try:
            listening(node, "a")
        except ConfigError as error:
            refused.append(str(error))

    monkeypatch.setattr(places, "_connected", found)
    threads = [threading.Thread(target=listens) for _ in range(2)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert refused == [f"topic 'a' of node 'node' is exported already, by process {os.getpid()}"]


def test_a_process_that_stops_in_the_middle_is_not_waited_for_for_ever(node, monkeypatch):
    monkeypatch.setattr(places, "_LOCK_S", 0.1)
    with places._locked(places._links(node)):
        with pytest.raises(ConfigError, match="is locked"):
            listen(node, "a")
        with pytest.raises(TimeoutError, match="is locked"):
            reap(node)
    listen(node, "a").close()


def test_a_process_that_hangs_is_not_dead(node, listening):
    """Its queue of connections is full, as nobody takes them."""
    one = listening(node, "a/b")
    one.listen(0)
    waiting = []
    try:
        while len(waiting) < 5:
            client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            client.setblocking(False)
            waiting.append(client)
            client.connect(str(run_folder(node) / "links" / "a+b.socket"))
    except BlockingIOError:
        pass
    try:
        assert reap(node) == []
        with pytest.raises(ConfigError, match="hangs"):
            listen(node, "a/b")
    finally:
        for client in waiting:
            client.close()


def test_a_forked_child_does_not_keep_the_sockets_of_a_process_that_ends(node, listening):
    one = listening(node, "a/b")
    child = os.fork()
    if child == 0:
        time.sleep(60)
        os._exit(0)
    try:
        one.close()
        end = time.monotonic() + 10
        while connect(node, "a/b") is not None:
            assert time.monotonic() < end
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


class TestOrder:
    """The epoch in which a producer goes on that comes back."""

    @staticmethod
    def life(node, *orders):
        """The epochs that a life of the producer is seen in; it ends without a word."""
        file = OrderFile(node, "topic")
        return [file.epoch(*order) for order in orders]

    def test_the_first_life_is_seen_as_it_is(self, node):
        assert self.life(node, (0, 10), (0, 20), (1, 5)) == [0, 0, 1]

    def test_where_the_versions_go_on_the_epoch_stays(self, node):
        self.life(node, (0, 10), (0, 20))
        assert self.life(node, (0, 21), (0, 30), (1, 1)) == [0, 0, 1]

    def test_where_they_begin_anew_a_new_epoch_does(self, node):
        self.life(node, (0, 10), (0, 20))
        assert self.life(node, (0, 10), (0, 20), (1, 1)) == [1, 1, 2]
        assert self.life(node, (0, 1)) == [3]

    def test_the_same_version_again_is_not_on_it(self, node):
        self.life(node, (0, 10))
        assert self.life(node, (0, 10)) == [1]

    def test_an_epoch_that_is_ahead_already_is_kept(self, node):
        self.life(node, (0, 100))
        assert self.life(node, (1, 3)) == [1]

    def test_a_life_that_loops_goes_on_after_the_one_before(self, node):
        self.life(node, (0, 10), (1, 10), (2, 10))
        assert self.life(node, (0, 5), (1, 5)) == [3, 4]

    def test_an_older_version_does_not_set_it_back(self, node):
        self.life(node, (0, 10), (0, 30), (0, 20))
        assert self.life(node, (0, 25)) == [1]

    def test_what_is_settled_again_by_who_comes_back_is_no_news(self, node):
        self.life(node, (0, 10))
        file = OrderFile(node, "topic")
        assert file.settled(0, 10) is None
        assert file.settled(0, 11) == 0
        assert file.epoch(0, 12) == 0
        assert file.settled(0, 3) == 0

    def test_without_room_on_the_disk_the_life_goes_on_and_is_forgotten(self, node, monkeypatch, caplog):
        def full(fd, offset, size):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        with monkeypatch.context() as disk:
            disk.setattr(os, "posix_fallocate", full)
            assert self.life(node, (0, 10), (0, 20)) == [0, 0]
        assert "No space left on device; the order of 'topic' is forgotten" in caplog.text
        assert self.life(node, (0, 10)) == [0]
        assert self.life(node, (0, 10)) == [1]

    def test_a_file_that_is_damaged_counts_as_none(self, node):
        self.life(node, (5, 10))
        path = run_folder(node) / "links" / "topic.order"
        path.write_bytes(b"short")
        assert self.life(node, (0, 1)) == [0]
