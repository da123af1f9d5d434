"""Control groups: in a folder that stands for the system's, and in the system's own where that is permitted."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from warploom.dag.launch.cgroup import ControlGroups
from warploom.dag.launch.schema import LimitsSpec, ProcessSpec


@pytest.fixture
def sleeper():
    child = subprocess.Popen([sys.executable, "-I", "-S", "-c", "import time; time.sleep(60)"])
    yield child
    child.kill()
    child.wait()


def test_a_group_is_made_below_the_supervisors_own_and_joined(tmp_path):
    (tmp_path / "service").mkdir()
    groups = ControlGroups(tmp_path, "/service")
    assert groups.join("app/compute", 4711) == []
    assert (tmp_path / "service" / "app" / "compute" / "cgroup.procs").read_text() == "4711\n"


def test_groups_that_it_made_are_removed_and_others_stay(tmp_path):
    (tmp_path / "app").mkdir()
    groups = ControlGroups(tmp_path, "/")
    groups.join("app/one", 1)
    (tmp_path / "app" / "one" / "cgroup.procs").unlink()  # the kernel's files do not keep a folder, plain ones do
    groups.close()
    assert (tmp_path / "app").is_dir()
    assert not (tmp_path / "app" / "one").exists()


def test_what_is_not_permitted_is_told_with_the_way_out(tmp_path):
    (tmp_path / "file").write_text("")
    (warning,) = ControlGroups(tmp_path / "file", "/").join("app", 1)
    assert "cgroup app: " in warning
    assert "the process runs without. Way out: a systemd unit with Delegate=yes" in warning
    none = ControlGroups(tmp_path, "/")
    none._mount = None
    assert none.join("app", 1) == ["cgroup app: this system has no cgroup v2; the process runs without"]
    assert none.refusal() == "this system has no cgroup v2"


LIMITS = LimitsSpec.model_validate({"memory_max": "512MiB", "cpu_max": 1.5, "cpu_weight": 50})


def test_limits_are_written_and_their_controllers_passed_down_to_the_group(tmp_path):
    assert ControlGroups(tmp_path, "/").join("app/compute", 4711, LIMITS) == []
    group = tmp_path / "app" / "compute"
    assert (group / "memory.max").read_text() == f"{512 << 20}\n"
    assert (group / "cpu.max").read_text() == "150000 100000\n"
    assert (group / "cpu.weight").read_text() == "50\n"
    for folder in (tmp_path, tmp_path / "app"):
        assert (folder / "cgroup.subtree_control").read_text() == "+cpu +memory"
    assert not (group / "cgroup.subtree_control").exists()
    assert (group / "cgroup.procs").read_text() == "4711\n"


def test_where_the_supervisor_is_in_the_way_it_goes_into_a_group_of_its_own(tmp_path, monkeypatch):
    """As the kernel has it: a group with processes in it passes no controllers on."""
    own = tmp_path / "service"
    (own / "supervisor").mkdir(parents=True)
    write = Path.write_text

    def write_text(path, text, *more, **keys):
        if path == own / "cgroup.subtree_control" and not (own / "supervisor" / "cgroup.procs").exists():
            raise OSError(errno.EBUSY, os.strerror(errno.EBUSY), str(path))
        return write(path, text, *more, **keys)

    monkeypatch.setattr(Path, "write_text", write_text)
    groups = ControlGroups(tmp_path, "/service")
    assert groups.join("app", 4711, LIMITS) == []
    assert (own / "supervisor" / "cgroup.procs").read_text() == f"{os.getpid()}\n"
    groups.close()
    assert (own / "cgroup.procs").read_text() == f"{os.getpid()}\n"
    assert (own / "cgroup.subtree_control").read_text() == "-cpu -memory"


@pytest.mark.parametrize("refused", ["cgroup.subtree_control", "memory.max", "cpu.weight"])
def test_a_limit_that_is_not_permitted_is_told_and_the_process_joins_all_the_same(tmp_path, monkeypatch, refused):
    write = Path.write_text

    def write_text(path, text, *more, **keys):
        if path.name == refused:
            raise OSError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return write(path, text, *more, **keys)

    monkeypatch.setattr(Path, "write_text", write_text)
    (warning,) = ControlGroups(tmp_path, "/").join("app", 4711, LIMITS)
    assert warning.startswith("cgroup app: ")
    assert f"{refused}: Permission denied; the process runs without" in warning
    assert (tmp_path / "app" / "cgroup.procs").read_text() == "4711\n"
    assert (tmp_path / "app" / "cpu.max").exists() == (refused != "cgroup.subtree_control")


def test_a_controller_that_the_system_does_not_have_is_named(tmp_path):
    (tmp_path / "cgroup.controllers").write_text("cpu hugetlb\n")
    groups = ControlGroups(tmp_path, "/")
    told = f"memory.max: {tmp_path} has no controller memory (cgroup.controllers). Way out: let the group above"
    assert groups.missing(LIMITS).startswith(told)
    (warning,) = groups.join("app", 4711, LIMITS)
    assert f"cgroup app: the process runs without limits: {told}" in warning
    assert not (tmp_path / "cgroup.subtree_control").exists()
    assert (tmp_path / "app" / "cgroup.procs").read_text() == "4711\n"
    assert groups.missing(LimitsSpec(cpu_max=1)) is None
    assert groups.missing(LimitsSpec()) is None


def test_looking_whether_groups_can_be_made_changes_nothing(tmp_path):
    assert ControlGroups(tmp_path, "/").refusal() is None
    assert list(tmp_path.iterdir()) == []
    assert "none: there is no such group. Way out: a systemd unit" in ControlGroups(tmp_path, "/none").refusal()


@pytest.mark.parametrize(
    ("text", "size"),
    [("4GiB", 4 << 30), ("1.5 gib", 3 << 29), ("512MiB", 512 << 20), ("2048KiB", 2 << 20), (1 << 30, 1 << 30)],
)
def test_memory_is_bytes_or_a_text_with_its_unit(text, size):
    assert LimitsSpec.model_validate({"memory_max": text}).memory_max == size


@pytest.mark.parametrize(
    "limits", [{"memory_max": "4GB"}, {"memory_max": "much"}, {"memory_max": 5}, {"cpu_max": 0}, {"cpu_weight": 0}]
)
def test_limits_that_are_none_are_refused(limits):
    with pytest.raises(ValueError, match=next(iter(limits))):
        LimitsSpec.model_validate(limits)


def test_limits_without_a_group_make_one_of_the_processs_name():
    spec = {"name": "one", "modules": ["m"]}
    assert ProcessSpec.model_validate(spec).group is None
    assert ProcessSpec.model_validate({**spec, "limits": {"cpu_max": 1}}).group == "one"
    assert ProcessSpec.model_validate({**spec, "limits": {"cpu_max": 1}, "cgroup": "app/x"}).group == "app/x"


@pytest.mark.parametrize("limits", [None, LIMITS])
def test_a_real_process_is_in_a_real_group_with_its_limits(sleeper, limits):
    groups = ControlGroups()
    name = f"warploom-test-{os.getpid()}/one"
    before = Path("/proc/self/cgroup").read_text()
    warnings = groups.join(name, sleeper.pid, limits)
    try:
        if warnings:
            assert all("the process runs without" in warning for warning in warnings)
            pytest.skip("; ".join(warnings))
        assert name in Path(f"/proc/{sleeper.pid}/cgroup").read_text()
        folder = next(groups._mount.glob(f"**/{name}"))
        assert limits is None or (folder / "memory.max").read_text() == f"{512 << 20}\n"
    finally:
        sleeper.kill()
        sleeper.wait()
        groups.close()
    assert not any(groups._mount.glob(f"**/warploom-test-{os.getpid()}"))
    assert Path("/proc/self/cgroup").read_text() == before


def test_what_a_life_before_left_is_removed_by_the_next(tmp_path):
    mount, ledger = tmp_path / "mount", tmp_path / "cgroups"
    (mount / "others").mkdir(parents=True)
    killed = ControlGroups(mount, "/", ledger)
    for name in ("app/one", "app/two", "others/three"):
        assert killed.join(name, 4711) == []
        (mount / name / "cgroup.procs").unlink()
    (mount / "app" / "two" / "busy").mkdir()
    following = ControlGroups(mount, "/", ledger)
    assert following.reap() == [str(mount / "others" / "three"), str(mount / "app" / "one")]
    assert sorted(path.name for path in mount.rglob("*")) == ["app", "busy", "others", "two"]
    (mount / "app" / "two" / "busy").rmdir()
    following.close()
    assert [path.name for path in mount.iterdir()] == ["others"], "what others made is theirs"
    assert not ledger.exists()
    assert ControlGroups(mount, "/", ledger).reap() == []


def test_a_note_that_is_damaged_or_speaks_of_other_folders_removes_nothing(tmp_path):
    mount, ledger, other = tmp_path / "mount", tmp_path / "cgroups", tmp_path / "other"
    for folder in (mount, other):
        folder.mkdir()
    ledger.write_text(f"{other}\n{mount}/../other\n{mount}\n\nnonsense\n")
    assert ControlGroups(mount, "/", ledger).reap() == []
    ledger.write_bytes(b"\xff\xfe")
    assert ControlGroups(mount, "/", ledger).reap() == []
    assert other.is_dir()
    assert mount.is_dir()


KILLED = """
import os, pathlib, signal, sys
from warploom.dag.launch.cgroup import ControlGroups
groups = ControlGroups(ledger=pathlib.Path(sys.argv[1]))
for warning in groups.join(sys.argv[2], int(sys.argv[3])):
    print(warning)
sys.stdout.flush()
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_real_groups_of_one_that_was_killed_are_removed_once_nobody_is_in_them(tmp_path, sleeper):
    ledger, top = tmp_path / "cgroups", f"warploom-test-killed-{os.getpid()}"
    ran = subprocess.run(
        [sys.executable, "-c", KILLED, str(ledger), f"{top}/one", str(sleeper.pid)], capture_output=True, text=True
    )
    if ran.stdout:
        pytest.skip(ran.stdout)
    groups = ControlGroups(ledger=ledger)
    assert any(groups._mount.glob(f"**/{top}/one"))
    try:
        assert groups.reap() == [], "a process is in it"
    finally:
        sleeper.kill()
        sleeper.wait()
    following = ControlGroups(ledger=ledger)
    removed = following.reap()
    assert [path.endswith(end) for path, end in zip(removed, (f"{top}/one", top), strict=True)] == [True, True]
    assert not any(groups._mount.glob(f"**/{top}"))
    assert not ledger.exists()
