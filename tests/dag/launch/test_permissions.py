"""What the system does not permit, or has no room for, tried by who is not root: told, and nothing half-starts."""

import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from launch_nodes import PLAIN, TICKER
from launch_users import as_user, give, with_mount

from warploom.dag.launch.cgroup import ControlGroups
from warploom.datamesh.recording import EventKind
from warploom.datamesh.recording_reader import Recording

METRICS = """\
module: {name}
components:
  - name: {name}
    kind: generic
    class: warploom.components.node.metric_agent.MetricAgent
    config: {config}
"""
WAY_OUT = "Way out: a systemd unit with Delegate=yes, or a group that root has given to this user (chown)"


@pytest.fixture
def port():
    """A port that only root may listen on."""
    first_free = int(Path("/proc/sys/net/ipv4/ip_unprivileged_port_start").read_text())
    if first_free < 2:
        pytest.skip("every port is permitted to every user here")
    return first_free - 1


@pytest.fixture
def user(run_base):
    """What goes before a command so that an ordinary user runs it, who owns the folder of the nodes."""
    before = as_user()
    run_base.mkdir()
    give(run_base)
    return before


@pytest.fixture
def taken():
    """A port that somebody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening.getsockname()[1]


def test_a_port_that_is_not_permitted_is_told_and_nothing_starts(start, user, module, launch_file, run_base, port):
    node = start("launch", launch_file(one=[module(METRICS, "metrics", config=f"{{port: {port}}}")]), before=user)
    assert node.wait() == 2
    assert f"MISSING  ports: one/metrics: port {port} is not permitted to this user (below {port + 1} " in node.errors
    assert "→ --set metrics.port=N takes another" in node.errors
    assert node.events == []
    assert list(run_base.iterdir()) == []


def test_a_port_that_is_taken_is_told_and_nothing_starts(start, module, launch_file, run_base, taken):
    node = start("launch", launch_file(one=[module(METRICS, "metrics", config=f"{{port: {taken}}}")]))
    assert node.wait() == 2
    assert f"MISSING  ports: one/metrics: port {taken} is taken: Address already in use" in node.errors
    assert node.events == []
    assert not run_base.exists()


@pytest.mark.parametrize("why", ["permitted", "taken"])
def test_a_port_that_is_lost_after_the_check_costs_the_metrics_alone(start, user, module, launch_file, request, why):
    number = request.getfixturevalue("port" if why == "permitted" else "taken")
    metrics = module(METRICS, "metrics", config=f"{{port: {number}}}")
    ticker = module(TICKER, "ticker", topic="ticks")
    node = start("launch", launch_file(one=[metrics, ticker]), "--skip-check", "ports", before=user).up()
    node.wait_until(lambda: node.ask("topics")["topics"][0]["commits"] > 5)
    said = {one["name"]: one["idle_because"] for one in node.process("one")["components"]}
    assert f"port {number} cannot be used for metrics: " in said["metrics"]
    assert ("Permission denied" if why == "permitted" else "already in use") in said["metrics"]
    assert said["ticker"] is None
    assert node.process("one")["restarts"] == 0
    assert node.stop() == 0


def grouped(module, launch_file, **keys):
    """A launch file of one process in a control group."""
    return launch_file(one={"modules": [module(TICKER, "ticker", topic="ticks")], "cgroup": "wl-test/one", **keys})


def refusal(before):
    """What a check says of groups, where it is run in such a way."""
    code = "from warploom.dag.launch.cgroup import ControlGroups; print(ControlGroups().refusal())"
    done = subprocess.run([*before, sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def runs_without_its_group(node):
    """Looks that the process works all the same; gives what was told."""
    node.wait_until(lambda: node.ask("topics")["topics"][0]["commits"] > 5)
    process = node.process("one")
    assert "wl-test" not in Path(f"/proc/{process['pid']}/cgroup").read_text()
    warnings = process["warnings"]
    assert [event["message"] for event in node.find("warning", process="one")] == warnings
    assert node.stop() == 0
    return warnings


def test_without_the_right_to_make_groups_the_node_runs_and_says_so(start, user, module, launch_file):
    groups = ControlGroups()
    if groups._mount is None or (not user and groups.refusal() is None):
        pytest.skip("there is no cgroup v2, or this user may make groups")
    if os.statvfs(groups._mount).f_flag & os.ST_RDONLY:
        pytest.skip("groups are mounted read-only here, which is another case")
    file = grouped(module, launch_file, limits={"memory_max": "1GiB"}, nice=-5)
    checked = start("launch", file, "--check", before=user)
    assert checked.wait() == 0
    told = "\n".join(event["text"] for event in checked.events)
    assert f"ok       cgroups: one: without group and limits: {groups._mount}" in told
    assert f"is not writable for this user. {WAY_OUT}" in told
    group, nice = runs_without_its_group(start("launch", file, before=user).up())
    assert group.startswith(f"cgroup wl-test/one: {groups._mount}")
    assert f": Permission denied; the process runs without. {WAY_OUT}" in group
    assert nice.startswith("nice -5: ")
    assert "CAP_SYS_NICE" in nice


def test_where_groups_are_mounted_read_only_the_node_runs_and_says_so(start, module, launch_file):
    mount = ControlGroups()._mount
    if mount is None:
        pytest.skip("this system has no cgroup v2")
    before = with_mount(["-o", "bind,ro", str(mount)], mount)
    assert refusal(before).endswith(f": is mounted read-only. {WAY_OUT}")
    (warning,) = runs_without_its_group(start("launch", grouped(module, launch_file), before=before).up())
    assert f": Read-only file system; the process runs without. {WAY_OUT}" in warning


@pytest.fixture
def delegated():
    """Makes a control group, gives some of its files to the user, and says how to begin in it."""
    groups = ControlGroups()
    if os.geteuid() != 0 or groups.refusal() is not None:
        pytest.skip("no control group can be made here")
    folder = groups._mount / groups._own / f"warploom-test-delegated-{os.getpid()}"
    folder.mkdir()

    def delegate(*files):
        give(folder, *(folder / file for file in files))
        return folder, ["sh", "-c", f'echo $$ > "{folder}/cgroup.procs" && exec "$@"', "sh"]

    yield delegate
    folder.rmdir()


def test_in_a_group_that_was_given_to_the_user_groups_are_made_and_removed(start, user, delegated, module, launch_file):
    folder, begin = delegated("cgroup.procs", "cgroup.subtree_control")
    node = start("launch", grouped(module, launch_file), before=[*begin, *user]).up()
    process = node.process("one")
    assert process["warnings"] == []
    joined = Path(f"/proc/{process['pid']}/cgroup").read_text()
    assert f"0::/{folder.name}/wl-test/one\n" in joined or joined.rstrip().endswith(f"{folder.name}/wl-test/one")
    assert node.stop() == 0
    assert [path for path in folder.iterdir() if path.is_dir()] == []


def test_a_group_that_was_given_by_half_is_told_and_nothing_of_it_stays(start, user, delegated, module, launch_file):
    folder, begin = delegated()
    before = [*begin, *user]
    assert refusal(before) == f"{folder}/cgroup.procs: is not writable for this user. {WAY_OUT}"
    (warning,) = runs_without_its_group(start("launch", grouped(module, launch_file), before=before).up())
    assert f"{folder}/wl-test/one/cgroup.procs: Permission denied; the process runs without. {WAY_OUT}" in warning
    assert [path for path in folder.iterdir() if path.is_dir()] == []


def refused(node, said):
    """Looks that nothing was started, and why."""
    assert node.wait() == 2
    assert said in node.errors
    assert "set WARPLOOM_RUN" in node.errors
    assert "Traceback" not in node.errors
    assert not node.find("state")
    assert node.children() == []


@pytest.fixture
def file(module, launch_file):
    """A launch file of two processes."""
    return launch_file(one=[module(PLAIN, "one")], two=[module(PLAIN, "two")])


def test_a_run_folder_that_may_not_be_written_is_told(start, run_base, file, tmp_path):
    user = as_user()
    run_base.mkdir()
    if not user:
        run_base.chmod(0o500)
    refused(start("launch", file, before=user), f"{run_base}/node: cannot be made: Permission denied")
    missing = tmp_path / "run" / "below"
    refused(start("launch", file, before=user, WARPLOOM_RUN=str(missing)), f"{missing}/node: cannot be made")


def test_a_run_folder_of_somebody_else_is_told(start, run_base, file):
    user = as_user()
    if not user:
        pytest.skip("only root makes folders for others")
    (run_base / "node").mkdir(parents=True)
    refused(start("launch", file, before=user), f"{run_base}/node: is not a folder of this user alone")


@pytest.mark.parametrize(("size", "why"), [("ro", "Read-only file system"), ("size=4k", "No space left on device")])
def test_a_run_folder_on_a_disk_that_takes_nothing_more_is_told(start, run_base, file, size, why):
    run_base.mkdir()
    before = with_mount(["-t", "tmpfs", "-o", size, "tmpfs"], run_base)
    if size != "ro":
        before[-2] = before[-2].replace(" && exec", f" && dd if=/dev/zero of='{run_base}/filling' bs=4k; exec")
    refused(start("launch", file, before=before), why)


def test_a_run_folder_that_fills_up_in_between_starts_nothing(start, run_base, file):
    """There is room for the lock, but not for what the processes are to run."""
    run_base.mkdir()
    before = with_mount(["-t", "tmpfs", "-o", "size=12k", "tmpfs"], run_base)
    before[-2] = before[-2].replace(" && exec", f" && dd if=/dev/zero of='{run_base}/filling' bs=4k count=2; exec")
    refused(start("launch", file, before=before), f"{run_base}/node: cannot be written: No space left on device")
    assert subprocess.run(["sh", "-c", f"mountpoint -q {run_base}"]).returncode != 0


RECORDER = """\
module: {name}
components:
  - name: {name}
    kind: generic
    class: warploom.components.node.recorder.TopicRecorder
    config: {config}
    inputs: {{any: ticks}}
"""


def test_a_disk_that_fills_up_ends_the_recording_and_nothing_else(start, module, launch_file, tmp_path):
    folder = tmp_path / "disk"
    folder.mkdir()
    before = with_mount(["-t", "tmpfs", "-o", "size=1m", "tmpfs"], folder)
    recorder = module(RECORDER, "recorder", config=f"{{path: {folder}/run.mcap}}")
    file = launch_file(one=[module(TICKER, "ticker", topic="ticks", size=20_000), recorder])
    refused = start("launch", file, before=before)
    assert refused.wait() == 2
    assert f"MISSING  recordings: one/recorder: {folder} has 1 MiB left" in refused.errors
    assert "→ make room there, or --set recorder.path=" in refused.errors
    node = start("launch", file, "--skip-check", "recordings", before=before).up()

    def recording():
        return next(one for one in node.process("one")["components"] if one["name"] == "recorder")

    why = node.wait_until(lambda: recording()["idle_because"])
    assert why == "the recording broke off: No space left on device"
    lost = recording()["state"]["lost"]
    node.wait_until(lambda: recording()["state"]["lost"] > lost)  # what is committed from here on is counted
    seen = Path(f"/proc/{node.process('one')['pid']}/root{folder}")  # as the process sees it
    (path,) = (shutil.copy(one, tmp_path) for one in seen.iterdir())
    assert len([event for event in Recording(path) if event.kind is EventKind.COMMIT]) > 0
    assert node.process("one")["restarts"] == 0
    assert node.stop() == 0


def test_a_recording_where_this_user_may_not_write_is_told_and_nothing_starts(start, user, module, launch_file):
    place = Path("/proc/recordings/run.mcap")  # where not even root may make a folder
    recorder = module(RECORDER, "recorder", config=f"{{path: {place}}}")
    node = start("launch", launch_file(one=[module(TICKER, "ticker", topic="ticks"), recorder]), before=user)
    assert node.wait() == 2
    assert "MISSING  recordings: one/recorder: /proc is not writable for this user" in node.errors
    assert node.events == []
