"""The libraries that can compute a kernel: Warp, and Taichi for the devices that Warp does not know."""

from __future__ import annotations

import importlib.util

__all__ = ["BACKENDS", "is_installed", "uses_taichi"]

BACKENDS = ("warp", "taichi", "taichi:cpu", "taichi:vulkan", "taichi:metal", "taichi:cuda")
"""`taichi` alone computes where Taichi runs already, or on the CPU; the others start it on that device."""


def is_installed(backend: str) -> bool:
    """Whether the library of one of `BACKENDS` is there."""
    return backend == "warp" or importlib.util.find_spec("taichi") is not None


def uses_taichi(backend: str) -> bool:
    """Whether `backend` is Taichi, and started where it says; else it is Warp.

    Raises:
        ValueError: It is neither.
        ImportError: It is Taichi, which is not installed.
        DeviceError: Taichi cannot compute on the device, or runs on another already.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend must be {' or '.join(repr(name) for name in BACKENDS)}, not {backend!r}")
    if not is_installed(backend):
        raise ImportError(f"backend={backend!r} needs Taichi, which is not installed: pip install 'warploom[taichi]'")
    if ":" in backend:
        from .taichi.device import start

        start(backend)
    return backend != "warp"
