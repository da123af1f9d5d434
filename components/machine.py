"""The machine and the versions, for reports and `warploom info`."""

from __future__ import annotations

import contextlib
import importlib.metadata
import importlib.util
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

__all__ = ["describe_machine", "inference_providers", "machine_lines", "memory_limit_bytes", "taichi_devices"]

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
        "gpus": _gpus(),
        "inference_providers": inference_providers(),
        "versions": versions,
    }


def machine_lines(machine: dict[str, Any]) -> list[str]:
    """The same as lines to read."""
    lines = [f"{key:<12} {machine[key]}" for key in ("system", "python", "processor", "cores", "memory_gib")]
    for key in ("devices", "gpus", "inference_providers"):
        lines.append(f"{key.partition('_')[0]:<12} {', '.join(machine[key]) or 'none'}")
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
    limit = memory_limit_bytes()
    return None if limit is None else round(limit / 2**30, 1)


def memory_limit_bytes() -> int | None:
    """How much memory this process may have: the machine's, or less where its control group says so; None: unknown."""
    limits = []
    with contextlib.suppress(ValueError, OSError, AttributeError):
        limits.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    limits += [limit for path in _limit_files() if (limit := _number_in(path)) is not None]
    return min(limits, default=None)


def _limit_files() -> list[Path]:
    """Where the control group of this process and those above it say how much memory they may have."""
    root = Path("/sys/fs/cgroup")
    files = [root / "memory" / "memory.limit_in_bytes", root / "memory.max"]
    try:
        lines = Path("/proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:
        return files
    for line in lines:
        number, controllers, group = line.split(":", 2)
        top, name = (root, "memory.max") if number == "0" else (root / "memory", "memory.limit_in_bytes")
        if number == "0" or "memory" in controllers.split(","):
            place = top / group.lstrip("/")
            files += [folder / name for folder in (place, *place.parents) if folder.is_relative_to(top)]
    return files


def _number_in(path: Path) -> int | None:
    try:
        return int(path.read_text(encoding="ascii"))
    except (OSError, ValueError):  # not there, or "max"
        return None


def _gpus() -> list[str]:
    """Names of the NVIDIA GPUs with their memory, as their driver tells."""
    from .monitors.gpu import find_reader

    reader, _ = find_reader()
    try:
        return [f"{gpu.name} ({gpu.memory_total_mib / 1024:.0f} GiB)" for gpu in reader()] if reader else []
    except Exception:  # a driver that is just being changed
        return []


def inference_providers() -> list[str]:
    """What ONNX Runtime can run networks on here, without the endings of the names."""
    import onnxruntime

    return [name.removesuffix("ExecutionProvider") for name in onnxruntime.get_available_providers()]


def taichi_devices() -> list[str]:
    """What Taichi says that it can compute on here; none where it is not installed."""
    if importlib.util.find_spec("taichi") is None:
        return []
    # In a process of its own: Taichi greets on its first import, and computes on one device in a process.
    code = (
        "import contextlib, os, sys\n"
        "with contextlib.redirect_stdout(open(os.devnull, 'w')):\n"
        "    import taichi as ti\n"
        "    from taichi._lib import core\n"
        "    names = [n for n, there in (('cpu', True), ('cuda', core.with_cuda()), ('vulkan', core.with_vulkan()),\n"
        "                                ('metal', core.with_metal())) if there]\n"
        "sys.stderr.write('ARCHS ' + ' '.join(names))\n"
    )
    try:
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    except (OSError, subprocess.SubprocessError):
        return []
    said = done.stderr.rpartition("ARCHS ")[2] if "ARCHS " in done.stderr else ""
    return said.split()
