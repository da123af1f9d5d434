"""The machine and the versions, for reports and `warploom info`."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

__all__ = ["describe_machine", "machine_lines"]

_PACKAGES = ("warp-lang", "numpy", "onnxruntime", "opencv-python-headless", "torch", "taichi")


def describe_machine() -> dict[str, Any]:
    """Processor, cores, memory, devices and versions, as plain values."""
    from ..kernels.device import device_names

    versions = {}
    for package in ("warploom", *_PACKAGES):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_gib": _memory_gib(),
        "devices": device_names(),
        "versions": versions,
    }


def machine_lines(machine: dict[str, Any]) -> list[str]:
    """The same as lines to read."""
    lines = [f"{key:<12} {machine[key]}" for key in ("system", "python", "processor", "cores", "memory_gib")]
    lines.append(f"{'devices':<12} {', '.join(machine['devices'])}")
    lines += [f"{name:<24} {version}" for name, version in machine["versions"].items()]
    return lines


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"


def _memory_gib() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (ValueError, OSError, AttributeError):
        return None
