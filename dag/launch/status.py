"""What `ps`, `top` and `topics` are answered: plain values, gathered when somebody asks."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterable
from typing import Any

from .schema import LaunchSpec
from .supervised import SupervisedProcess

__all__ = ["node_status", "topic_status"]


def node_status(spec: LaunchSpec, processes: Iterable[SupervisedProcess], reaped: Iterable[str] = ()) -> dict[str, Any]:
    """All processes of a node with their use of the machine, and that of this process, which supervises them."""
    return {
        "node": spec.node,
        "description": spec.description,
        "profile": spec.profile,
        "at": time.time(),
        "supervisor": {"pid": os.getpid(), **_usage(os.getpid())},
        "reaped": list(reaped),
        "processes": [_process(process) for process in processes],
    }


def _process(process: SupervisedProcess) -> dict[str, Any]:
    uptime, silent = process.uptime_s, process.silent_s
    beat = process.beat
    return {
        "name": process.name,
        "process_name": process.spec.process_name or process.name,
        "state": process.state.value,
        "pid": process.pid,
        "uptime_s": None if uptime is None else round(uptime, 3),
        "silent_s": None if silent is None else round(silent, 3),
        "restarts": process.restarts.count,
        "deaths": dict(process.deaths),
        "last_death": process.last_death,
        "exit_code": process.exit_code,
        "handler": process.spec.exception_handler,
        "modules": list(process.spec.modules),
        "warnings": list(process.warnings),
        "log": process.log_path,
        "log_lost": process.log_lost,
        **(_usage(process.pid) if process.pid is not None else {}),
        "components": [
            {
                "name": name,
                "kind": component.get("kind"),
                "idle_because": beat.get("idle", {}).get(name),
                "starting_because": beat.get("starting", {}).get(name),
                "state": beat.get("state", {}).get(name, {}),
                "losses": beat.get("losses", {}).get(name, {}),
            }
            for name, component in process.components.items()
        ],
        "losses": beat.get("losses", {}),
        "links": beat.get("links", {}),
    }


def _usage(pid: int) -> dict[str, Any]:
    """What a process uses of the machine; nothing where it has just ended."""
    import psutil

    with contextlib.suppress(psutil.Error):
        one = psutil.Process(pid)
        with one.oneshot():
            times, memory = one.cpu_times(), one.memory_info()
            return {
                "cpu_s": round(times.user + times.system, 3),
                "rss": memory.rss,
                "threads": one.num_threads(),
                "fds": one.num_fds(),
                "nice": one.nice(),
                "cpus": one.cpu_affinity(),
            }
    return {}


def topic_status(processes: Iterable[SupervisedProcess]) -> dict[str, Any]:
    """All topics of a node: who commits and who reads them, their types, commits and rates, and what links lost."""
    topics: dict[str, dict[str, Any]] = {}
    for process in processes:
        commits, rates = process.beat.get("commits", {}), process.beat.get("rates", {})
        for name, component in process.components.items():
            for topic, kind in component.get("outputs", {}).items():
                entry = topics.setdefault(topic, {"topic": topic, "producer": None, "readers": []})
                entry.update(
                    producer=f"{process.name}/{name}",
                    type=kind,
                    home=component.get("homes", {}).get(topic),
                    commits=commits.get(topic, 0),
                    rate_hz=rates.get(topic, 0.0),
                )
            for topic in component.get("inputs", {}):
                entry = topics.setdefault(topic, {"topic": topic, "producer": None, "readers": []})
                entry["readers"].append(f"{process.name}/{name}")
        for topic, counts in process.beat.get("links", {}).items():
            if topic in topics:
                topics[topic].setdefault("links", {})[process.name] = counts
    return {"topics": [topics[name] for name in sorted(topics)]}
