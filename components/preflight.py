"""Preflight: is what a launch asks for there? Device, memory, models, ports and sensors, each with the way out.

Importing this registers the checks with the launcher.
"""

from __future__ import annotations

import errno
import importlib.util
import math
import os
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from ..dag import ComponentSpec, ConfigFile, nearest
from ..dag.launch.cgroup import ControlGroups
from ..dag.launch.plan import LaunchPlan
from ..dag.launch.preflight import Finding, register_check
from ..errors import ConfigError, DeviceError, ModelError, SourceError
from .machine import memory_limit_bytes
from .profile import Profile, profile_device

__all__ = [
    "check_backends",
    "check_device",
    "check_groups",
    "check_memory",
    "check_models",
    "check_ports",
    "check_recordings",
    "check_remote",
    "check_sensors",
    "check_settings",
]

_GIB = 2**30
_ROOM_BYTES = 64 << 20
"""Of a disk that a recording may be begun on [B]."""


def _profile_of(plan: LaunchPlan) -> ConfigFile[Profile] | None:
    file = plan.profile
    return file if file is not None and isinstance(file.content, Profile) else None


def _device(profile: Profile) -> str | None:
    """The device of a profile; None where it is not there, which `check_device` says."""
    try:
        return profile_device(profile)
    except DeviceError:
        return None


def check_device(plan: LaunchPlan) -> Iterator[Finding]:
    """Is the compute device there?"""
    file = _profile_of(plan)
    if file is None:
        return
    profile = file.content
    try:
        device = profile_device(profile)
    except DeviceError as error:
        yield Finding(
            "device", False, str(error),
            "look with `warploom info` which devices there are; take a profile for one of them "
            "(--profile cpu), or --set profile.device=cpu",
        )  # fmt: skip
        return
    said = f"{device} for profile {profile.profile!r}"
    if profile.device == "auto" and device == "cpu":
        said += ": no CUDA device is here, so the kernels run on the CPU"
    yield Finding("device", True, said)
    if device != "cpu":
        yield _inference_provider(device, profile)


def _inference_provider(device: str, profile: Profile) -> Finding:
    """A head on a GPU wants ONNX Runtime's provider; without it the network runs on the CPU, which is no failure."""
    import onnxruntime

    providers = onnxruntime.get_available_providers()
    if "CUDAExecutionProvider" not in providers:
        return Finding(
            "device", True,
            f"ONNX Runtime has no CUDA provider: networks run on the CPU beside {device}; pip install onnxruntime-gpu",
        )  # fmt: skip
    if profile.precision == "fp16" and "TensorrtExecutionProvider" not in providers:
        return Finding("device", True, "ONNX Runtime has no TensorRT provider, so networks compute in tf32, not fp16")
    return Finding("device", True, f"networks run on {device} in {profile.precision}")


def check_backends(plan: LaunchPlan) -> Iterator[Finding]:
    """Do the libraries compute that the profile names for some kernels?"""
    file = _profile_of(plan)
    if file is None:
        return
    from ..kernels.backend import uses_taichi

    for kernel, backend in file.content.backends.items():
        if backend == "warp":
            continue
        try:
            uses_taichi(backend)
        except (DeviceError, ImportError, ValueError) as error:
            yield Finding(
                "backend", False, f"{kernel}: {error}",
                f"--set profile.backends.{kernel}=warp, or another profile (--profile taichi-cpu, --profile cpu)",
            )  # fmt: skip
        else:
            yield Finding("backend", True, f"{kernel} by {backend}")


def check_memory(plan: LaunchPlan) -> Iterator[Finding]:
    """Is there as much memory as the profile asks for, on the GPU or else on the host, within this process's limits?"""
    file = _profile_of(plan)
    if file is None or file.content.memory_gib is None:
        return
    profile = file.content
    wanted = profile.memory_gib or 0.0
    device = _device(profile)
    if device is None:
        return
    if device == "cpu":
        found, where = memory_limit_bytes(), "this machine, or the limit of its control group, has"
    else:
        import warp as wp

        found, where = wp.get_device(device).total_memory, f"{device} has"
    if found is None:
        yield Finding("memory", True, "this system does not tell how much memory there is")
        return
    # Machines are sold by what they hold; a few per cent of it belong to firmware and driver.
    enough = found >= 0.9 * wanted * _GIB
    yield Finding(
        "memory", enough, f"{where} {found / _GIB:.1f} GiB; profile {profile.profile!r} asks for {wanted:g}",
        "" if enough else "take a smaller profile (--profile cpu-min), or less capacity with --set "
        f"profile.memory_gib={math.floor(10 * found / _GIB) / 10:g} --set profile.capacity=…",
    )  # fmt: skip


def check_models(plan: LaunchPlan) -> Iterator[Finding]:
    """Are the models there, and are they those that their cards mean (sha256)?"""
    file = _profile_of(plan)
    if file is None:
        return
    from ..models.card import default_card
    from ..models.heads import read_card

    named = file.content.models.detector
    card = default_card(file.content.device) if named is None else file.path.parent / named
    try:
        loaded, model = read_card(card)
    except ModelError as error:
        way_out = (
            "reinstall warploom: its own model is damaged" if named is None
            else "fetch model and card again, or leave models.detector out of the profile for the one that ships"
        )  # fmt: skip
        yield Finding("models", False, str(error), way_out)
        return
    yield Finding("models", True, f"{loaded.name}: {model.name} has the sha256 of its card")


def check_ports(plan: LaunchPlan) -> Iterator[Finding]:
    """Can the ports be had that components are to answer on?"""
    asked: dict[int, str] = {}
    for process, component in _components(plan):
        port = component.config.get("port")
        if not isinstance(port, int) or isinstance(port, bool) or port == 0:
            continue
        who = f"{process}/{component.name}"
        way_out = f"--set {component.name}.port=N takes another, 0 any that is free, null none"
        if port in asked:
            yield Finding("ports", False, f"{who}: {asked[port]} is to answer on port {port} already", way_out)
            continue
        asked[port] = who
        why = _cannot_listen(port)
        yield Finding("ports", why is None, f"{who}: port {port} {why or 'is free'}", way_out if why else "")


def _cannot_listen(port: int, host: str = "127.0.0.1") -> str | None:
    if not 0 <= port <= 65535:
        return "is no port: they go to 65535"
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            if os.name == "posix":
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
            probe.listen()  # of two that are bound so, only one can
    except PermissionError:
        return f"is not permitted to this user (below {_first_free_port()} it needs CAP_NET_BIND_SERVICE)"
    except OSError as error:
        taken = error.errno == errno.EADDRINUSE
        return f"{'is taken' if taken else 'cannot be listened at'}: {error.strerror or error}"
    return None


def _first_free_port() -> int:
    """The first port that needs no permission."""
    try:
        return int(Path("/proc/sys/net/ipv4/ip_unprivileged_port_start").read_text())
    except (OSError, ValueError):
        return 1024


def check_sensors(plan: LaunchPlan) -> Iterator[Finding]:
    """Can what plays each sensor be opened, and are the calibration files there?"""
    file = _profile_of(plan)
    sensors = {} if file is None else {one.name: one for specs in file.content.sensors.values() for one in specs}
    for name, sensor in sensors.items():
        if sensor.calibration is not None and file is not None:
            path = file.path.parent / sensor.calibration
            if not path.is_file():
                yield Finding(
                    "sensors", False, f"{name}: its calibration {path} is not there",
                    f"put the file there, or take calibration out of {file.path} for what the sensor's type gives",
                )  # fmt: skip
    for process, component in _components(plan):
        if "sensor" not in component.config:
            continue
        from .node.lidar import LidarDriver

        driver = _class_of(component, LidarDriver)
        if driver is None:
            continue
        who = f"{process}/{component.name}"
        name = component.config["sensor"]
        if not isinstance(name, str):  # building the process says it
            continue
        lidars = [] if file is None else [one.name for one in file.content.sensors.get("lidar", ())]
        if lidars and file is not None and name not in lidars:
            yield Finding(
                "sensors", False, f"{who}: the profile has no lidar {name!r}; {nearest(str(name), lidars)}",
                f"correct its name in {file.path}, or --set {component.name}.sensor={lidars[0]}",
            )  # fmt: skip
            continue
        uri = _source_of(driver, component, sensors.get(name), file)
        if uri is None:
            continue
        why = _cannot_open(uri)
        way_out = f"connect it, or name another source for sensor {name!r} in the profile, such as sim:street"
        yield Finding("sensors", why is None, f"{who}: {uri}{f': {why}' if why else ''}", way_out if why else "")


def _class_of(component: ComponentSpec, base: type) -> Any:
    """The class of a component, where it is one of a kind; None otherwise."""
    from ..dag import import_class

    try:
        found = import_class(component.class_name) if component.class_name else None
    except ConfigError:  # building the process says it
        return None
    return found if isinstance(found, type) and issubclass(found, base) else None


def _source_of(driver: Any, component: ComponentSpec, sensor: Any, file: ConfigFile[Profile] | None) -> str | None:
    from .execution import ExecutionContext

    try:
        made = driver(component.name, ExecutionContext(sensors={} if sensor is None else {sensor.name: sensor}))
        made.init(driver.Config.model_validate(component.config))
    except ValueError:  # building the process says it
        return None
    return made.source


def _cannot_open(uri: str) -> str | None:
    """Why a source cannot be opened; of the simulator only its words are looked at, its world is not built."""
    from .sources import open_source

    try:
        if uri.startswith("sim:"):
            _check_simulator(uri)
        else:
            open_source(uri)
    except (ConfigError, SourceError, ValueError) as error:
        return str(error)
    return None


def _check_simulator(uri: str) -> None:
    from ..models.simulator import SCENARIOS
    from ..models.simulator.sensors import lidar_model

    scenario, _, query = uri.removeprefix("sim:").partition("?")
    if scenario not in SCENARIOS:
        raise ValueError(f"no scenario {scenario!r}; {nearest(scenario, SCENARIOS)}")
    for model in parse_qs(query).get("lidar", ()):
        lidar_model(model)


def _components(plan: LaunchPlan) -> Iterator[tuple[str, ComponentSpec]]:
    for process, files in plan.modules.items():
        for file in files:
            for component in file.content.components:
                yield process, component


def check_groups(plan: LaunchPlan) -> Iterator[Finding]:
    """Can control groups be made? Without them the processes run all the same, so that nothing is missing."""
    asked = [process.name for process in plan.spec.processes if process.group is not None]
    if not asked:
        return
    groups = ControlGroups()
    if (why := groups.refusal()) is not None:
        yield Finding("cgroups", True, f"{', '.join(asked)}: without group and limits: {why}")
        return
    for process in plan.spec.processes:
        if (why := groups.missing(process.limits)) is not None:
            yield Finding("cgroups", True, f"{process.name}: without limits: {why}")


def check_remote(plan: LaunchPlan) -> Iterator[Finding]:
    """Is what carries topics between hosts installed, and does the node have a use for each of them?"""
    remote = plan.spec.remote
    if remote and importlib.util.find_spec("zenoh") is None:
        yield Finding(
            "remote", False, f"{', '.join(remote)}: topics between hosts need zenoh", "pip install 'warploom[net]'"
        )
    known = {topic for _, one in _components(plan) for topic in (*one.inputs.values(), *one.outputs.values())}
    for topic in remote:
        if topic not in known:
            message = f"no module of the node commits or reads topic {topic!r}; {nearest(topic, known)}"
            yield Finding("remote", False, message, f"correct it in remote of {plan.file.path}, or take it out")
    for endpoint in plan.spec.zenoh.listen if remote else ():
        protocol, _, address = endpoint.partition("/")
        if protocol not in ("tcp", "tls", "ws"):  # the others are not held by being listened at
            continue
        try:
            where = urlsplit(f"//{address}")
            why = "has no port" if where.port is None else _cannot_listen(where.port, where.hostname or "")
        except ValueError as error:
            why = f"is no endpoint: {error}"
        way_out = f"correct zenoh.listen of {plan.file.path}, or end what listens there"
        yield Finding("remote", why is None, f"zenoh: {endpoint} {why or 'is free'}", way_out if why else "")


def check_recordings(plan: LaunchPlan) -> Iterator[Finding]:
    """Can what is to be recorded be written, and is there room?"""
    from .node.recorder import TopicRecorder

    for process, component in _components(plan):
        path = component.config.get("path")
        if not isinstance(path, str) or _class_of(component, TopicRecorder) is None:
            continue
        who = f"{process}/{component.name}"
        folder = Path(path).absolute().parent
        while not folder.exists():  # it is made
            folder = folder.parent
        free = shutil.disk_usage(folder).free
        why = None
        if not folder.is_dir():
            why = "is no folder"
        elif not os.access(folder, os.W_OK | os.X_OK):
            why = "is not writable for this user, or mounted read-only"
        elif free < _ROOM_BYTES:
            why = f"has {free / 2**20:.0f} MiB left: a LiDAR fills that within seconds"
        message = f"{who}: {folder} {why or f'has {free / _GIB:.1f} GiB left'}"
        way_out = f"make room there, or --set {component.name}.path=… to another folder"
        yield Finding("recordings", why is None, message, way_out if why else "")


def check_settings(plan: LaunchPlan) -> Iterator[Finding]:
    """Which settings of the profile are for no component of the node? They are left out, so that nothing is missing."""
    file = _profile_of(plan)
    if file is None:
        return
    known = {one.name for _, one in _components(plan)}
    for key in file.content.settings:
        name = key.partition(".")[0]
        if name not in known:
            said = f"{key} of {file.path} is left out: the node has no component {name!r}; {nearest(name, known)}"
            yield Finding("settings", True, said)


register_check("device", check_device)
register_check("backend", check_backends)
register_check("memory", check_memory)
register_check("models", check_models)
register_check("ports", check_ports)
register_check("sensors", check_sensors)
register_check("recordings", check_recordings)
register_check("remote", check_remote)
register_check("cgroups", check_groups)
register_check("settings", check_settings)
