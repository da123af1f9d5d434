"""Which library computes a stage: Warp, or Taichi where Warp has no device."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator

from ...errors import DeviceError
from ...kernels.backend import BACKENDS, is_installed, uses_taichi

__all__ = ["Backend", "check_backend"]


def _is_known(backend: str) -> str:
    if backend not in BACKENDS:
        raise ValueError(f"must be {' or '.join(BACKENDS)}, not {backend!r}")
    if not is_installed(backend):
        raise ValueError(f"{backend!r} needs Taichi, which is not installed: pip install 'warploom[taichi]'")
    return backend


Backend = Annotated[str, AfterValidator(_is_known)]
"""One of `kernels.backend.BACKENDS`, installed."""


def check_backend(backend: str, stage: str) -> None:
    """Looks whether a library computes here; Taichi is started for that.

    Args:
        backend: One of `kernels.backend.BACKENDS`.
        stage: What it is to compute, such as ground.

    Raises:
        DeviceError: It does not; the message names what it needs and what to take instead.
    """
    try:
        uses_taichi(backend)
    except DeviceError as error:
        others = "cpu or gpu" if backend in ("taichi", "taichi:cpu") else "taichi-cpu, cpu or gpu"
        raise DeviceError(
            f"{stage} by {backend}: {error}. Way out: the backend warp for it, or another profile: {others}; "
            "`warploom profile` proposes one"
        ) from error
