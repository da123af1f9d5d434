"""Control groups: in a folder that stands for the system's, and in the system's own where that is permitted."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from warploom.dag.launch.cgroup import ControlGroups


@pytest.fixture
def sleeper():
    child = subprocess.Popen([sys.executable, "-I", "-S", "-c", "import time; time.sleep(60)"])
    yield child
    child.kill()
    child.wait()


def test_a_group_is_made_below_the_supervisors_own_and_joined(tmp_path):
    (tmp_path / "service").mkdir()
    groups = ControlGroups(tmp_path, "/service")
    assert groups.join("app/compute", 4711) is None
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
    warning = ControlGroups(tmp_path / "file", "/").join("app", 1)
    assert "cgroup app: " in warning
    assert "the process runs without. Way out: a systemd unit with Delegate=yes" in warning
    none = ControlGroups(tmp_path, "/")
    none._mount = None
    assert none.join("app", 1) == "cgroup app: this system has no cgroup v2; the process runs without"


def test_a_real_process_is_in_a_real_group(sleeper):
    groups = ControlGroups()
    name = f"warploom-test-{os.getpid()}/one"
    warning = groups.join(name, sleeper.pid)
    if warning is not None:
        assert "the process runs without" in warning
        pytest.skip(warning)
    try:
        assert name in Path(f"/proc/{sleeper.pid}/cgroup").read_text()
    finally:
        sleeper.kill()
        sleeper.wait()
        groups.close()
    assert not any(groups._mount.glob(f"**/warploom-test-{os.getpid()}"))
