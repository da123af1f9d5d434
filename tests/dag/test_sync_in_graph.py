"""Strong sync in a graph with workers: who waits, who goes on meanwhile, and how a stop ends it."""

import threading

import pytest
from graph_parts import Call
from sync_parts import Mesh

from warploom.dag import (
    AlignDagProcessor,
    BacklogConfig,
    DagComponent,
    In,
    MonotonicDagComponent,
    Processor,
    Vertex,
)
from warploom.datamesh import Outcome, Status

WAIT = 20.0
pytestmark = pytest.mark.usefixtures("no_thread_left")


def test_what_was_read_is_in_the_timings(no_thread_left):
    mesh, results, timings = Mesh("lidar", "camera", "result"), Results(), []
    component = aligning(mesh, results, on_timing=timings.append)
    component.start()
    mesh.commit("camera", 10)
    mesh.commit("lidar", 10, 20)
    results.wait_for(10)
    component.stop()
    reads = {(one.vertex, one.version): dict(one.reads) for one in timings}
    assert reads == {
        ("align", 10): {"camera": (0, 10)},
        ("collect", 10): {},
        ("align", 20): {"camera": Outcome.SHUTDOWN},
        ("collect", 20): {},
    }


class Collect(Processor):
    """Gives what was aligned to the context."""

    aligned: In[object]

    def process(self, trigger):
        self.context(trigger.version, self.aligned.value)
        return Status.OK


def aligning(
    mesh, on_aligned, *, workers=1, in_flight=1, timeout_ms=60_000.0, kind=DagComponent, extra=(), on_timing=None
):
    """A component that aligns `camera` with its trigger `lidar`; it is given to `on_aligned`."""
    component = kind("fusion")
    component.add_handles(["lidar", "camera"], ["result"])
    component.bind(mesh.mesh, {"lidar": "lidar", "camera": "camera", "result": "result"})
    align, collect = AlignDagProcessor(), Collect()
    align.component_inputs, align.losses, align.place = component.inputs, mesh.mesh.losses, "fusion.align"
    align.init(AlignDagProcessor.Config(inputs=["camera"], timeout_ms=timeout_ms))
    collect.context = on_aligned
    vertices = [
        Vertex(
            "align",
            align,
            {},
            {"aligned": "aligned"},
            config=AlignDagProcessor.Config(inputs=["camera"], timeout_ms=timeout_ms),
        )
    ]
    vertices += [Vertex("collect", collect, {"aligned": "aligned"}, {}), *extra]
    component.set_graph(vertices, workers=workers, in_flight=in_flight, on_timing=on_timing)
    component.set_trigger("lidar", BacklogConfig(policy="fifo", depth=6))
    return component


class Results:
    def __init__(self):
        self.got, self.changed = {}, threading.Condition()

    def __call__(self, version, aligned):
        with self.changed:
            self.got[version] = aligned
            self.changed.notify_all()

    def wait_for(self, *versions):
        with self.changed:
            assert self.changed.wait_for(lambda: set(versions) <= set(self.got), WAIT), sorted(self.got)


def test_a_waiter_gives_its_worker_back():
    """One worker: the vertex beside the waiting one runs, and commits what is waited for."""
    mesh, results = Mesh("lidar", "camera", "result"), Results()
    producer = Call()
    producer.name = "producer"
    producer.context = {"producer": lambda trigger, value: mesh.commit("camera", trigger.version)}
    extra = [Vertex("producer", producer, {"value": "lidar"}, {"result": "produced"})]
    component = aligning(mesh, results, workers=1, extra=extra)
    component.start()
    mesh.commit("lidar", 10, 20, 30)
    results.wait_for(10, 20, 30)
    component.stop()
    assert [aligned.versions for aligned in results.got.values()] == [{"camera": 10}, {"camera": 20}, {"camera": 30}]


def test_a_pool_of_one_whose_producer_is_queued_behind_it_ends_with_the_deadline_not_in_a_deadlock():
    """The monotonic graph lets one frame in; frame 20, which would bring the camera of frame 10, waits behind it."""
    mesh, results = Mesh("lidar", "camera", "result"), Results()
    producer = Call()
    producer.name = "producer"
    producer.context = {"producer": lambda trigger, value: trigger.version == 20 and mesh.commit("camera", 10, 20)}
    extra = [Vertex("producer", producer, {"value": "lidar"}, {"result": "produced"})]
    component = aligning(mesh, results, timeout_ms=1000e-6, kind=MonotonicDagComponent, extra=extra)
    component.start()
    mesh.commit("lidar", 10, 20)
    while not mesh.mesh.window("camera")._waits:
        threading.Event().wait(0.001)
    assert results.got == {}
    mesh.clock.advance(1000)
    results.wait_for(10, 20)
    component.stop()
    assert results.got[10].outcomes == {"camera": Outcome.TIMEOUT}
    assert results.got[20].outcomes == {"camera": Outcome.TIMEOUT}, "its time counted while it was queued"


def test_the_main_flow_goes_on_without_a_dead_input():
    mesh, results = Mesh("lidar", "camera", "result"), Results()
    component = aligning(mesh, results, timeout_ms=0.0)
    component.start()
    for version in (10, 20, 30):
        mesh.commit("lidar", version)
        results.wait_for(version)
    component.stop()
    assert [aligned.absent for aligned in results.got.values()] == [("camera",)] * 3
    assert mesh.mesh.losses.as_dict() == {"fusion.align": {"camera timeout": 3}}


@pytest.mark.parametrize("workers", [1, 2, 8])
def test_a_stop_ends_the_waits_and_finishes_the_frames_behind_them_and_the_component_starts_again(workers):
    mesh, results = Mesh("lidar", "camera", "result"), Results()
    component = aligning(mesh, results, workers=workers, in_flight=2)
    for cycle in range(3):
        component.start()
        base = cycle * 100
        mesh.commit("lidar", base + 10, base + 20, base + 30)
        mesh.commit("camera", base + 10)
        results.wait_for(base + 10)
        component.stop()
        assert results.got[base + 10].absent == ()
        assert results.got[base + 20].outcomes == results.got[base + 30].outcomes == {"camera": Outcome.SHUTDOWN}


def test_results_do_not_depend_on_the_number_of_workers():
    """Every camera frame comes before or after its lidar frame, as the seed says; each is found."""
    import hashlib
    import random

    hashes = set()
    for workers in (1, 2, 8):
        mesh, results = Mesh("lidar", "camera", "result", capacity=64), Results()
        component = aligning(mesh, results, workers=workers, in_flight=4)
        component.start()
        order = random.Random(4)
        for version in range(30):
            topics = ["lidar", "camera"]
            order.shuffle(topics)
            for topic in topics:
                mesh.commit(topic, version)
            results.wait_for(version)
        component.stop()
        said = repr([(version, one.values, one.outcomes) for version, one in results.got.items()])
        hashes.add(hashlib.sha256(said.encode()).hexdigest())
        assert all(one.absent == () for one in results.got.values())
    assert len(hashes) == 1
