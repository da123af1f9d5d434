"""The commands of a node as a user runs them: what is started, what a running node answers, what is refused."""

import json
import os
import pathlib
import pty
import subprocess
import sys
import tempfile

import pytest

PARTS = pathlib.Path(__file__).parent / "dag" / "launch" / "parts"
sys.path.insert(0, str(PARTS))

from launch_nodes import DOUBLER, PLAIN, TICKER, Node  # noqa: E402

VALUES = {"period": 20, "size": 1000, "hang_after": 0, "journal": "", "slow_s": 0.0, "config": "{}"}
COMMANDS = ("launch", "start-all", "ps", "top", "topics", "echo", "hz")


def write_modules(folder):
    texts = {
        "ticker": TICKER.format(name="ticker", topic="ticks", **VALUES),
        "doubler": DOUBLER.format(name="doubler", sent="ticks", topic="doubled", **VALUES),
        "plain": PLAIN.format(name="plain", **{**VALUES, "config": "{idle: no receiver is connected}"}),
    }
    for name, text in texts.items():
        (folder / f"{name}.yaml").write_text(text)


@pytest.fixture
def short_folder():
    with tempfile.TemporaryDirectory(prefix="wl-") as path:
        yield path


@pytest.fixture
def folder(tmp_path, short_folder, monkeypatch):
    """A folder with modules and a launch file of two processes, in a run folder of its own."""
    # Not in pytest's folder, whose path is nearly as long as that of a socket may be.
    monkeypatch.setenv("WARPLOOM_RUN", f"{short_folder}/run")
    monkeypatch.delenv("WARPLOOM_CONF", raising=False)
    monkeypatch.chdir(tmp_path)
    write_modules(tmp_path)
    conf = tmp_path / "conf" / "launch"
    conf.mkdir(parents=True)
    (conf / "two.launch.yaml").write_text(
        "node: two\nhardware: {hw: hw1, lidar: test9}\nprocesses:\n"
        f"  - {{name: source, modules: [{tmp_path}/ticker.yaml]}}\n"
        f"  - {{name: sink, modules: [{tmp_path}/doubler.yaml, {tmp_path}/plain.yaml]}}\n"
    )
    return tmp_path


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(warploom, command):
    assert f"warploom {command}" in warploom(command, "--help").split("Example")[1]


def on_terminal(arguments):
    """What a command shows on a terminal, in a process of its own."""
    ours, theirs = pty.openpty()
    code = f"import sys; from warploom.cli import main; sys.argv = ['warploom', *{arguments!r}]; main()"
    command = subprocess.Popen([sys.executable, "-c", code], stdout=theirs, stderr=theirs, env=os.environ)
    os.close(theirs)
    shown = b""
    try:
        while data := os.read(ours, 1 << 16):
            shown += data
    except OSError:  # the end of a terminal
        pass
    os.close(ours)
    assert command.wait(60) == 0, shown.decode()
    return shown.decode()


def test_a_running_node_answers_every_command(folder, warploom):
    paths = os.pathsep.join([str(PARTS), os.environ.get("PYTHONPATH", "")])
    # The reference's command line: one process, several modules.
    node = Node(
        ["launch", "-c", "ticker.yaml", "-c", "doubler.yaml", "-c", "plain.yaml", "-p", "compute3d_sched",
         "--set", "ticker.size=7", "--set", "launch.processes.compute3d_sched.nice=3"],
        {**os.environ, "PYTHONPATH": paths}, folder,
    )  # fmt: skip
    try:
        node.up()
        shown = warploom("ps")
        for expected in (
            "compute3d_sched",
            "running",
            "3 components, 1 of them idle",
            "idle: no receiver is connected",
        ):
            assert expected in " ".join(shown.split())
        status = json.loads(warploom("ps", "--node", "compute3d_sched", "--json"))
        assert status["processes"][0]["nice"] == 3
        top = json.loads(warploom("top", "--every", 0.3, "--count", 1, "--json"))
        assert set(top["cpu_percent"]) == {str(status["processes"][0]["pid"]), str(status["supervisor"]["pid"])}
        assert "supervisor: process" in warploom("top", "--every", 0.1, "--count", 1)
        assert "supervisor: process" in on_terminal(["top", "--every", "0.2", "--count", "2"])
        assert "compute3d_sched/doubler" in warploom("topics")
        topics = {topic["topic"]: topic for topic in json.loads(warploom("topics", "--json"))["topics"]}
        assert topics["ticks"]["readers"] == ["compute3d_sched/doubler"]
        lines = [json.loads(line) for line in warploom("echo", "doubled", "--count", 2, "--timeout", 20).splitlines()]
        assert [len(line["value"]) for line in lines] == [7, 7]
        assert lines[0]["version"] < lines[1]["version"]
        rate = json.loads(warploom("hz", "ticks", "--seconds", 1.0, "--count", 1))
        assert rate["count"] > 5
        assert rate["max_ms"] >= rate["mean_ms"] > 0
        assert "nobody commits topic 'tick'; did you mean 'ticks'" in warploom("echo", "tick", expect=2)
        assert "node 'other' does not run; known: compute3d_sched" in warploom("ps", "--node", "other", expect=2)
        assert node.stop() == 0
    finally:
        node.close()
    assert "no node runs" in warploom("ps", expect=2)


def test_check_validates_everything_and_starts_nothing(folder, warploom, monkeypatch):
    monkeypatch.syspath_prepend(str(PARTS))
    for arguments in (["two"], ["conf/launch/two.launch.yaml"], ["--hw", "hw1", "--lidar", "test9"]):
        output = warploom("launch", *arguments, "--check")
        assert "ok       process sink: 2 modules" in output
        assert "node 'two' is good" in output
    assert not pathlib.Path(os.environ["WARPLOOM_RUN"]).exists()
    xml = folder / "reference.xml"
    xml.write_text(
        f"<cybertron><module><name>source</name><type>energon</type><dag_conf>{folder}/ticker.yaml</dag_conf></module>"
        f"<module><name>sink</name><dag_conf>{folder}/doubler.yaml</dag_conf></module></cybertron>"
    )
    assert "node 'reference' is good" in warploom("launch", xml, "--check")


def test_checking_the_reference_node_compiles_nothing_and_leaves_out_what_only_computes(tmp_path):
    """In a process of its own, whose cache of kernels is empty."""
    code = (
        "import sys; from warploom.cli import main\n"
        "options = {'hw': 'hw50', 'lidar': 'pandar90', 'camera': '13', 'radar': 'conti430'}\n"
        "sys.argv = ['warploom', 'launch', '--check', *(f'--{key}={value}' for key, value in options.items())]\n"
        "try:\n    main()\nfinally:\n"
        "    print({'scipy', 'onnxruntime', 'cv2', 'torch', 'taichi', 'matplotlib'} & set(sys.modules))"
    )
    environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path / "kernels")}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[-1] == "set()"
    assert lines[-2].endswith("node 'computing_node_hw50_pandar90_13_600' is good")
    assert not [path for path in (tmp_path / "kernels").rglob("*") if path.is_file()]


def test_start_all_adds_the_monitors(folder, warploom, monkeypatch):
    monkeypatch.syspath_prepend(str(PARTS))
    output = warploom("start-all", "two", "--check")
    assert "process source: 1 modules" in output
    assert "process monitors: 2 modules" in output


def test_what_is_missing_is_named_with_the_way_out_and_nothing_starts(folder, warploom, monkeypatch):
    from warploom.dag.launch import preflight
    from warploom.dag.launch.preflight import Finding, register_check

    monkeypatch.setattr(preflight, "_checks", {})
    register_check("sensor", lambda plan: [Finding("sensor", False, "no camera answers", "plug it in")])
    register_check("breaks", lambda plan: 1 / 0)
    monkeypatch.syspath_prepend(str(PARTS))
    output = warploom("launch", "two", expect=2)
    assert "MISSING  sensor: no camera answers" in output
    assert "→ plug it in" in output
    assert "the check itself failed: ZeroDivisionError" in output
    assert "nothing was started: preflight failed (sensor, breaks)" in output
    assert "is good" in warploom("launch", "two", "--check", "--skip-check", "sensor", "--skip-check", "breaks")
    assert not pathlib.Path(os.environ["WARPLOOM_RUN"]).exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["launch"], "say what to launch: a launch file, or -c and -p, or --hw"),
        (["launch", "two", "--hw", "hw1"], "say what to launch"),
        (["launch", "-c", "ticker.yaml"], "-c and -p belong together"),
        (["launch", "twoo"], "no launch file 'twoo': neither a file nor a name; did you mean 'two'"),
        (["launch", "none.launch.yaml"], "no launch file 'none.launch.yaml'"),
        (["launch", "--hw", "made-up"], "no launch file is for --hw made-up; there are: --hw hw1 --lidar test9"),
        (["launch", "-c", "tiker.yaml", "-p", "p"], "-c tiker.yaml: no module file 'tiker.yaml'"),
        (["launch", "-c", "doubler.yaml", "-p", "p"], "nobody produces topic 'ticks'"),
        (["launch", "-c", "ticker.yaml", "-p", "a/b"], "a name is 1 to 64 letters"),
        (["launch", "two", "--profile", "cpuu"], "no profile 'cpuu'"),
        (["launch", "two", "--set", "tiker.size=5"], "no component 'tiker'; did you mean 'ticker'"),
        (["launch", "two", "--set", "ticker.sizee=5", "--check"], "ticker.yaml:7: components.0.config.sizee"),
        (["launch", "two", "--set", "launch.processes.sink.nise=5"], "did you mean 'nice'"),
        (["launch", "two", "--set", "launch.processes.0.nice=high"], "found 'high'"),
        (["start-all"], "say what to start"),
        (["ps"], "no node runs"),
        (["echo", "x"], "no node runs"),
    ],
)
def test_bad_usage_says_what_and_starts_nothing(folder, warploom, monkeypatch, arguments, message):
    monkeypatch.syspath_prepend(str(PARTS))
    output = " ".join(warploom(*arguments, expect=2).replace("│", " ").split())
    assert message in output
    assert not pathlib.Path(os.environ["WARPLOOM_RUN"]).exists()
