"""The libraries that can compute a kernel: Warp, and Taichi for the devices that Warp does not know."""

from __future__ import annotations

import importlib.util

__all__ = ["BACKENDS", "uses_taichi"]

BACKENDS = ("warp", "taichi")


def uses_taichi(backend: str) -> bool:
    """Whether `backend` is Taichi; else it is Warp.

    Raises:
        ValueError: It is neither.
        ImportError: It is Taichi, which is not installed.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend must be {' or '.join(repr(name) for name in BACKENDS)}, not {backend!r}")
    if backend == "taichi" and importlib.util.find_spec("taichi") is None:
        raise ImportError("backend='taichi' needs Taichi, which is not installed: pip install 'warploom[taichi]'")
    return backend == "taichi"
