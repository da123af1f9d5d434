"""The ways from process to process that `bench_transport.py` compares: each sends here, and receives in a child."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import shared_memory
from typing import Any, Literal

import numpy as np

from warploom.dag import BacklogConfig, DataProcessComponent
from warploom.dag.launch.linking import LinkPlan, Links
from warploom.datamesh import CommitPolicy, DataMesh, Input, Output, Status
from warploom.datamesh.transport import SharedMemoryConfig, ZenohConfig

__all__ = ["WAYS", "BareMessage", "send_all"]

Times = list[tuple[int, int]]
"""Of each datum that a receiver begins: its number, and when [ns]."""

KEPT = 4  # data that a reader keeps
LOST = 2_000_000_000  # [ns] after which a datum is given up
LOOK = 2e-4  # [s] from one look whether a datum has arrived to the next
PATIENCE = 20.0  # [s] for a child to be there
now = time.perf_counter_ns


class Way:
    """One way of data from process to process."""

    package = ""
    """What it needs."""

    def __init__(self, name: str, size: int, queue: Any) -> None:
        """Makes the sender's end.

        Args:
            name: Of this run, which no other has.
            size: Of the data [B].
            queue: A queue of multiprocessing, for who wants one.
        """

    def send(self, source: np.ndarray) -> tuple[int, int]:
        """Publishes a copy of `source`, int64; gives when it did, and when it began to write it [ns]."""
        raise NotImplementedError

    def close(self) -> None:
        """Ends it."""

    @classmethod
    def receive(cls, name: str, size: int, count: int, queue: Any, ready: Any) -> Times:
        """In the child: says that it is ready, and receives."""
        raise NotImplementedError


_begun: Any = None
"""In a child: how many data it has begun, which its parent sees."""


def taken(data: np.ndarray) -> tuple[int, int]:
    """The number of a datum, its first element, and when it was begun, which is now [ns]."""
    here = now()
    if _begun is not None:
        _begun.value += 1
    return int(data[0]), here


class Warploom(Way):
    """A topic of the mesh, whose payload is built in place, to a component that runs for it, as a launched one does."""

    remote: str | None = None
    hand_off: Literal["thread", "inline"] = "inline"
    spin_us = 1000.0

    def __init__(self, name: str, size: int, queue: Any) -> None:
        self._mesh = DataMesh(KEPT)
        self._links = self.links(self._mesh, name, exports=("data",))
        self._output: Output = Output()
        self._output.bind("data", self._mesh.window("data"))
        self._version = 0

    @classmethod
    def links(cls, mesh: DataMesh, name: str, exports: Any = (), imports: Any = ()) -> Links:
        """Started links."""
        remote = {"data": cls.remote} if cls.remote else {}
        endpoint = (f"tcp/127.0.0.1:{_port(name)}",)
        zenoh = (
            ZenohConfig(scouting=False, listen=endpoint) if exports else ZenohConfig(scouting=False, connect=endpoint)
        )
        role = "writer" if exports else "reader"
        shared = SharedMemoryConfig(memory_bytes=1 << 31, spin_us=cls.spin_us)
        plan = LinkPlan(exports, imports, remote=remote)
        links = Links(mesh, plan, node=name, name=role, shared_memory=shared, zenoh=zenoh)
        links.start()
        return links

    def send(self, source: np.ndarray) -> tuple[int, int]:
        with self._output.allocate_change() as change:
            begun = now()
            data = change.array(len(source), np.int64)
            data[:] = source
            change.set_version(self._version)
            change.value = data
            published = now()
            self._output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)
        self._version += 1
        return published, begun

    def close(self) -> None:
        self._links.stop()

    @classmethod
    def receive(cls, name: str, size: int, count: int, queue: Any, ready: Any) -> Times:
        times: Times = []
        ended = threading.Event()

        class Receiver(DataProcessComponent):
            data: Input[Any]

            def process(self, trigger):
                with self.data.access() as snapshot:
                    times.append(taken(snapshot[snapshot.version_index(trigger.version)]))
                if trigger.version == count - 1:  # one before may have been dropped, on a machine that is busy
                    ended.set()
                return Status.OK

        mesh = DataMesh(KEPT)
        component = Receiver("receiver")
        component.bind(mesh, {"data": "data"})
        component.set_trigger("data", BacklogConfig(policy="fifo", depth=KEPT - 2), cls.hand_off)
        component.start()
        sys.setswitchinterval(100e-6)  # as a process does
        links = cls.links(mesh, name, imports=("data",))
        while not links.counters()["data"]["connected"]:
            time.sleep(0.01)
        ready.set()
        ended.wait(PATIENCE)
        links.stop()
        component.stop()
        return times


class WarploomThread(Warploom):
    """The same to a component with a thread of its own: `hand_off: thread`."""

    hand_off = "thread"


class WarploomSleeping(Warploom):
    """The same, where the thread that receives sleeps until a datum is there: `spin_us: 0`."""

    spin_us = 0.0


class WarploomZenoh(Warploom):
    """The same over zenoh, as between hosts."""

    package = "zenoh"
    remote = "zenoh"


class Queue(Way):
    """multiprocessing's queue, which pickles, as LSD does."""

    def __init__(self, name: str, size: int, queue: Any) -> None:
        self._queue = queue

    def send(self, source: np.ndarray) -> tuple[int, int]:
        published = now()
        self._queue.put(source)
        return published, published

    @classmethod
    def receive(cls, name: str, size: int, count: int, queue: Any, ready: Any) -> Times:
        ready.set()
        return [taken(queue.get()) for _ in range(count)]


class Zenoh(Way):
    """zenoh as it is, over the loopback."""

    package = "zenoh"
    shared = False

    def __init__(self, name: str, size: int, queue: Any) -> None:
        self._session = self.session(name, listens=True)
        self._publisher = self._session.declare_publisher(name, express=True)

    @classmethod
    def session(cls, name: str, *, listens: bool) -> Any:
        import zenoh

        config = zenoh.Config()
        endpoint = f'["tcp/127.0.0.1:{_port(name)}"]'
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("listen/endpoints", endpoint if listens else "[]")
        config.insert_json5("connect/endpoints", "[]" if listens else endpoint)
        config.insert_json5("transport/shared_memory/enabled", "true" if cls.shared else "false")
        return zenoh.open(config)

    def send(self, source: np.ndarray) -> tuple[int, int]:
        published = now()
        self._publisher.put(source.tobytes())
        return published, published

    def close(self) -> None:
        self._session.close()

    @classmethod
    def receive(cls, name: str, size: int, count: int, queue: Any, ready: Any) -> Times:
        times: Times = []
        ended = threading.Event()

        def read(sample: Any) -> None:
            data = np.frombuffer(sample.payload.to_bytes(), np.int64)
            times.append(taken(data))
            if data[0] == count - 1:
                ended.set()

        with cls.session(name, listens=False) as session:
            subscriber = session.declare_subscriber(name, read)
            time.sleep(0.5)  # for the sender to hear of it
            ready.set()
            ended.wait(PATIENCE)
            subscriber.undeclare()
        return times


class ZenohSharedMemory(Zenoh):
    """zenoh with its shared memory."""

    shared = True

    def __init__(self, name: str, size: int, queue: Any) -> None:
        super().__init__(name, size, queue)
        from zenoh.shm import BlockOn, GarbageCollect, ShmProvider

        self._provider = ShmProvider.default_backend(max(1 << 20, 8 * size))
        self._policy = BlockOn(GarbageCollect())

    def send(self, source: np.ndarray) -> tuple[int, int]:
        begun = now()
        buffer = self._provider.alloc(source.nbytes, self._policy)
        buffer[:] = source.tobytes()
        published = now()
        self._publisher.put(buffer)
        return published, begun


class Iceoryx(Way):
    """iceoryx2 as it is: a loaned sample is written, sent, and an event wakes the reader."""

    package = "iceoryx2"

    def __init__(self, name: str, size: int, queue: Any) -> None:
        self._ends = _iceoryx(name)
        data, event = self._ends[1:]
        self._publisher = data.publisher_builder().initial_max_slice_len(size).create()
        self._notifier = event.notifier_builder().create()
        self._size = size

    def send(self, source: np.ndarray) -> tuple[int, int]:
        begun = now()
        sample = self._publisher.loan_slice_uninit(self._size)
        data = _array(sample.payload().data_ptr, self._size)
        data[:] = source
        published = now()
        sample.assume_init().send()
        self._notifier.notify()
        return published, begun

    def close(self) -> None:
        self._publisher.delete()
        self._notifier.delete()

    @classmethod
    def receive(cls, name: str, size: int, count: int, queue: Any, ready: Any) -> Times:
        _, data, event = _iceoryx(name)
        subscriber = data.subscriber_builder().create()
        listener = event.listener_builder().create()
        ready.set()
        times: Times = []
        while True:
            listener.blocking_wait()
            while (sample := subscriber.receive()) is not None:
                data = _array(sample.payload().data_ptr, size)
                times.append(taken(data))
                if data[0] == count - 1:
                    return times


def _iceoryx(name: str) -> Any:
    """The node and its services for data and for waking."""
    import iceoryx2 as iox

    iox.set_log_level_from_env_or(iox.LogLevel.Error)
    node = iox.NodeBuilder.new().create(iox.ServiceType.Ipc)
    service = node.service_builder(iox.ServiceName.new(f"{name}/data")).publish_subscribe(iox.Slice[ctypes.c_uint8])
    event = node.service_builder(iox.ServiceName.new(f"{name}/event")).event()
    return node, service.subscriber_max_buffer_size(KEPT).open_or_create(), event.open_or_create()


def _array(address: int, size: int) -> np.ndarray:
    """Memory at an address as int64."""
    return np.frombuffer((ctypes.c_char * size).from_address(address), np.int64)


class Posix(Way):
    """POSIX shared memory as it is: blocks by turns, and a message of a Unix socket that says which."""

    BLOCKS = 8

    def __init__(self, name: str, size: int, queue: Any) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._address = _address(name)
        self._memory = shared_memory.SharedMemory(name, create=True, size=size * self.BLOCKS)
        self._blocks = np.frombuffer(self._memory.buf, np.int64).reshape(self.BLOCKS, -1)
        self._number = 0

    def send(self, source: np.ndarray) -> tuple[int, int]:
        begun = now()
        number = self._number % self.BLOCKS
        data = self._blocks[number, : len(source)]
        data[:] = source
        published = now()
        self._socket.sendto(bytes((number,)), self._address)
        self._number += 1
        return published, begun

    def close(self) -> None:
        self._socket.close()
        del self._blocks
        self._memory.close()
        self._memory.unlink()

    @classmethod
    def receive(cls, name: str, size: int, count: int, queue: Any, ready: Any) -> Times:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as one:
            one.bind(_address(name))
            memory = shared_memory.SharedMemory(name)  # a child has its maker's tracker, which removes it once
            blocks = np.frombuffer(memory.buf, np.int64).reshape(cls.BLOCKS, -1)
            ready.set()
            times = [taken(blocks[one.recv(1)[0]]) for _ in range(count)]
            os.unlink(_address(name))
            del blocks
            memory.close()
        return times


def _address(name: str) -> str:
    return os.path.join(tempfile.gettempdir(), f"{name}.socket")


def _port(name: str) -> int:
    return 20000 + int(name.rpartition("-")[2]) % 20000


WAYS: dict[str, type[Way]] = {
    "warploom": Warploom,
    "warploom, hand_off: thread": WarploomThread,
    "warploom, spin_us: 0": WarploomSleeping,
    "warploom over zenoh": WarploomZenoh,
    "multiprocessing.Queue": Queue,
    "zenoh": Zenoh,
    "zenoh, its shared memory": ZenohSharedMemory,
    "iceoryx2": Iceoryx,
    "POSIX shared memory": Posix,
}
"""What is compared, by name."""


def _serve(way: str, name: str, size: int, count: int, queue: Any, ready: Any, begun: Any, result: Any) -> None:
    global _begun
    _begun = begun
    since = _Since(ready)
    result.send((WAYS[way].receive(name, size, count, queue, since), since.share()))


class _Since:
    """The event of a child that is ready, and what it takes of a core from then on."""

    def __init__(self, ready: Any) -> None:
        self._ready = ready
        self._cpu = self._wall = 0

    def set(self) -> None:
        self._cpu, self._wall = time.process_time_ns(), now()
        self._ready.set()

    def share(self) -> float:
        return (time.process_time_ns() - self._cpu) / (now() - self._wall)


@contextmanager
def _child(way: str, name: str, size: int, count: int, queue: Any) -> Iterator[tuple[Any, Any, Any]]:
    """A process that receives: when it is ready, how many it has begun, its result. It is dead at the end."""
    context = multiprocessing.get_context("spawn")
    ready, begun = context.Event(), context.RawValue("q", 0)
    here, there = context.Pipe(duplex=False)
    child = context.Process(target=_serve, args=(way, name, size, count, queue, ready, begun, there), daemon=True)
    child.start()
    there.close()
    try:
        yield ready, begun, here
        child.join(5.0)  # who is killed leaves its memory behind, with some of the peers
    finally:
        child.kill()
        child.join()
        here.close()


class BareMessage:
    """A message of 64 bytes of a Unix socket to a process that waits for it: what this machine takes, and no less."""

    RECEIVER = """
import socket, sys, time
one = socket.socket(fileno=int(sys.argv[1]))
times = []
while data := one.recv(64):
    times.append(time.perf_counter_ns() - int.from_bytes(data[:8], "little"))
one.send(b"".join(time.to_bytes(8, "little") for time in times))
"""

    def __init__(self) -> None:
        """Starts the process."""
        self._socket, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        fd = there.fileno()
        self._process = subprocess.Popen([sys.executable, "-S", "-E", "-c", self.RECEIVER, str(fd)], pass_fds=(fd,))
        there.close()

    def send(self) -> None:
        """Sends one."""
        self._socket.send(now().to_bytes(8, "little") + bytes(56))

    def end(self) -> np.ndarray:
        """How long each took until the receiver's next line [ns]."""
        self._socket.shutdown(socket.SHUT_WR)
        return np.frombuffer(self._socket.recv(1 << 20), np.int64)

    def close(self) -> None:
        """Ends the process, whatever it does."""
        self._socket.close()
        self._process.kill()
        self._process.wait()


def send_all(way: str, size: int, count: int, every_s: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Sends data by one way to a child, and between them bare messages to another.

    Args:
        way: Of `WAYS`.
        size: Of each [B], a multiple of 8.
        count: How many.
        every_s: Time from the arrival of one to the next, in which the receiver goes to sleep [s].

    Returns:
        For each that came, from its publication to the start of the receiver's code, and from before it was written to
        there [ns], shape (n, 2), int64; what the bare messages took [ns], shape (count,), int64; and how much of a core
        the receiver took meanwhile.

    Raises:
        TimeoutError: The child does not come, or data are missing.
    """
    name = f"warploom-bench-{os.getpid()}{now() % 10**6:06d}"
    queue = multiprocessing.get_context("spawn").Queue()
    source = np.arange(size // 8)
    sent = []
    bare = BareMessage()
    sender = None
    try:
        sender = WAYS[way](name, size, queue)
        with _child(way, name, size, count, queue) as (ready, begun, result):
            if not ready.wait(PATIENCE):
                raise TimeoutError(f"{way}: the receiver is not there after {PATIENCE} s")
            for number in range(count):
                time.sleep(every_s / 2)
                bare.send()
                time.sleep(every_s / 2)
                source[0] = number
                before, end = begun.value, now() + LOST
                sent.append(sender.send(source))
                while begun.value == before and now() < end:  # nothing waits behind another: what one takes, unloaded
                    time.sleep(LOOK)
            if not result.poll(PATIENCE):
                raise TimeoutError(f"{way}: not all of {count} data of {size} bytes have arrived")
            times, share = result.recv()
        took = [(here - sent[number][0], here - sent[number][1]) for number, here in times]
        return np.array(took, np.int64).reshape(-1, 2), bare.end(), share
    finally:
        bare.close()
        if sender is not None:
            sender.close()
        queue.cancel_join_thread()  # what nobody has read is not waited for
        queue.close()
        with suppress(FileNotFoundError):
            os.unlink(_address(name))
