"""Which library computes a stage: Warp, or Taichi where Warp has no device."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator

from ...kernels.backend import BACKENDS, is_installed

__all__ = ["Backend"]


def _is_known(backend: str) -> str:
    if backend not in BACKENDS:
        raise ValueError(f"must be {' or '.join(BACKENDS)}, not {backend!r}")
    if not is_installed(backend):
        raise ValueError(f"{backend!r} needs Taichi, which is not installed: pip install 'warploom[taichi]'")
    return backend


Backend = Annotated[str, AfterValidator(_is_known)]
"""One of `kernels.backend.BACKENDS`, installed."""
