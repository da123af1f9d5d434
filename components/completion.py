"""Completion events of payloads that Warp writes on a device."""

from __future__ import annotations

import warp as wp

from ..datamesh import Completion
from ..kernels.device import resolve_device

__all__ = ["StreamCompletion", "completion_on"]


class StreamCompletion:
    """The moment at which everything queued on a stream so far is done.

    with output.allocate_change() as change:
        change.value = boxes
        change.completes_with(StreamCompletion(wp.get_stream(device)))
    """

    def __init__(self, stream: wp.Stream) -> None:
        """Records an event on the stream.

        Args:
            stream: Of a CUDA device.
        """
        self.stream = stream
        self._event = wp.Event(stream.device)
        stream.record_event(self._event)

    def synchronize(self) -> None:
        """The calling thread waits for it."""
        wp.synchronize_event(self._event)

    def wait_on(self, stream: wp.Stream) -> None:
        """What is queued on `stream` from now on waits for it; the calling thread does not."""
        stream.wait_event(self._event)


def completion_on(device: str) -> Completion | None:
    """The completion of what was launched on a device so far; None on a CPU, where it is done when a launch returns.

    Raises:
        DeviceError: There is no such device.
    """
    resolved = wp.get_device(resolve_device(device))
    return StreamCompletion(wp.get_stream(resolved)) if resolved.is_cuda else None
