"""Meshes that are linked, in one process and in several, each node in a folder of its own."""

import json
import os
import pathlib
import queue
import subprocess
import sys
import threading
import time
from dataclasses import dataclass

import numpy as np
import pytest

from warploom.dag.launch.linking import LinkPlan, Links
from warploom.datamesh import CommitPolicy, DataMesh, Input, Output
from warploom.datamesh.messages import message
from warploom.datamesh.transport import SharedMemoryConfig

PEER = pathlib.Path(__file__).with_name("peer.py")
# Limits say that something hangs, not that it is slow: they are only waited for where a test fails.
PATIENCE = 30.0  # [s] for what takes milliseconds
STARTING = 120.0  # [s] for the first word of a new process: a second of imports, of which others may take most


def until(condition, what="it"):
    """Waits until a condition holds; fails when it does not in a long time."""
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, f"waited {PATIENCE} s for {what() if callable(what) else what}"
        time.sleep(0.002)


@message("test.Cloud")
@dataclass(frozen=True, eq=False)
class Cloud:
    """A payload of two arrays and a text."""

    xyz: np.ndarray
    intensity: np.ndarray
    frame: str = "lidar"

    @classmethod
    def allocate(cls, array, capacity):
        return cls(array((capacity, 3), np.float32), array(capacity, np.float32))


@pytest.fixture
def cloud_type():
    return Cloud


@pytest.fixture
def built():
    """What builds a cloud in place, all of whose elements are one number."""

    def built(version, points=1000):
        def build(change):
            cloud = change.allocate(Cloud, points)
            cloud.xyz[:], cloud.intensity[:] = version, -version
            return cloud

        return build

    return built


@pytest.fixture
def private():
    """Makes a cloud that is not built in place."""

    def private(version, points=1000):
        return Cloud(np.full((points, 3), version, np.float32), np.full(points, -version, np.float32))

    return private


class Side:
    """One mesh and its links."""

    def __init__(
        self, node, name, exports=(), imports=(), capacity=8, blocking=(), remote=None, zenoh=None, reads=None, **config
    ):
        self.mesh = DataMesh(capacity)
        self.plan = LinkPlan(tuple(exports), tuple(imports), tuple(blocking), remote or {})
        config = SharedMemoryConfig(**{"memory_bytes": 1 << 24, "retry_ms": 2.0, **config})
        self.links = Links(self.mesh, self.plan, node=node, name=name, shared_memory=config, zenoh=zenoh)
        self.commits = {}
        self.settled = {}
        for topic in imports:
            self.commits[topic], self.settled[topic] = [], []
            self.mesh.window(topic).subscribe(
                lambda entry, topic=topic: self.commits[topic].append((entry.epoch, entry.version, entry.triggers)),
                lambda version, epoch, topic=topic: self.settled[topic].append((epoch, version)),
            )
            if reads is not None:  # an event: it reads on once that is set
                self.mesh.window(topic).subscribe(lambda entry: reads.wait(PATIENCE), lambda *_: None)
        self.links.start()

    def output(self, topic):
        output = Output()
        output.bind("output", self.mesh.window(topic))
        return output

    def input(self, topic):
        handle = Input()
        handle.bind("input", self.mesh.window(topic))
        return handle

    def commit(self, topic, version, value, policy=CommitPolicy.DISCARD_OUT_OF_ORDER, **options):
        output = self.output(topic)
        with output.allocate_change() as change:
            change.set_version(version)
            change.value = value(change) if callable(value) else value
            return output.commit(policy, change, **options)

    def last(self, topic="topic"):
        with self.input(topic).access() as snapshot:
            return snapshot.last()

    def shown(self, topic="topic"):
        with self.input(topic).access() as snapshot:
            return list(snapshot)

    def until_shown(self, version, epoch=0, topic="topic"):
        window = self.mesh.window(topic)
        until(lambda: (s := window.snapshot()).versions[-1:] == (version,) and s.epoch == epoch, f"version {version}")

    def counts(self, topic):
        return self.links.counters()[topic]

    wait = staticmethod(until)

    def until(self, condition, topic, what=None):
        until(lambda: condition(self.counts(topic)), what or (lambda: f"{topic}: {self.counts(topic)}"))


@pytest.fixture
def node(tmp_path, monkeypatch):
    """The name of a node that has a folder of its own."""
    monkeypatch.setenv("WARPLOOM_RUN", str(tmp_path / "run"))
    return "node"


@pytest.fixture
def side(node):
    """Makes meshes of the node with their links; all end with the test."""
    sides = []

    def make(name, *, of=node, **options):
        sides.append(Side(of, name, **options))
        return sides[-1]

    yield make
    for one in sides:
        one.links.stop()


@pytest.fixture
def linked(side):
    """A writer and a reader of `topic`, connected."""

    def make(**options):
        writer = side("writer", exports=["topic"], **options)
        reader = side("reader", imports=["topic"], **options)
        writer.until(lambda counts: counts["readers"] == 1, "topic")
        return writer, reader

    return make


class Peer:
    """Another process, which says as JSON lines what it does."""

    def __init__(self, arguments, environment):
        self.process = subprocess.Popen(
            [sys.executable, str(PEER), *map(str, arguments)], stdout=subprocess.PIPE, text=True, env=environment
        )
        self.pid = self.process.pid
        self._lines = queue.SimpleQueue()
        self._patience = STARTING
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self):
        for line in self.process.stdout:
            self._lines.put(line)
        self._lines.put(None)

    def next(self):
        """What it says next; None at its end."""
        line = self._lines.get(timeout=self._patience)
        self._patience = PATIENCE
        return None if line is None else json.loads(line)

    def wait_for(self, key):
        """What it says next that has a key."""
        while (told := self.next()) is not None:
            if key in told:
                return told
        raise AssertionError(f"it ended without saying {key!r}")

    def rest(self):
        """All that it said until its end."""
        told = []
        while (one := self.next()) is not None:
            told.append(one)
        return told

    def kill(self):
        """Ends it as `kill -9` does."""
        self.process.kill()
        self.process.wait(PATIENCE)
        self._thread.join(PATIENCE)
        self.process.stdout.close()


@pytest.fixture
def peer(node):
    """Starts other processes of the node; all are dead at the end of the test."""
    peers = []

    def start(*arguments, of=node, zenoh=None):
        environment = dict(os.environ) if zenoh is None else {**os.environ, "PEER_ZENOH": zenoh.model_dump_json()}
        one = Peer((of, *arguments), environment)
        peers.append(one)
        return one

    try:
        yield start
    finally:
        for one in peers:
            one.kill()
