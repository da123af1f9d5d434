"""How topics go from process to process."""

from __future__ import annotations

import re

from pydantic import BaseModel, ConfigDict, Field, field_validator

__all__ = ["SharedMemoryConfig", "ZenohConfig"]

_ENDPOINT = re.compile(r"[a-z0-9_-]+/[\x21-\x7e]+")


class SharedMemoryConfig(BaseModel):
    """Topics between the processes of a host."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    memory_bytes: int = Field(1 << 32, ge=4096, le=1 << 44)
    """Address space of a topic, a power of two; memory is taken as it is used [B]."""
    queue: int = Field(8, ge=1, le=128)
    """How many payloads a reader may have in its queue, beside those that its window keeps of two epochs."""
    history: int = Field(8, ge=0, le=1024)
    """How many of the newest data a reader is sent that connects later."""
    kept: int = Field(64, ge=0, le=1 << 16)
    """How many data are kept for a reader that was killed, until it is back."""
    kept_bytes: int = Field(1 << 28, ge=0)
    """How much memory they may take together, about [B]."""
    kept_s: float = Field(10.0, ge=0.0, le=86_400.0)
    """For how long [s]."""
    announce: bool = True
    """Whether readers are woken when a change is begun, so as to be ready for its commit."""
    spin_us: float = Field(1000.0, ge=0.0, le=3.6e9)
    """For how long a reader stays awake, at most, for a datum that is announced and due; 0: it sleeps [µs]."""
    spin_share: float = Field(0.1, ge=0.0, le=1.0)
    """Of a core, how much that may take."""
    retry_ms: float = Field(20.0, gt=0.0, le=60_000.0)
    """How long a reader waits before it looks for its producer again [ms]."""

    @field_validator("memory_bytes")
    @classmethod
    def _is_a_power_of_two(cls, size: int) -> int:
        if size & (size - 1):
            raise ValueError(f"expected a power of two, such as {1 << size.bit_length()}")
        return size


class ZenohConfig(BaseModel):
    """Topics between hosts, over zenoh."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    mode: str = Field("peer", pattern="^(peer|client)$")
    """peer: hosts find each other; client: all goes by way of a router."""
    connect: tuple[str, ...] = ()
    """Endpoints to connect to, such as `tcp/192.168.1.7:7447`."""
    listen: tuple[str, ...] = ()
    """Endpoints to listen at, such as `tcp/0.0.0.0:7447`; none: zenoh's own choice."""
    scouting: bool = True
    """Whether hosts look for each other by multicast."""
    domain: str = Field("", pattern=r"^[^*$?#/]*$")
    """Hosts of one domain hear each other; by default the name of the node."""
    queue: int = Field(8, ge=1, le=1024)
    """How many data may wait for the network at the writer, and for processing at a reader; the oldest is dropped,
    counted."""
    history: bool = True
    """Whether a reader that comes later is given the newest datum."""

    @field_validator("connect", "listen")
    @classmethod
    def _are_endpoints(cls, endpoints: tuple[str, ...]) -> tuple[str, ...]:
        for one in endpoints:
            if not _ENDPOINT.fullmatch(one):
                raise ValueError(f"expected an endpoint such as tcp/192.168.1.7:7447, not {one!r}")
        return endpoints
