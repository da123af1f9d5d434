"""Another process of a node: `peer.py NODE write|read|relay NAME …`. What it does, it says as JSON lines.

write NAME TOPIC FIRST BYTES PERIOD_MS COUNT   commits clouds of one number, its version, built in place
read NAME TOPIC                                says of each that it gets whether it is whole
note NAME TOPIC                                notes what is committed, as a recorder does
relay NAME FROM TO                             commits to TO what it reads of FROM

Where PEER_ZENOH holds a configuration, it does so over zenoh.
"""

import json
import os
import sys
import threading
import time
from dataclasses import dataclass

import numpy as np

from warploom.dag import BacklogConfig, DataProcessComponent
from warploom.dag.launch.linking import LinkPlan, Links
from warploom.datamesh import CommitPolicy, DataMesh, Input, Output
from warploom.datamesh.messages import message
from warploom.datamesh.transport import SharedMemoryConfig, ZenohConfig

CONFIG = SharedMemoryConfig(memory_bytes=1 << 28, retry_ms=2.0, kept=1 << 14, kept_s=600.0)


@message("test.Whole")
@dataclass(frozen=True, eq=False)
class Whole:
    """A payload of which every element is the same number."""

    values: np.ndarray
    number: int

    @classmethod
    def allocate(cls, array, size, number):
        """Makes one that is not filled."""
        return cls(array(size, np.int64), number)


def say(**what):
    """Says it."""
    os.write(1, json.dumps(what).encode() + b"\n")


class Reader(DataProcessComponent):
    """Looks at what comes."""

    data: Input[Whole]

    def process(self, trigger):
        """Says whether it is whole."""
        with self.data.access() as snapshot:
            index = snapshot.version_index(trigger.version)
            value = snapshot[index]
            whole = bool((value.values == value.number).all()) and value.number == trigger.version
            say(read=trigger.version, epoch=trigger.epoch, whole=whole, received=snapshot.entry(index).received_ns)


class Relay(DataProcessComponent):
    """Gives on what comes."""

    data: Input[Whole]
    result: Output[Whole]

    def process(self, trigger):
        """Gives it on."""
        with self.data.access() as snapshot:
            value = snapshot[snapshot.version_index(trigger.version)]
            with self.result.allocate_change() as change:
                change.set_version(trigger.version, trigger.received_ns)
                copy = change.allocate(Whole, len(value.values), value.number)
                copy.values[:] = value.values
                change.value = copy
                self.result.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)


def write(mesh, topic, first, size, period_ms, count):
    """Commits."""
    output = Output()
    output.bind("output", mesh.window(topic))
    for version in range(int(first), int(first) + int(count)):
        with output.allocate_change() as change:
            value = change.allocate(Whole, int(size) // 8, version)
            value.values[:] = version
            change.set_version(version)
            change.value = value
            output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)
        say(committed=version)
        time.sleep(float(period_ms) / 1e3)


def main(node, kind, name, *arguments):
    """Does it until it is killed, or has written all."""
    mesh = DataMesh(8)
    read = (), arguments[:1]
    topics = {"write": (arguments[:1], ()), "read": read, "note": read, "relay": (arguments[1:], arguments[:1])}[kind]
    zenoh = ZenohConfig.model_validate_json(os.environ["PEER_ZENOH"]) if "PEER_ZENOH" in os.environ else None
    remote = dict.fromkeys(arguments, "zenoh") if zenoh is not None else {}
    plan = LinkPlan(*topics, remote=remote)
    links = Links(mesh, plan, node=node, name=name, shared_memory=CONFIG, zenoh=zenoh)
    if kind == "note":
        mesh.window(arguments[0]).subscribe(
            lambda entry: say(noted=entry.version, late=(time.monotonic_ns() - entry.committed_ns) / 1e9),
            lambda *_: None,
        )
    elif kind != "write":
        component = (Reader if kind == "read" else Relay)(name)
        component.bind(mesh, dict(zip(("data", "result"), arguments, strict=False)))
        component.set_trigger("data", BacklogConfig(policy="fifo", depth=4))
        component.start()
    links.start()
    say(ready=os.getpid())
    if kind == "write":
        write(mesh, *arguments)
        say(counters=links.counters())
        links.stop()
    else:
        threading.Event().wait()


if __name__ == "__main__":
    main(*sys.argv[1:])
