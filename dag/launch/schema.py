"""The schema of a launch file: the processes of a node, and how each is supervised."""

from __future__ import annotations

import re
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from ...datamesh.transport import SharedMemoryConfig, ZenohConfig

__all__ = ["BackOffSpec", "HardwareSpec", "LaunchSpec", "LimitsSpec", "ProcessSpec", "RestartsSpec"]

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")
_LARGEST_CPU = 1023


def _is_name(name: str) -> str:
    """Names become names of files and sockets."""
    if not _NAME.fullmatch(name):
        raise ValueError(f"a name is 1 to 64 letters, digits, '_', '-' or '.', not {name!r}")
    return name


class _Spec(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _is_not_a_flag(cls, value: Any) -> Any:
        for one in value if isinstance(value, list) else [value]:
            if isinstance(one, bool):  # else it would count as 0 or 1; nothing here is on or off
                raise ValueError(f"expected no {str(one).lower()}")
        return value


class HardwareSpec(_Spec):
    """The hardware that a launch file is for; it is found by these."""

    hw: str | None = None
    """The computing unit, such as hw50."""
    lidar: str | None = None
    """The main LiDAR, such as pandar90."""
    camera: str | None = None
    """The cameras, such as 13."""
    radar: str | None = None
    """The radars, such as conti430."""

    @field_validator("*", mode="before")
    @classmethod
    def _number_is_a_name(cls, value: Any) -> Any:
        return str(value) if isinstance(value, int) and not isinstance(value, bool) else value

    def described(self) -> str:
        """As options of the command line."""
        return " ".join(f"--{name} {value}" for name, value in self.model_dump(exclude_none=True).items())


class BackOffSpec(_Spec):
    """How long a process that died waits for its next start: `first_s`, and each time `factor` times as long."""

    first_s: float = Field(0.5, ge=0.0, le=3600.0)
    factor: float = Field(2.0, ge=1.0, le=100.0)
    max_s: float = Field(30.0, ge=0.0, le=3600.0)


class RestartsSpec(_Spec):
    """How often a process may be started again before the node gives up: `limit` times within `window_s`."""

    window_s: float = Field(60.0, gt=0.0, le=86400.0)
    limit: int = Field(5, ge=0, le=10_000)


_UNITS = {"": 1, "KIB": 1 << 10, "MIB": 1 << 20, "GIB": 1 << 30, "TIB": 1 << 40}


class LimitsSpec(_Spec):
    """What the process's group may use, with all that it starts."""

    memory_max: int | None = Field(None, ge=1 << 20)
    """Beyond it the kernel ends the process: bytes, or a text such as 4GiB [B]."""
    cpu_max: float | None = Field(None, ge=0.01, le=1024.0)
    """Cores: 1.5 is one and a half, on whichever CPUs."""
    cpu_weight: int | None = Field(None, ge=1, le=10_000)
    """Its share where others want the same cores; what is not limited has 100."""

    @field_validator("memory_max", mode="before")
    @classmethod
    def _bytes_of_text(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([KMGT]iB)?\s*", value, re.IGNORECASE)
        if found is None:
            raise ValueError(f"expected bytes, or a text such as 512MiB or 4GiB, not {value!r}")
        return round(float(found[1]) * _UNITS[(found[2] or "").upper()])

    def files(self, period_us: int) -> dict[str, str]:
        """What is written into which files of the group."""
        files = {}
        if self.memory_max is not None:
            files["memory.max"] = str(self.memory_max)
        if self.cpu_max is not None:
            files["cpu.max"] = f"{round(self.cpu_max * period_us)} {period_us}"
        if self.cpu_weight is not None:
            files["cpu.weight"] = str(self.cpu_weight)
        return files


class ProcessSpec(_Spec):
    """One process."""

    name: str
    """Unique in the node."""
    type: Literal["warploom"] = "warploom"
    process_name: str = ""
    """What the system shows as its name, of which it keeps 15 bytes; by default `name`."""
    modules: list[str] = Field(min_length=1)
    """Module files: paths from the launch file's folder, or names."""
    cgroup: str | None = None
    """Its group of cgroup v2, below the supervisor's own or the root, such as app/compute3d_sched."""
    limits: LimitsSpec = LimitsSpec()
    """Of that group; without `cgroup` it has the name of the process."""
    cpus: list[int] = []
    """The CPUs it may run on; none: all."""
    nice: int = Field(0, ge=-20, le=19)
    environment: dict[str, str] = {}
    """Added to the supervisor's."""
    exception_handler: Literal["respawn", "exit", "ignore"] = "respawn"
    """What happens when it ends unasked: it is started again, or the node ends, or the others go on without it."""
    back_off: BackOffSpec = BackOffSpec()
    restarts: RestartsSpec = RestartsSpec()
    health_timeout_s: float | None = Field(5.0, ge=0.2, le=3600.0)
    """Without a sign of life or with a component at one frame for so long it counts as hanging, and is killed; null:
    never [s]."""
    start_timeout_s: float = Field(300.0, gt=0.0, le=86400.0)
    """How long it may take to build its components, kernels compiled [s]."""
    stop_timeout_s: float = Field(10.0, gt=0.0, le=3600.0)
    """How long it may take to stop before it is killed [s]."""

    _check_name = field_validator("name")(_is_name)

    @property
    def group(self) -> str | None:
        """The control group that it is put into; None: it stays in the supervisor's."""
        return self.cgroup or (self.name if self.limits != LimitsSpec() else None)

    @field_validator("process_name")
    @classmethod
    def _is_shown(cls, name: str) -> str:
        if not name.isprintable():
            raise ValueError(f"expected a name that can be shown, not {name!r}")
        return name

    @field_validator("type", mode="before")
    @classmethod
    def _reference_type(cls, value: Any) -> Any:
        return "warploom" if value == "energon" else value

    @field_validator("cgroup")
    @classmethod
    def _stays_below(cls, cgroup: str | None) -> str | None:
        if cgroup is not None and (not cgroup.strip("/") or ".." in cgroup.split("/") or "\0" in cgroup):
            raise ValueError(f"a cgroup is a path below the root such as app/compute3d_sched, not {cgroup!r}")
        return None if cgroup is None else cgroup.strip("/")

    @field_validator("cpus")
    @classmethod
    def _are_cpus(cls, cpus: list[int]) -> list[int]:
        for cpu in cpus:
            if not 0 <= cpu <= _LARGEST_CPU:
                raise ValueError(f"a CPU is a number from 0 to {_LARGEST_CPU}, not {cpu}")
        return cpus

    @field_validator("environment", mode="before")
    @classmethod
    def _texts(cls, environment: Any) -> Any:
        if isinstance(environment, dict):
            for key, value in environment.items():
                if not isinstance(key, str) or not key or "=" in key or "\0" in key:
                    raise ValueError(f"the name of a variable is a text without '=', not {key!r}")
                if isinstance(value, bool) or not isinstance(value, (str, int, float)):
                    raise ValueError(f"{key} must be a text or a number, not {value!r}: put it in quotes")
                if "\0" in str(value):
                    raise ValueError(f"{key} must not have a character 0 in it: {value!r}")
            return {key: str(value) for key, value in environment.items()}
        return environment


class LaunchSpec(_Spec):
    """A launch file."""

    node: str
    """The name of the node; two of different names run side by side."""
    description: str = ""
    hardware: HardwareSpec | None = None
    """What it is found by."""
    profile: str | None = None
    """The hardware profile, by name, or a path from the launch file's folder."""
    settings: dict[str, Any] = {}
    """Changes to the modules by dotted key, as in a profile."""
    shared_memory: SharedMemoryConfig = SharedMemoryConfig()
    """Sizes of the links between the processes."""
    remote: dict[str, Literal["zenoh"]] = {}
    """Topics that go between hosts, and how: those committed here are sent, the others come from there."""
    zenoh: ZenohConfig = ZenohConfig()
    """The links between hosts."""
    processes: list[ProcessSpec] = Field(min_length=1)

    _check_name = field_validator("node")(_is_name)
