"""The compute devices: starts Warp, once and quietly, and resolves the names of devices."""

from __future__ import annotations

import threading
from functools import cache

import warp as wp

from ..errors import DeviceError

__all__ = ["DEFAULT_DEVICE", "device_names", "resolve_device"]

DEFAULT_DEVICE = "cpu"

_start = threading.Lock()


@cache
def _initialise() -> None:
    """Starts Warp without its banner; a second thread waits for the first."""
    with _start:
        wp.config.log_level = wp.LOG_WARNING
        # Nothing here is differentiated: adjoint code would double the time of a cold start.
        wp.config.enable_backward = False
        wp.init()


def device_names() -> list[str]:
    """The names of all devices of this machine: `cpu`, then `cuda:0`, and so on."""
    _initialise()
    return [str(device) for device in wp.get_devices()]


def resolve_device(name: str | None = None) -> str:
    """The canonical name of a device, checked to exist.

    Args:
        name: `cpu`, `cuda`, `cuda:0` …; None is the default, `cpu`.

    Raises:
        DeviceError: There is no such device here; the message lists those that are.
    """
    _initialise()
    if name is None or name == DEFAULT_DEVICE:
        return DEFAULT_DEVICE
    try:
        return str(wp.get_device(name))
    except (ValueError, RuntimeError) as error:
        raise DeviceError(
            f"no device {name!r} here; there are: {', '.join(device_names())}. "
            "A CUDA device needs an NVIDIA driver; everything also runs with device 'cpu'."
        ) from error


_initialise()
