"""Hardware profiles: devices, precision, threads, sensors, capacities, models, and the modules that run on them."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from ..dag import ConfigFile, find_config, nearest
from ..errors import DeviceError
from ..kernels.backend import BACKENDS, is_installed
from .execution import ExecutionContext

__all__ = [
    "BACKEND_KERNELS",
    "CONF",
    "LidarSpec",
    "ModelsSpec",
    "MountingSpec",
    "Profile",
    "SensorSpec",
    "ThreadsSpec",
    "execution_context",
    "load_profile",
    "may_have_gpu",
    "profile_device",
    "use_threads",
]

CONF = Path(__file__).resolve().parent.parent / "conf"
"""The configuration that ships with the package."""

BACKEND_KERNELS = ("ground", "cluster")
"""The stages whose kernels exist in more than one library."""

AUTO = "auto"
"""In place of a device: the first CUDA device, or the CPU where there is none."""

SensorKind = Literal["lidar", "camera", "radar", "gnss", "imu", "wheel"]


class _Spec(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ThreadsSpec(_Spec):
    """How many threads each consumer of the CPU has."""

    inference: int = Field(2, ge=1, le=64)
    """Of a detection head on a CPU."""
    kernels: int | None = Field(None, ge=1, le=64)
    """Of a kernel on a CPU; left out: $WARPLOOM_THREADS, or the cores of the process, at most 8."""
    switch_ms: float | None = Field(0.1, gt=0.0, le=1000.0)
    """How long a thread that computes in Python keeps the others waiting while components run [ms]; null: as it is."""

    @property
    def switch_interval_s(self) -> float | None:
        """The same [s], as `Process` takes it."""
        return None if self.switch_ms is None else self.switch_ms / 1000.0


class LidarSpec(_Spec):
    """The main LiDAR."""

    mounting_height: float | None = Field(None, gt=0.0, lt=20.0)
    """Height above the ground [m]; left out, that of the first LiDAR's mounting, or else estimated in each frame."""


_Metres = Annotated[float, Field(ge=-1000.0, le=1000.0)]


class MountingSpec(_Spec):
    """Where a sensor is on the vehicle: x forward, y left, z up, the origin on the ground under the rear axle."""

    xyz: tuple[_Metres, _Metres, _Metres] = (0.0, 0.0, 0.0)
    """Of its centre [m]."""
    rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw: about x, then y, then z of the vehicle [deg]."""


class SensorSpec(_Spec):
    """One sensor. A name alone stands for a sensor of which nothing more is known."""

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,63}$")
    """What topics and placeholders call it; unique among all sensors."""
    model: str | None = None
    """Its type, such as pandar90."""
    mounting: MountingSpec | None = None
    """Vehicle from sensor; left out, it is not known."""
    rate_hz: float | None = Field(None, gt=0.0, le=10_000.0)
    """Data a second."""
    calibration: str | None = None
    """Its calibration file, a path relative to the profile."""
    source: str | None = None
    """Who plays it, as a URI that `--source` takes; left out, the module file says."""

    @model_validator(mode="before")
    @classmethod
    def _name_alone(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value


class ModelsSpec(_Spec):
    """The models, by their cards."""

    detector: str | None = None
    """Card of the detection head, a path relative to the profile; left out, the shipped one."""


class Profile(_Spec):
    """What the hardware is, and what runs on it."""

    profile: str
    """Its name."""
    description: str = ""
    device: str = "cpu"
    """The Warp device of the kernels: cpu, cuda:0 …, or auto: the first CUDA device, or the CPU where there is none."""
    memory_gib: float | None = Field(None, gt=0.0)
    """What the machine must have at least [GiB]: of the GPU where the device is one, else of the host."""
    precision: Literal["fp32", "tf32", "fp16"] = "fp32"
    """What a detection head computes in on a GPU; a CPU always computes in fp32."""
    backends: dict[str, str] = {}
    """Which library computes a kernel, by `BACKEND_KERNELS`: warp, taichi, taichi:vulkan …; left out: warp."""
    capacity: int = Field(200_000, ge=1, le=16_000_000)
    """Points of a cloud that there is room for; further ones are dropped, and counted."""
    latency_budget_ms: float = Field(100.0, gt=0.0, le=86_400_000.0)
    """From the reception of a LiDAR frame to the commit of its obstacles [ms]."""
    threads: ThreadsSpec = ThreadsSpec()
    lidar: LidarSpec = LidarSpec()
    sensors: dict[SensorKind, list[SensorSpec]] = {}
    """The sensors by kind; the placeholders of module files stand for their names."""
    models: ModelsSpec = ModelsSpec()
    modules: list[str] = Field(min_length=1)
    """Module files, by name or path."""
    settings: dict[str, Any] = {}
    """Changes to the modules, by dotted key: `component.vertex.key`."""
    check: bool = False
    """Whether payloads are compared with what they were at their commit; reads every byte, for tests."""

    @field_validator("backends")
    @classmethod
    def _kernels_and_backends_known(cls, backends: dict[str, str]) -> dict[str, str]:
        for kernel, backend in backends.items():
            if kernel not in BACKEND_KERNELS:
                raise ValueError(f"no kernel {kernel!r} has a choice of backends; {nearest(kernel, BACKEND_KERNELS)}")
            if backend not in BACKENDS:
                raise ValueError(f"{kernel}: no backend {backend!r}; {nearest(backend, BACKENDS)}")
            if not is_installed(backend):
                raise ValueError(
                    f"{kernel}: backend {backend!r} needs Taichi, which is not there: pip install 'warploom[taichi]'"
                )
        return backends

    @field_validator("sensors")
    @classmethod
    def _names_unique(cls, sensors: dict[str, list[SensorSpec]]) -> dict[str, list[SensorSpec]]:
        counts = Counter(sensor.name for specs in sensors.values() for sensor in specs)
        twice = [name for name, count in counts.items() if count > 1]
        if twice:
            raise ValueError(f"two sensors are called {twice[0]!r}: topics tell sensors apart by their names")
        return sensors

    @model_validator(mode="after")
    def _precision_fits_the_device(self) -> Profile:
        if self.device == "cpu" and self.precision != "fp32":
            raise ValueError(f"precision {self.precision} is of a GPU; with device cpu leave it out, or write fp32")
        return self

    @property
    def sensor_names(self) -> dict[str, list[str]]:
        """Names of the sensors by kind."""
        return {kind: [sensor.name for sensor in specs] for kind, specs in self.sensors.items()}

    @property
    def mounting_height(self) -> float | None:
        """Of the main LiDAR above the ground [m]; None: nobody says."""
        if self.lidar.mounting_height is not None:
            return self.lidar.mounting_height
        mounting = next((sensor.mounting for sensor in self.sensors.get("lidar", ())), None)
        return mounting.xyz[2] if mounting is not None and mounting.xyz[2] > 0 else None


def load_profile(name: str, changes: Mapping[tuple[str, ...], Any] | None = None) -> ConfigFile[Profile]:
    """Reads a profile.

    Args:
        name: Of a shipped profile, or the path of a file.
        changes: Values that replace those of the file, by the path of their keys.

    Raises:
        ConfigError: There is none of that name, or it is bad.
    """
    return ConfigFile(find_config(name, "profiles", CONF), Profile, dict(changes or {}))


def profile_device(profile: Profile, device: str | None = None) -> str:
    """The Warp device on which a profile computes here.

    Args:
        profile: The profile.
        device: In place of the profile's.

    Raises:
        DeviceError: There is no such device; the message says which profile asks for it, and the way out.
    """
    wanted = device or profile.device
    # Warp takes seconds to load: where only the CPU can be meant it is not asked.
    if wanted == "cpu" or (wanted == AUTO and not may_have_gpu()):
        return "cpu"
    from ..kernels.device import device_names, resolve_device

    if wanted == AUTO:
        return next((name for name in device_names() if name.startswith("cuda")), "cpu")
    try:
        return resolve_device(wanted)
    except DeviceError as error:
        if device is not None:
            raise
        raise DeviceError(f"profile {profile.profile!r}: {error}") from error


def may_have_gpu() -> bool:
    """Whether there may be an NVIDIA GPU here; only Linux says that there is none."""
    if sys.platform != "linux":
        return True
    patterns = ("nvidia[0-9]*", "nvhost-gpu", "nvgpu", "dxg")  # a driver's devices; Jetson's; Windows' below Linux
    return any(next(Path("/dev").glob(pattern), None) is not None for pattern in patterns)


def use_threads(profile: Profile) -> None:
    """Sets how many threads the kernels of this process use on a CPU; before any plan is made, which takes the number.

    A profile that does not say leaves it as it is.
    """
    if profile.threads.kernels is not None:
        from ..kernels.threads import set_thread_count

        set_thread_count(profile.threads.kernels)


def execution_context(file: ConfigFile[Profile], device: str) -> ExecutionContext:
    """The context in which the modules of a profile run, on a device that was found to exist."""
    profile = file.content
    detector = profile.models.detector
    return ExecutionContext(
        device=device,
        capacity=profile.capacity,
        mounting_height=profile.mounting_height,
        inference_threads=profile.threads.inference,
        precision=profile.precision if device != "cpu" else "fp32",
        detector=(file.path.parent / detector) if detector is not None else None,
        backends=MappingProxyType(dict(profile.backends)),
        sensors=MappingProxyType({one.name: one for specs in profile.sensors.values() for one in specs}),
        sensor_kinds=MappingProxyType({kind: tuple(names) for kind, names in profile.sensor_names.items()}),
        latency_budget_ms=profile.latency_budget_ms,
    )
