"""The compute devices: starts Warp, once and quietly, and resolves the names of devices."""

from __future__ import annotations

import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import warp as wp

from ..errors import DeviceError

__all__ = ["DEFAULT_DEVICE", "device_names", "module_apart", "resolve_device"]

DEFAULT_DEVICE = "cpu"

_start = threading.Lock()


_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


@contextmanager
def _driver_warning_left_out() -> Iterator[None]:
    """Passes on what native code writes to stderr, less the line by which Warp greets every machine without a GPU."""
    try:
        sys.stderr.flush()
        kept = os.dup(2)
    except (OSError, AttributeError):  # a process without stderr
        yield
        return
    with tempfile.TemporaryFile() as written:
        os.dup2(written.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            written.seek(0)
            os.write(2, b"".join(line for line in written if _NO_DRIVER not in line))


@cache
def _initialise() -> None:
    """Starts Warp without its banner; a second thread waits for the first."""
    with _start:
        wp.config.log_level = wp.LOG_WARNING
        # Nothing here is differentiated: adjoint code would double the time of a cold start.
        wp.config.enable_backward = False
        with _driver_warning_left_out():
            wp.init()


def device_names() -> list[str]:
    """The names of all devices of this machine: `cpu`, then `cuda:0`, and so on."""
    _initialise()
    return [str(device) for device in wp.get_devices()]


def module_apart(name: str, fuse_fp: bool = True) -> wp.Module:
    """A Warp module beside that of a file, for kernels which a CPU as a rule does not launch, nor then compiles.

    Args:
        name: The file's `__name__`.
        fuse_fp: Warp's option of this name, which a file's own module does not hand on.
    """
    module = wp.get_module(f"{name}.apart")
    wp.set_module_options({"fuse_fp": fuse_fp}, module)
    return module


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
