"""The integrated folder: it holds what it should, and runs without the checkout, by its own package alone."""

import ast
import json
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import tempfile
import time

import pytest

from warploom.components.integration import Integration, integrate
from warploom.components.interfaces import shipped_topics, stub_of
from warploom.components.messages import CameraSet, Obstacles, RadarSet, SensorFrame
from warploom.components.node.transforms import StaticTransforms
from warploom.errors import ConfigError, WarploomError

NODE = "computing_node_hw50_pandar90_13_600"

pytestmark = pytest.mark.skipif(os.name != "posix", reason="its scripts are those of a POSIX shell")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> pathlib.Path:
    return integrate(tmp_path_factory.mktemp("integrated") / "out")


@pytest.fixture
def environment(tmp_path):
    """Nothing of the environment of the tests but the kernels that are compiled already."""
    # The path of a Unix socket must be short, and that of pytest's folders is not.
    runs = pathlib.Path(tempfile.mkdtemp(prefix="wl-"))
    kept = {name: os.environ[name] for name in ("PATH", "WARP_CACHE_PATH") if name in os.environ}
    yield {**kept, "HOME": str(tmp_path), "WARPLOOM_RUN": str(runs), "COLUMNS": "200"}
    shutil.rmtree(runs)


def run(folder, script, *arguments, environment, cwd, timeout=300):
    command = [str(folder / "bin" / script), *arguments]
    return subprocess.run(command, env=environment, cwd=cwd, capture_output=True, text=True, timeout=timeout)


def test_it_holds_the_folders_of_the_reference(folder):
    assert {path.name for path in folder.iterdir()} == {
        "bin", "include", "lib", "dag", "launch", "conf", "integration.json",
    }  # fmt: skip
    assert {path.name for path in (folder / "bin").iterdir()} == {"start_all", "launcher", "warploom"}
    assert all(os.access(path, os.X_OK) for path in (folder / "bin").iterdir())
    assert (folder / "dag" / "perception" / "ads50_hesai90_setup.yaml").is_file()
    assert (folder / "launch" / f"{NODE}.launch.xml").is_file()
    assert (folder / "conf" / "profiles" / "cpu.yaml").is_file()
    assert (folder / "lib" / "warploom" / "models" / "weights" / "pillar_center.onnx").is_file()
    assert (folder / "lib" / "warploom" / "py.typed").is_file()
    assert not (folder / "lib" / "warploom" / "tests").exists()


def test_there_is_one_truth_for_each_configuration_file(folder):
    for way in ("conf/modules", "lib/warploom/conf/modules"):
        assert (folder / way).resolve() == (folder / "dag").resolve()
    assert (folder / "lib/warploom/conf/launch").resolve() == (folder / "launch").resolve()


def test_nothing_in_it_points_out_of_it(folder):
    for path in folder.rglob("*"):
        if path.is_symlink():
            assert path.resolve().is_relative_to(folder.resolve()), path


def test_the_manifest_says_what_it_was_made_of(folder):
    said = json.loads((folder / "integration.json").read_text())
    assert said["node"] == NODE
    assert {"numpy", "warp-lang", "onnxruntime", "psutil"} <= set(said["packages"])
    assert "pytest" not in said["packages"]


def test_the_interfaces_are_python_that_parses_and_name_every_topic(folder):
    include = folder / "include"
    trees = {name: ast.parse((include / name).read_text()) for name in ("messages.pyi", "components.pyi")}
    classes = {name: {n.name for n in ast.walk(tree) if isinstance(n, ast.ClassDef)} for name, tree in trees.items()}
    assert {"SensorFrame", "Truth", "Obstacles", "StaticTransforms", "GpuReading"} <= classes["messages.pyi"]
    assert {"LidarDriver", "ObstacleIntake", "IdleComponent"} <= classes["components.pyi"]
    imported = {a.name for n in ast.walk(trees["components.pyi"]) if isinstance(n, ast.ImportFrom) for a in n.names}
    assert "Obstacles" in imported
    table = (include / "topics.md").read_text()
    for topic in shipped_topics():
        assert f"| {topic} |" in table


def test_topics_know_their_types_producers_and_readers():
    topics = shipped_topics()
    assert topics["perception/obstacles"].payload is Obstacles
    assert "planning_sched/obstacle_intake" in topics["perception/obstacles"].readers
    assert topics["sensor/hesai90/raw"].payload is SensorFrame
    assert topics["vehicle/transforms"].payload is StaticTransforms
    for name, kind in (("lidar/points", SensorFrame), ("camera/objects", CameraSet), ("radar/objects", RadarSet)):
        assert topics[name].payload is kind
        assert topics[name].producers == ["the source of a pipeline"]
        assert "perception/" in " ".join(topics[name].readers)
    assert topics["sensor/cameras/objects"].payload is CameraSet
    assert topics["sensor/radars/objects"].payload is RadarSet


def test_a_stub_has_fields_and_methods_without_their_bodies():
    text = stub_of(StaticTransforms)
    namespace: dict = {"np": __import__("numpy"), "dataclass": __import__("dataclasses").dataclass}
    exec(text, namespace)
    assert set(namespace["StaticTransforms"].__annotations__) == set(StaticTransforms.__annotations__)
    assert "..." in text
    assert "message(" not in text
    assert "self.frames.index" not in text


def test_its_package_is_the_one_that_runs(folder, environment, tmp_path):
    script = (folder / "bin" / "warploom").read_text()
    probe = folder / "bin" / "probe"
    probe.write_text(
        script.replace("from warploom.cli import main; main()", "import warploom; print(warploom.__file__)")
    )
    probe.chmod(0o755)
    try:
        done = run(folder, "probe", environment=environment, cwd=tmp_path)
    finally:
        probe.unlink()
    assert done.stdout.strip() == str(folder / "lib" / "warploom" / "__init__.py"), done.stderr


def test_its_commands_answer_outside_the_checkout(folder, environment, tmp_path):
    done = run(folder, "warploom", "check", "planning_sched", environment=environment, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert str(folder / "lib" / "warploom" / "conf" / "modules" / "planning_sched.yaml") in done.stdout
    done = run(folder, "start_all", "--hw", "hw51", environment=environment, cwd=tmp_path)
    assert done.returncode == 2
    assert "--hw hw50 --lidar pandar90 --camera 13 --radar conti430" in done.stderr
    done = run(folder, "start_all", "--check", "--skip-check", "memory", environment=environment, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert f"node {NODE!r} is good" in done.stdout, "options name no other node"
    done = run(folder, "start_all", "--check", "nothing.launch.yaml", environment=environment, cwd=tmp_path)
    assert done.returncode == 2
    assert "nothing.launch.yaml" in done.stderr


def test_it_is_made_anew_in_its_own_folder_and_in_no_other(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(ConfigError, match="holds files that no integration put there"):
        integrate(tmp_path)
    assert (tmp_path / "mine.txt").read_text() == "mine"
    with pytest.raises(ConfigError, match="is a file, not a folder"):
        integrate(tmp_path / "mine.txt")
    with pytest.raises(ConfigError, match=f"no launch file 'other'; there are: {NODE}"):
        integrate(tmp_path / "out", node="other")
    assert not (tmp_path / "out").exists()


def test_a_run_that_broke_off_can_be_repeated(tmp_path, monkeypatch):
    out = tmp_path / "out"
    one = Integration(out)

    def full_disk():
        raise OSError(28, "No space left on device", "lib")

    monkeypatch.setattr(one, "_library", full_disk)
    with pytest.raises(WarploomError, match="No space left on device: lib"):
        one.run()
    two = Integration(out)
    monkeypatch.setattr(two, "_library", lambda: None)  # the rest is quick
    two.run()
    assert (out / "bin" / "start_all").is_file()


@pytest.mark.slow
def test_start_all_runs_the_node_without_the_checkout_and_brings_back_what_is_killed(folder, environment, tmp_path):
    log = (tmp_path / "log").open("w+")
    node = subprocess.Popen([str(folder / "bin" / "start_all")], env=environment, cwd=tmp_path, stdout=log, stderr=log)
    after: dict = {}
    try:
        before = wait_for(folder, environment, tmp_path, node, lambda one: one["state"] == "running")
        assert set(before) == {"compute3d_sched", "planning_sched", "monitors"}
        idle = {c["name"]: c["idle_because"] for c in before["compute3d_sched"]["components"] if c["idle_because"]}
        assert "a driver for GNSS receivers is not there" in idle["gpsbin"]
        os.kill(before["planning_sched"]["pid"], signal.SIGKILL)
        after = wait_for(
            folder, environment, tmp_path, node,
            lambda one: one["state"] == "running" and (one["name"] != "planning_sched" or one["restarts"] == 1),
        )  # fmt: skip
        assert after["planning_sched"]["pid"] != before["planning_sched"]["pid"]
        assert after["compute3d_sched"]["pid"] == before["compute3d_sched"]["pid"]
    finally:
        node.send_signal(signal.SIGTERM)
        node.wait(120)
        log.seek(0)
        sys.stdout.write(log.read()[-4000:])  # pytest shows it where the test fails
    assert node.returncode == 0
    for one in after.values():
        assert not pathlib.Path(f"/proc/{one['pid']}").exists()


def wait_for(folder, environment, cwd, node, condition, seconds=480):
    """The processes by name, once each of them fulfils a condition."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        assert node.poll() is None, "the supervisor has ended"
        done = run(folder, "warploom", "ps", "--json", environment=environment, cwd=cwd)
        if done.returncode == 0:
            processes = {one["name"]: one for one in json.loads(done.stdout)["processes"]}
            if processes and all(condition(one) for one in processes.values()):
                return processes
        time.sleep(1)
    raise AssertionError(f"the node did not come up within {seconds} s: {done.stdout}{done.stderr}")


def test_the_command_says_what_it_made_or_why_not(tmp_path):
    (tmp_path / "file").write_text("")
    command = [sys.executable, "-m", "warploom.components.integration", str(tmp_path / "file")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2
    assert "is a file, not a folder" in done.stderr
