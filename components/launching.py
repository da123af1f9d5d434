"""The launcher put together: launch files with their profile, preflight, the supervisor; and the entry of its children.

A child is `python -m warploom.components.launching --plan FILE --channel FD --parent PID`; what it runs is in the file.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..dag.configuration import ConfigFile, parse_overrides
from ..dag.launch.channel import Channel
from ..dag.launch.child import Child, ProcessLinks, die_with, end_at_once, show_name
from ..dag.launch.handing import hand_over
from ..dag.launch.schema import LaunchSpec, ProcessSpec
from ..dag.logs import start_logging
from ..dag.modules import load_module
from ..dag.process import Process
from ..dag.schema import ModuleSpec
from ..errors import ConfigError
from .profile import CONF, Profile, execution_context, load_profile, profile_device, use_threads

if TYPE_CHECKING:
    from ..dag.launch.linking import LinkPlan
    from ..dag.launch.plan import LaunchPlan
    from ..dag.launch.preflight import Finding
    from ..dag.launch.run_folder import RunFolder
    from ..dag.launch.table import LiveTable

__all__ = [
    "DEFAULT_PROFILE",
    "Launch",
    "check_launch",
    "monitor_processes",
    "plan_launch",
    "run_launch",
]

DEFAULT_PROFILE = "cpu"
"""Of a launch that names none."""

REFRESH_S = 2.0
"""How often the table on a terminal is drawn where nothing happens [s]."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Launch:
    """A launch that is good: the plan, how its processes are connected, and what was found on this machine."""

    plan: LaunchPlan
    links: Mapping[str, LinkPlan]
    changes: Mapping[str, Any]
    """All settings that the modules have, by dotted key: of the profile, the launch file, and from outside."""
    profile_changes: Mapping[str, Any]


def plan_launch(
    name: str | None = None,
    *,
    hardware: Mapping[str, str] | None = None,
    modules: Sequence[str] = (),
    process: str | None = None,
    profile: str | None = None,
    settings: Iterable[str] = (),
    more: Sequence[ProcessSpec] = (),
) -> Launch:
    """Reads and validates everything that a launch consists of. One of `name`, `hardware` and `modules` says what.

    Args:
        name: A launch file, by path or name.
        hardware: Finds the launch file by its header: hw, lidar, camera, radar.
        modules: Module files of a single process.
        process: The name of that process.
        profile: In place of the launch file's.
        settings: Changes as texts `key=value`: `component.key` of a module, `profile.key` of the profile,
            `launch.key` of the launch file, such as `launch.processes.NAME.nice=5`.
        more: Further processes, beside those of the launch file.

    Raises:
        ConfigError: Something is wrong; the message names file, line, key, and what was expected.
    """
    from ..dag.launch.linking import plan_links
    from ..dag.launch.lookup import CommandLine, find_by_hardware, find_launch_file, load_launch_file
    from ..dag.launch.plan import LaunchPlan, plan_modules

    overrides = parse_overrides(settings)
    keys = {tuple(key.split(".")): value for key, value in overrides.items()}
    of_launch = {key[1:]: value for key, value in keys.items() if key[0] == "launch" and len(key) > 1}
    of_profile = {key[1:]: value for key, value in keys.items() if key[0] == "profile" and len(key) > 1}
    of_modules = {key: value for key, value in keys.items() if key[0] not in ("launch", "profile")}
    if modules:
        file: ConfigFile[LaunchSpec] = CommandLine(process or "", modules, of_launch)
    else:
        path = find_launch_file(name, CONF) if name is not None else find_by_hardware(hardware or {}, CONF)
        file = load_launch_file(path, of_launch)
    for one in more:
        if one.name in [other.name for other in file.content.processes]:
            raise file.error(["processes"], f"there is a process {one.name!r} already")
    file.content = file.content.model_copy(update={"processes": [*file.content.processes, *more]})
    loaded = _profile(file, profile, of_profile)
    defaults = {tuple(key.split(".")): value for key, value in loaded.content.settings.items()}
    read = plan_modules(file, CONF, sensors=loaded.content.sensor_names, changes=of_modules, defaults=defaults)
    merged = {**loaded.content.settings, **file.content.settings, **{".".join(k): v for k, v in of_modules.items()}}
    return Launch(
        LaunchPlan(file, read, loaded, overrides),
        plan_links(read, remote=file.content.remote),
        merged,
        {".".join(key): value for key, value in of_profile.items()},
    )


def _profile(
    file: ConfigFile[LaunchSpec], name: str | None, changes: Mapping[tuple[str, ...], Any]
) -> ConfigFile[Profile]:
    wanted = name or file.content.profile or DEFAULT_PROFILE
    if name is None and file.content.profile is not None:
        beside = file.path.parent / wanted
        try:
            return load_profile(
                str(beside) if beside.suffix in (".yaml", ".yml") and os.path.isfile(beside) else wanted, changes
            )
        except ConfigError as error:
            raise file.error(["profile"], str(error)) from None
    return load_profile(wanted, changes)


def check_launch(launch: Launch, *, build: bool = True) -> list[Finding]:
    """What the preflight checks find; then, with `build`, validates every process with all its classes and settings.

    Raises:
        ConfigError: A process cannot be built.
    """
    from . import preflight  # registers the checks

    del preflight
    from ..dag.launch.preflight import run_checks

    findings = run_checks(launch.plan)
    if build and all(finding.ok for finding in findings):
        for name, files in launch.plan.modules.items():
            build_process(files, launch.plan.profile, launch.links[name].imports, prepare=False)
    return findings


def monitor_processes() -> list[ProcessSpec]:
    """The process that `start-all` starts beside those of the launch file: the modules in `conf/modules/monitors`.

    Raises:
        ConfigError: There are none.
    """
    modules = sorted((CONF / "modules" / "monitors").glob("*.yaml"))
    if not modules:
        raise ConfigError(f"{CONF / 'modules' / 'monitors'}: there are no monitors")
    # A monitor that breaks must not stop what it watches.
    handler = {"exception_handler": "respawn", "restarts": {"limit": 100}, "nice": 5}
    return [ProcessSpec.model_validate({"name": "monitors", "modules": [str(path) for path in modules], **handler})]


def build_process(
    files: Sequence[ConfigFile[ModuleSpec]],
    profile: ConfigFile[Profile],
    imports: Collection[str],
    *,
    prepare: bool = True,
    handover: Path | None = None,
) -> Process:
    """Makes a process of a profile; nothing is started. Without `prepare` it is only to be looked at.

    Its components leave in the folder `handover` what the next life of the process goes on with.

    Raises:
        ConfigError: A module does not fit.
        DeviceError: There is no such device.
        ModelError: A model does not fit its card.
    """
    hand_over(files, set(imports))
    # Where the CPU is meant nobody need be asked for it: Warp is loaded by the components that compute with it.
    device = "cpu" if profile.content.device == "cpu" else profile_device(profile.content)
    context = replace(execution_context(profile, device), handover=handover)
    return Process(
        files,
        context=context,
        external=dict.fromkeys(imports, object),
        on_timing=context.timings,
        check=profile.content.check,
        switch_interval_s=profile.content.threads.switch_interval_s,
        prepare=prepare,
    )


def run_launch(
    launch: Launch,
    *,
    on_event: Callable[[dict[str, Any]], None],
    log_level: str = "warning",
    table: LiveTable | None = None,
) -> int:
    """Runs a node until it ends.

    Args:
        launch: The plan.
        on_event: Is told of everything that happens.
        log_level: Of the processes.
        table: Shows the node on the terminal while it runs.

    Returns:
        0 after a stop that was asked for, 2 where a process could not be built, 1 where one died for good.

    Raises:
        ConfigError: The node runs already, or its folder or socket cannot be made.
    """
    from ..dag.launch.supervisor import Supervisor
    from ..datamesh.transport import reap

    plan = launch.plan

    def command(spec: ProcessSpec, folder: RunFolder) -> list[str]:
        names = ["--node", plan.node, "--process", spec.name]
        # -P: the folder it is started in is not searched for modules, as for the command itself.
        return [sys.executable, "-P", "-m", __name__, *names, "--plan", str(folder.plan(spec.name))]

    def child_plan(spec: ProcessSpec) -> dict[str, Any]:
        return {
            "modules": [str(file.path.absolute()) for file in plan.modules[spec.name]],
            "changes": dict(launch.changes),
            "profile": str(plan.profile.path.absolute()) if plan.profile is not None else None,
            "profile_changes": dict(launch.profile_changes),
            "log_level": log_level,
        }

    supervisor = Supervisor(
        plan,
        launch.links,
        command,
        reap=reap,
        on_event=on_event,
        child_plan=child_plan,
        refresh=None if table is None else (REFRESH_S, table.refresh),
    )
    if table is not None:
        table.show(supervisor.status)
    return supervisor.run()


def _build_child(told: Mapping[str, Any]) -> tuple[Process, ProcessLinks, Sequence[str]]:
    """What a child runs, by its plan file."""
    from ..dag.launch.run_folder import RunFolder

    profile = load_profile(told["profile"], {tuple(key.split(".")): v for key, v in told["profile_changes"].items()})
    use_threads(profile.content)
    changes = {tuple(key.split(".")): value for key, value in told["changes"].items()}
    files = [load_module(Path(path), changes, profile.content.sensor_names) for path in told["modules"]]
    handover = RunFolder(told["node"]).handover(told["process"]["name"])
    process = build_process(files, profile, told["links"]["imports"], handover=handover)
    from ..dag.launch.linking import LinkPlan, Links
    from ..datamesh.transport import SharedMemoryConfig, ZenohConfig

    links = told["links"]
    topics = {key: tuple(links[key]) for key in ("exports", "imports", "blocking", "homes")}
    plan = LinkPlan(**topics, remote=links["remote"])
    connected = Links(
        process,
        plan,
        node=told["node"],
        name=told["process"]["name"],
        shared_memory=SharedMemoryConfig.model_validate(told["shared_memory"]),
        zenoh=ZenohConfig.model_validate(told["zenoh"]),
    )
    return process, connected, plan.exports


def main() -> int:
    """Runs one child; gives its exit code once all that it holds is flushed and closed."""
    parser = argparse.ArgumentParser(description="A process of a node; its supervisor starts it.")
    for name in ("--node", "--process", "--plan"):
        parser.add_argument(name, required=True)
    parser.add_argument("--channel", type=int, required=True)
    parser.add_argument("--parent", type=int, required=True)
    options = parser.parse_args()
    die_with(options.parent)
    told = json.loads(Path(options.plan).read_text(encoding="utf-8"))
    spec = ProcessSpec.model_validate(told["process"])
    show_name(spec.process_name or spec.name)
    start_logging(told["log_level"])
    return Child(Channel(options.channel), spec).run(lambda: _build_child(told))


if __name__ == "__main__":
    end_at_once(main())
