"""The memory fragmentation monitor: from the kernel's lists of free blocks, `/proc/buddyinfo`.

The kernel gives memory in blocks of 2^order pages. Memory that is free in small blocks alone is of no use to who needs
a large one in one piece, as drivers of cameras, network cards and GPUs do: their allocations then fail or stall
although much is free. The index here is the share of the free memory that lies in blocks smaller than asked for (the
"unusable free space index" of Gorman and Whitcroft, "Supporting superpage allocation without additional hardware
support", ISMM 2008): 0 where all of it can be used, 1 where none.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field

from ...dag import DataProcessComponent, ProcessorConfig, Trigger
from ...datamesh import CommitPolicy, Output, Status
from ...datamesh.messages import message

__all__ = [
    "FragmentationMonitor",
    "FragmentationMonitorConfig",
    "FragmentationReport",
    "ZoneFragmentation",
    "parse_buddyinfo",
    "unusable_share",
]

_log = logging.getLogger(__name__)

_LINE = re.compile(r"Node\s+(\d+),\s*zone\s+(\S+)((?:\s+\d+)+)\s*$")
_PAGE = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 4096


@message("warploom.ZoneFragmentation")
@dataclass(frozen=True, kw_only=True)
class ZoneFragmentation:
    """One zone of one NUMA node."""

    node: int
    zone: str
    free_blocks: tuple[int, ...]
    """How many there are, by order: of 1, 2, 4 … pages."""
    free_mib: float
    largest_mib: float
    """The largest block that is free [MiB]."""
    unusable: float
    """Share of the free memory that lies in blocks smaller than the order that is watched, 0 to 1."""


@message("warploom.FragmentationReport")
@dataclass(frozen=True, kw_only=True)
class FragmentationReport:
    """All zones at one time."""

    order: int
    """The order that is watched."""
    zones: tuple[ZoneFragmentation, ...]


def unusable_share(free_blocks: Sequence[int], order: int) -> float:
    """Share of the free memory in blocks too small for an allocation of 2^order pages; 1 where nothing is free."""
    free = sum(count << k for k, count in enumerate(free_blocks))
    usable = sum(count << k for k, count in enumerate(free_blocks) if k >= order)
    return 1.0 - usable / free if free else 1.0


def parse_buddyinfo(text: str, order: int, page_bytes: int = _PAGE) -> list[ZoneFragmentation]:
    """The zones in a text of `/proc/buddyinfo`.

    Args:
        text: Lines such as `Node 0, zone   Normal   4381 1093 …`.
        order: Which blocks are watched: those of 2^order pages and more are usable.
        page_bytes: Size of a page.

    Raises:
        ValueError: A line is of another form.
    """
    zones = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        match = _LINE.match(line.strip())
        if match is None:
            raise ValueError(f"line {number} is not of the form 'Node 0, zone Normal 1 2 3': {line!r}")
        blocks = tuple(int(count) for count in match[3].split())
        largest = max((k for k, count in enumerate(blocks) if count), default=-1)
        zones.append(
            ZoneFragmentation(
                node=int(match[1]),
                zone=match[2],
                free_blocks=blocks,
                free_mib=sum(count << k for k, count in enumerate(blocks)) * page_bytes / 2**20,
                largest_mib=(1 << largest) * page_bytes / 2**20 if largest >= 0 else 0.0,
                unusable=unusable_share(blocks, order),
            )
        )
    return zones


class FragmentationMonitorConfig(ProcessorConfig):
    """What is watched."""

    order: int = Field(9, ge=0, le=20)
    """Blocks of 2^order pages and more are usable: 9 is 2 MiB with pages of 4 KiB, a huge page."""
    warn_above: float = Field(0.95, ge=0.0, le=1.0)
    """A zone whose unusable share is above is logged, when it comes to that."""
    min_free_mib: float = Field(64.0, ge=0.0)
    """Zones with less that is free are not: the small ones of old hardware are always fragmented [MiB]."""
    path: Path = Path("/proc/buddyinfo")


class FragmentationMonitor(DataProcessComponent):
    """Commits a report in each period, and warns when a zone becomes fragmented."""

    Config = FragmentationMonitorConfig

    fragmentation: Output[FragmentationReport]

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._config = FragmentationMonitorConfig()
        self._failure: str | None = None
        self._warned: set[tuple[int, str]] = set()
        self._latest: FragmentationReport | None = None

    def init(self, config: FragmentationMonitorConfig) -> None:
        """Keeps what is watched."""
        self._config = config

    def process(self, trigger: Trigger) -> Status:
        """Reads and commits."""
        config = self._config
        try:
            zones = parse_buddyinfo(config.path.read_text(encoding="ascii"), config.order)
        except (OSError, ValueError) as error:
            self._failure = f"{config.path} cannot be read: {getattr(error, 'strerror', None) or error}"
            return Status.MISS
        if not zones:
            self._failure = f"{config.path} lists no zone: this kernel does not tell"
            return Status.MISS
        self._failure = None
        self._latest = FragmentationReport(order=config.order, zones=tuple(zones))
        self._warn(zones)
        with self.fragmentation.allocate_change() as change:
            change.set_version(trigger.version)
            change.value = self._latest
            return self.fragmentation.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)

    def _warn(self, zones: Sequence[ZoneFragmentation]) -> None:
        for zone in zones:
            key = (zone.node, zone.zone)
            if zone.unusable <= self._config.warn_above or zone.free_mib < self._config.min_free_mib:
                self._warned.discard(key)
            elif key not in self._warned:
                self._warned.add(key)
                _log.warning(
                    "memory of node %d, zone %s is fragmented: %.0f of %.0f MiB free are in blocks below 2^%d pages, "
                    "the largest has %.1f MiB",
                    zone.node, zone.zone, zone.unusable * zone.free_mib, zone.free_mib, self._config.order,
                    zone.largest_mib,
                )  # fmt: skip

    @property
    def idle_because(self) -> str | None:
        """The kernel does not tell."""
        return self._failure

    def state(self) -> Mapping[str, str | float | int]:
        """The worst zone of those that are watched."""
        watched = [z for z in self._latest.zones if z.free_mib >= self._config.min_free_mib] if self._latest else []
        if not watched:
            return {}
        worst = max(watched, key=lambda zone: zone.unusable)
        return {
            "zones": len(watched),
            "worst": f"node {worst.node} {worst.zone}",
            "unusable": round(worst.unusable, 4),
            "largest_mib": worst.largest_mib,
            "free_mib": round(sum(zone.free_mib for zone in watched), 1),
        }
