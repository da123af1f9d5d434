"""The GPU monitor: load, memory, temperature and power of every NVIDIA GPU of the machine."""

from __future__ import annotations

import csv
import importlib
import logging
import math
import shutil
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import Field

from ...dag import DataProcessComponent, ProcessorConfig, Trigger
from ...datamesh import CommitPolicy, Output, Status
from ...datamesh.messages import message

__all__ = ["GpuMonitor", "GpuMonitorConfig", "GpuReading", "GpuReport", "find_reader", "parse_nvidia_smi", "read_nvml"]

_log = logging.getLogger(__name__)

_FIELDS = ("index", "name", "utilization.gpu", "memory.used", "memory.total", "temperature.gpu", "power.draw")
_COMMAND = ("nvidia-smi", f"--query-gpu={','.join(_FIELDS)}", "--format=csv,noheader,nounits")
_TIMEOUT = 5.0  # [s]


@message("warploom.GpuReading")
@dataclass(frozen=True, kw_only=True)
class GpuReading:
    """One GPU at one time. What the driver does not tell is NaN."""

    index: int
    name: str
    load_percent: float
    """Share of the time in which a kernel ran [%]."""
    memory_used_mib: float
    memory_total_mib: float
    temperature_c: float
    power_w: float


@message("warploom.GpuReport")
@dataclass(frozen=True, kw_only=True)
class GpuReport:
    """All GPUs at one time."""

    gpus: tuple[GpuReading, ...]


Reader = Callable[[], list[GpuReading]]


def parse_nvidia_smi(text: str) -> list[GpuReading]:
    """What `nvidia-smi --query-gpu=… --format=csv,noheader,nounits` says, with the fields of this module.

    Raises:
        ValueError: A line has other fields.
    """
    readings = []
    for row in csv.reader(text.splitlines(), skipinitialspace=True):
        if not row:
            continue
        if len(row) != len(_FIELDS):
            raise ValueError(f"nvidia-smi gave {len(row)} fields, not {len(_FIELDS)}: {','.join(row)!r}")
        load, used, total, temperature, power = (_number(field) for field in row[2:])
        readings.append(
            GpuReading(
                index=int(row[0]),
                name=row[1],
                load_percent=load,
                memory_used_mib=used,
                memory_total_mib=total,
                temperature_c=temperature,
                power_w=power,
            )
        )
    return readings


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:  # [N/A], [Not Supported] …
        return math.nan


def _read_nvidia_smi() -> list[GpuReading]:
    done = subprocess.run(_COMMAND, capture_output=True, text=True, timeout=_TIMEOUT, check=False)
    if done.returncode:
        said = (done.stdout + done.stderr).strip().splitlines()
        raise OSError(said[0] if said else f"nvidia-smi ended with code {done.returncode}")
    return parse_nvidia_smi(done.stdout)


def read_nvml(nvml: Any) -> list[GpuReading]:
    """What NVML says.

    Args:
        nvml: The module `pynvml` of nvidia-ml-py, initialised.
    """

    def ask(call: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return call(*arguments)
        except nvml.NVMLError:  # this GPU does not tell
            return None

    readings = []
    for index in range(nvml.nvmlDeviceGetCount()):
        gpu = nvml.nvmlDeviceGetHandleByIndex(index)
        name = ask(nvml.nvmlDeviceGetName, gpu) or "unknown"
        load = ask(nvml.nvmlDeviceGetUtilizationRates, gpu)
        memory = ask(nvml.nvmlDeviceGetMemoryInfo, gpu)
        temperature = ask(nvml.nvmlDeviceGetTemperature, gpu, nvml.NVML_TEMPERATURE_GPU)
        power = ask(nvml.nvmlDeviceGetPowerUsage, gpu)
        readings.append(
            GpuReading(
                index=index,
                name=name.decode() if isinstance(name, bytes) else name,
                load_percent=math.nan if load is None else float(load.gpu),
                memory_used_mib=math.nan if memory is None else memory.used / 2**20,
                memory_total_mib=math.nan if memory is None else memory.total / 2**20,
                temperature_c=math.nan if temperature is None else float(temperature),
                power_w=math.nan if power is None else power / 1000.0,
            )
        )
    return readings


def find_reader() -> tuple[Reader | None, str]:
    """What reads the GPUs of this machine: NVML where nvidia-ml-py is installed, else the program nvidia-smi.

    Returns:
        The reader and its name; or None and why there is none.
    """
    try:
        nvml = importlib.import_module("pynvml")
        nvml.nvmlInit()
        if nvml.nvmlDeviceGetCount():
            return lambda: read_nvml(nvml), "nvml"
    except Exception as error:  # not installed, or no driver: NVML has exceptions of its own
        _log.debug("no NVML: %s", error)
    if shutil.which(_COMMAND[0]) is None:
        return None, "there is no NVIDIA GPU here: neither NVML nor nvidia-smi is there"
    try:
        if _read_nvidia_smi():
            return _read_nvidia_smi, "nvidia-smi"
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        return None, f"nvidia-smi does not tell: {error}"
    return None, "the driver knows no GPU"


class GpuMonitorConfig(ProcessorConfig):
    """What is worth a warning."""

    warn_celsius: float = Field(90.0, gt=0.0)
    """A GPU at least as hot is logged."""
    warn_memory: float = Field(0.95, gt=0.0, le=1.0)
    """A GPU with at least so much of its memory in use is logged, as a share of all."""


class GpuMonitor(DataProcessComponent):
    """Commits a reading of all GPUs in each period; where there is none it looks again once a minute."""

    Config = GpuMonitorConfig

    gpus: Output[GpuReport]

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._config = GpuMonitorConfig()
        self._reader: Reader | None = None
        self._said = "it has not looked yet"
        self._look_again_ns = 0
        self._latest = GpuReport(gpus=())

    def init(self, config: GpuMonitorConfig) -> None:
        """Keeps what is worth a warning."""
        self._config = config

    def process(self, trigger: Trigger) -> Status:
        """Reads them."""
        now = self.clock.monotonic_ns()
        if self._reader is None:
            if now < self._look_again_ns:
                return Status.MISS
            self._reader, self._said = find_reader()
            self._look_again_ns = now + 60_000_000_000
            if self._reader is None:
                return Status.MISS
        try:
            self._latest = GpuReport(gpus=tuple(self._reader()))
        except Exception as error:
            _log.error("%s: %s cannot be read: %s", self.name, self._said, error)
            self.losses.count(self.name, "not_read", trigger.version)
            self._reader, self._said = None, f"{self._said} cannot be read: {error}"
            return Status.MISS
        self._warn()
        with self.gpus.allocate_change() as change:
            change.set_version(trigger.version)
            change.value = self._latest
            return self.gpus.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)

    def _warn(self) -> None:
        for gpu in self._latest.gpus:
            if gpu.temperature_c >= self._config.warn_celsius:
                _log.warning("GPU %d (%s) has %.0f °C", gpu.index, gpu.name, gpu.temperature_c)
            if gpu.memory_used_mib >= self._config.warn_memory * gpu.memory_total_mib:
                _log.warning("GPU %d: %.0f of %.0f MiB in use", gpu.index, gpu.memory_used_mib, gpu.memory_total_mib)

    @property
    def idle_because(self) -> str | None:
        """There is no GPU, or it cannot be read."""
        return self._said if self._reader is None else None

    def state(self) -> Mapping[str, str | float | int]:
        """The latest reading."""
        state: dict[str, str | float | int] = {"gpus": len(self._latest.gpus)}
        for gpu in self._latest.gpus:
            state[f"gpu {gpu.index}"] = (
                f"{gpu.load_percent:.0f} %, {gpu.memory_used_mib:.0f} of {gpu.memory_total_mib:.0f} MiB, "
                f"{gpu.temperature_c:.0f} °C, {gpu.power_w:.0f} W"
            )
        return state
