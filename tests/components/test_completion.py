"""Completion events: none on a CPU; on a GPU readers elsewhere wait, and those on the stream do not."""

import numpy as np
import pytest
import warp as wp

from warploom.components.completion import StreamCompletion, completion_on
from warploom.components.execution import ExecutionContext
from warploom.datamesh import CommitPolicy, Input, Output, Window
from warploom.errors import DeviceError


@wp.kernel
def _count_up(rounds: int, values: wp.array(dtype=wp.int32)):
    i = wp.tid()
    for _ in range(rounds):
        values[i] = values[i] + 1


def test_on_a_cpu_what_was_launched_is_done():
    assert completion_on("cpu") is None


def test_the_context_of_a_cpu_has_neither_stream_nor_event():
    context = ExecutionContext(device="cpu")
    assert context.stream is None
    assert context.completion() is None


class Fake:
    """Of a stream and its device, what an event needs."""

    def __init__(self):
        self.device, self.told = "cuda:0", []

    def record_event(self, event):
        self.told.append(("record", event))

    def wait_event(self, event):
        self.told.append(("wait", event))


def test_the_event_is_recorded_on_the_stream_that_writes_and_waited_for_on_the_one_that_reads(monkeypatch):
    """The calls that a CUDA device would be given, where there is none."""
    waited = []
    monkeypatch.setattr(wp, "Event", lambda device: f"event of {device}")
    monkeypatch.setattr(wp, "synchronize_event", waited.append)
    own, other, event = Fake(), Fake(), "event of cuda:0"
    completion = StreamCompletion(own)
    assert own.told == [("record", event)]
    completion.wait_on(other)
    assert (own.told, other.told, waited) == ([("record", event)], [("wait", event)], [])
    completion.synchronize()
    assert waited == [event]


def test_a_device_that_is_not_there_is_refused():
    with pytest.raises(DeviceError):
        completion_on("cuda:99")


@pytest.mark.cuda
@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device here")
@pytest.mark.parametrize("where", ["host", "other stream", "own stream"])
def test_a_reader_sees_what_the_device_had_still_to_write(where):
    device = wp.get_device("cuda:0")
    window, rounds = Window("topic"), 200_000
    output, reader = Output(), Input()
    output.bind("output", window)
    reader.bind("reader", window)
    own, other = wp.get_stream(device), wp.Stream(device)
    values, copied = wp.zeros(64, dtype=wp.int32, device=device), wp.zeros(64, dtype=wp.int32, device=device)
    wp.launch(_count_up, 64, inputs=[rounds, values], device=device)
    with output.allocate_change() as change:
        change.set_version(1)
        change.value = values
        change.completes_with(StreamCompletion(own))
        output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)
    stream = {"host": None, "other stream": other, "own stream": own}[where]
    with reader.access(stream=stream) as snapshot:
        wp.copy(copied, snapshot.last(), stream=stream or other)
    wp.synchronize_device(device)
    assert np.all(copied.numpy() == rounds)
