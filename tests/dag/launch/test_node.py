"""A node of real processes: started together or not at all, stopped in order, killed, hanging, crashing."""

import os
import signal
import socket
import time
from importlib import import_module
from pathlib import Path

import psutil
import pytest
from launch_nodes import DOUBLER, PLAIN, TICKER, WRITER

from warploom.datamesh.recording import GAPS, EventKind
from warploom.datamesh.recording_reader import Recording


def versions(path):
    """What a component has noted, as numbers; a line that was cut off by a kill counts as none."""
    path = Path(path)
    return [int(line) for line in path.read_text().split()] if path.exists() else []


@pytest.fixture
def chain(module, launch_file, tmp_path):
    """A launch file of three processes in a row, each noting what it has committed or recorded."""

    def chain(node="node", period=20, size=16, **keys):
        ticker = module(
            TICKER, f"{node}_ticker", topic="ticks", journal=tmp_path / f"{node}-ticker", period=period, size=size
        )
        doubler = module(
            DOUBLER, f"{node}_doubler", sent="ticks", topic="doubled", journal=tmp_path / f"{node}-doubler"
        )
        writer = module(WRITER, f"{node}_writer", sent="doubled", path=tmp_path / f"{node}-writer")
        # Enough restarts for a hundred kills; a machine on which much else runs is none that hangs.
        process = {"back_off": {"first_s": 0.05}, "restarts": {"limit": 10_000}, "health_timeout_s": 60, **keys}
        return launch_file(
            node,
            source={"modules": [ticker], **process},
            middle={"modules": [doubler], **process},
            sink={"modules": [writer], **process},
        )

    return chain


def test_a_node_starts_consumers_first_and_stops_producers_first(start, chain, tmp_path):
    node = start("launch", chain()).up()
    node.wait_until(lambda: len(versions(tmp_path / "node-writer")) > 10)
    assert node.stop() == 0
    running = [event["process"] for event in node.find("state", state="running")]
    assert running == ["sink", "middle", "source"]
    assert [event["process"] for event in node.find("exited")] == ["source", "middle", "sink"]
    # What was committed before the stop has gone through all of them.
    assert versions(tmp_path / "node-writer") == versions(tmp_path / "node-ticker")
    assert node.find("ended")[0]["reason"] == "SIGTERM"
    assert node.children() == []
    assert not (tmp_path / "run" / "node" / "control.sock").exists()
    assert list((tmp_path / "run" / "node" / "links").iterdir()) == []


def test_nothing_starts_if_one_process_cannot_be_built(start, module, launch_file, tmp_path):
    good = module(PLAIN, "good", config=f"{{path: {tmp_path / 'notes'}}}")
    bad = module(PLAIN, "bad", config="{unknown_argument: 1}")
    node = start("launch", launch_file(one=[good], two=[bad]))
    assert node.wait() == 2
    assert "bad.yaml:3: components.0.config: " in node.find("ended")[0]["reason"]
    assert not node.find("state", state="running")
    assert not (tmp_path / "notes").exists()


def kill_in_turn(node, chain_folder, times):
    """Kills each process of the chain so often in turn, and looks at what must hold after each time."""
    supervisor = psutil.Process(node.supervisor.pid)

    def look():
        return supervisor.num_fds(), supervisor.num_threads()

    before = look()
    for round_number in range(1, times + 1):
        for name in ("source", "middle", "sink"):
            seen = len(versions(chain_folder / "node-writer"))
            node.wait_until(lambda seen=seen: len(versions(chain_folder / "node-writer")) > seen + 3)
            os.kill(node.process(name)["pid"], signal.SIGKILL)
            died = node.wait_for("died", round_number, process=name, cause="signal 9")
            assert died["reason"] == "was ended by SIGKILL"
            node.wait_for("state", round_number + 1, process=name, state="running")
        # A connection may still be closing, a process just starting: what is left in the end counts.
        node.wait_until(lambda: look() <= before)
        assert [one for one in supervisor.children() if one.status() == psutil.STATUS_ZOMBIE] == []
        assert len(supervisor.children(recursive=True)) == 3


@pytest.mark.parametrize("times", [1, pytest.param(100, marks=pytest.mark.campaign)])
def test_each_process_killed_in_turn_under_load_is_back_and_leaks_nothing(start, chain, tmp_path, times):
    node = start("launch", chain(period=10, size=100_000)).up()
    kill_in_turn(node, tmp_path, times)
    assert {process["restarts"] for process in node.ask("ps")["processes"]} == {times}
    assert node.stop() == 0
    sent, doubled, recorded = (versions(tmp_path / f"node-{name}") for name in ("ticker", "doubler", "writer"))
    # Nothing comes twice, and nothing that was not put in: a kill may come between a commit and its note, once each.
    assert len(doubled) == len(set(doubled))
    assert len(recorded) == len(set(recorded))
    assert len(set(doubled) - set(sent)) <= times
    assert len(set(recorded) - set(doubled)) <= times
    assert list((tmp_path / "run" / "node" / "links").iterdir()) == []
    assert node.children() == []


RECORDER = """\
module: {name}
components:
  - name: {name}
    kind: generic
    class: warploom.components.node.recorder.TopicRecorder
    config: {{path: {path}, when_full: block}}
    inputs: {{any: {sent}}}
"""


REPORTS = """\
module: {name}
components:
  - name: {name}
    kind: data
    class: warploom.components.node.statistics.StatisticsReporter
    trigger: {{period_ms: 50}}
    outputs: {{report: reports}}
"""


def test_a_process_that_only_records_knows_the_messages_of_others(start, module, launch_file, tmp_path):
    recorder = module(RECORDER, "recorder", sent="reports", path=tmp_path / "run.mcap")
    node = start("launch", launch_file(source=[module(REPORTS, "reports")], sink=[recorder])).up()
    node.wait_until(lambda: node.process("sink")["components"][0]["state"].get("commits", 0) > 5)
    assert not node.process("sink")["losses"]
    assert node.stop() == 0
    import_module("warploom.components.node.statistics")  # who reads the recording here must know them, too
    (path,) = tmp_path.glob("run-*.mcap")
    values = [event.value for event in Recording(path) if event.kind is EventKind.COMMIT]
    assert {type(value).__name__ for value in values} == {"TopicsReport"}


@pytest.fixture
def recorded_node(start, module, launch_file, tmp_path):
    """A node of a producer and a recorder, what the producer has noted, and the events in all recordings."""

    def recorded_node(period, **head):
        ticker = module(TICKER, "ticker", topic="ticks", journal=tmp_path / "sent", period=period)
        recorder = module(RECORDER, "recorder", sent="ticks", path=tmp_path / "run.mcap")
        keys = {"back_off": {"first_s": 0.05}}
        file = launch_file(
            source={"modules": [ticker], **keys}, sink={"modules": [recorder], **keys}, _head=head or None
        )
        return start("launch", file).up()

    def sent():
        return versions(tmp_path / "sent")

    def events():
        return [event for path in sorted(tmp_path.glob("run-*.mcap")) for event in Recording(path)]

    return recorded_node, sent, events


def commits(events):
    return {event.version for event in events if event.kind is EventKind.COMMIT}


def test_what_was_committed_before_a_kill_is_in_the_recording_or_within_a_gap_that_it_tells(recorded_node, tmp_path):
    launch, sent, events = recorded_node
    node = launch(period=5)
    # The producer dies: what it has committed is recorded to the last, by the process beside it.
    for number in (2, 3):
        count = len(sent())
        node.wait_until(lambda count=count: len(sent()) > count + 20)
        os.kill(node.process("source")["pid"], signal.SIGKILL)
        node.wait_for("died", number - 1, process="source")
        before = sent()
        node.wait_until(lambda before=before: set(before) <= commits(events()))
        node.wait_for("state", number, process="source", state="running")
    # The recorder dies: what it had not yet written and what came until it was back is a gap, of which it tells.
    count = len(sent())
    node.wait_until(lambda: len(sent()) > count + 20)
    os.kill(node.process("sink")["pid"], signal.SIGKILL)
    node.wait_for("state", 2, process="sink", state="running")
    count = len(commits(events()))
    node.wait_until(lambda: len(commits(events())) > count + 20)
    node.wait_until(lambda: node.process("sink")["components"][0]["state"].get("gaps") == 1)
    assert node.stop() == 0
    found = events()
    files = sorted(tmp_path.glob("run-*.mcap"), key=lambda path: path.stat().st_mtime)
    assert len(files) == 2
    gaps = [event.value for event in found if event.topic == GAPS]
    assert [(topic, name) for topic, _, _, _, name in gaps] == [("ticks", files[0].name)]
    _, _, after, until, _ = gaps[0]
    assert {after, until} <= commits(found)
    missing = set(sent()) - commits(found)
    assert all(after < version < until for version in missing)
    last = Recording(files[-1])
    assert last.metadata["continues"] == files[0].name
    assert last.closed, "flushed and closed by the stop"
    assert list(last)
    assert last.broken is None


def test_nothing_is_missing_where_the_producer_keeps_what_is_committed_until_the_recorder_is_back(recorded_node):
    launch, sent, events = recorded_node
    node = launch(period=1000, shared_memory={"history": 32})  # half a minute
    for number in (2, 3):
        count = len(commits(events()))
        node.wait_until(lambda count=count: len(commits(events())) > count)
        os.kill(node.process("sink")["pid"], signal.SIGKILL)
        node.wait_for("state", number, process="sink", state="running")
    count = len(commits(events()))
    node.wait_until(lambda: len(commits(events())) > count)
    assert node.stop() == 0
    found = events()
    assert commits(found) == set(sent())
    assert not [event for event in found if event.topic == GAPS]


def test_a_component_that_hangs_costs_its_process_and_is_counted(start, module, launch_file):
    ticker = module(TICKER, "ticker", topic="ticks", hang_after=5)
    keys = {"health_timeout_s": 0.5, "back_off": {"first_s": 0.05}, "restarts": {"limit": 1}}
    node = start("launch", launch_file(source={"modules": [ticker], **keys}))
    assert "hangs: ticker.process at version" in node.wait_for("hangs", process="source")["reason"]
    died = node.wait_for("died", process="source")
    assert died["cause"] == "hung"
    # The stacks of its threads are in its log: the line that hangs is among them.
    log = Path(node.environment["WARPLOOM_RUN"], "node", "log", "source.log").read_text()
    assert "launch_parts.py" in log
    assert "in process" in log
    assert node.wait() == 1
    assert "1 restarts within 60 s did not help" in node.find("state", state="gave up")[0]["reason"]


@pytest.mark.parametrize("how", ["stopped", "holding the interpreter"])
def test_a_process_without_a_sign_of_life_is_killed(start, module, launch_file, how):
    config = "{dies: holding the interpreter}" if how != "stopped" else "{}"
    plain = module(PLAIN, "plain", config=config)
    node = start("launch", launch_file(one={"modules": [plain], "health_timeout_s": 0.6, "restarts": {"limit": 1}}))
    node.wait_for("state", state="running")
    if how == "stopped":
        os.kill(node.up().process("one")["pid"], signal.SIGSTOP)
    died = node.wait_for("died", process="one")
    assert died["cause"] == "hung"
    assert "gave no sign of life for 0.6 s; was ended by SIGKILL" in died["reason"]
    node.wait_for("state", 2, state="running")


@pytest.mark.parametrize("native", ["daemon in native code", "thread in native code", "library that waits as it ends"])
def test_what_is_in_native_code_does_not_keep_a_process_from_its_end(start, module, launch_file, tmp_path, native):
    ticker = module(TICKER, "ticker", topic="ticks", journal=tmp_path / "sent", period=5)
    recorder = module(RECORDER, "recorder", sent="ticks", path=tmp_path / "run.mcap")
    stuck = module(PLAIN, "stuck", config=f"{{dies: {native}, path: '{tmp_path / 'noted'}'}}")
    node = start("launch", launch_file(one=[ticker, recorder, stuck])).up()
    node.wait_until(lambda: len(versions(tmp_path / "sent")) > 20)
    assert node.stop() == 0
    assert node.find("exited", process="one", code=0)
    assert not node.find("died")
    assert [line.split()[0] for line in (tmp_path / "noted").read_text().splitlines()] == ["start", "stop"]
    (path,) = tmp_path.glob("run-*.mcap")
    recording = Recording(path)
    assert commits(recording) == set(versions(tmp_path / "sent"))
    assert recording.closed


def test_a_stop_while_it_builds_ends_it_at_once(start, module, launch_file):
    stubborn = module(PLAIN, "stubborn", config="{dies: stubborn build}")
    node = start("launch", launch_file(one=[stubborn]))
    node.wait_for("state", state="building")
    time.sleep(1.0)  # into the build itself; whatever of it was reached, the end is the same
    begin = time.monotonic()
    assert node.stop() == 0
    assert time.monotonic() - begin < 30  # the build takes 60 s
    assert not node.find("state", state="running")


def test_the_children_end_with_a_killed_supervisor_and_the_next_one_reaps(start, chain, tmp_path):
    group = f"warploom-test-node-{os.getpid()}/app"
    node = start("launch", chain(cgroup=group)).up()
    node.wait_until(lambda: len(versions(tmp_path / "node-writer")) > 5)
    os.kill(node.process("source")["pid"], signal.SIGKILL)  # leaves its socket behind
    os.kill(node.supervisor.pid, signal.SIGKILL)
    node.supervisor.wait()
    node.wait_until(lambda: not node.children())
    left = sorted(path.name for path in (tmp_path / "run" / "node" / "links").iterdir())
    assert "ticks.socket" in left
    ledger = tmp_path / "run" / "node" / "cgroups"
    groups = ledger.read_text().split() if ledger.exists() else []  # there are none where they are not permitted
    again = start("launch", chain(cgroup=group)).up()
    removed = again.find("reaped")[0]["removed"]
    assert "ticks.socket" in [Path(path).name for path in removed]
    assert set(groups) <= set(removed)
    count = len(versions(tmp_path / "node-writer"))
    again.wait_until(lambda: len(versions(tmp_path / "node-writer")) > count + 5)
    assert again.stop() == 0
    assert not any(Path(path).exists() for path in (*groups, ledger))


def test_two_nodes_run_side_by_side_and_one_of_a_name_alone(start, chain, tmp_path):
    one, two = start("launch", chain("one")), start("launch", chain("two"))
    for node, name in ((one, "one"), (two, "two")):
        node.up()
        node.wait_until(lambda name=name: len(versions(tmp_path / f"{name}-writer")) > 5)
    third = start("launch", tmp_path / "one.launch.yaml")
    assert third.wait() == 2
    assert f"node 'one' runs already (process {one.supervisor.pid})" in third.errors
    assert (one.stop(), two.stop()) == (0, 0)
    assert set(versions(tmp_path / "one-writer")).isdisjoint(versions(tmp_path / "two-writer"))


def test_what_counts_from_one_again_after_a_kill_begins_a_new_epoch(start, module, launch_file, tmp_path):
    """The only producer of the node: nothing of the node exports anything while it is away."""
    ticker = TICKER.replace("config: {{", "config: {{counts: true, ")
    assert ticker != TICKER
    node = start(
        "launch",
        launch_file(
            source={"modules": [module(ticker, "ticker", topic="ticks", period=10)], "back_off": {"first_s": 0.05}},
            sink=[module(DOUBLER, "doubler", sent="ticks", topic="doubled", journal=tmp_path / "journal")],
        ),
    ).up()
    node.wait_until(lambda: len(versions(tmp_path / "journal")) > 100)
    os.kill(node.process("source")["pid"], signal.SIGKILL)
    node.wait_until(lambda: min(versions(tmp_path / "journal")[60:]) < 60)  # it has not waited for what comes after 100
    assert node.process("sink")["losses"].get("doubled", {}) == {}
    assert node.stop() == 0


def test_processes_of_a_node_share_one_endpoint_for_other_hosts(start, module, launch_file, tmp_path):
    """Both topics reach a node that knows that endpoint alone, also after whoever listens there was killed."""
    pytest.importorskip("zenoh")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    near = launch_file(
        "near",
        {"remote": dict.fromkeys(("ticks", "tocks"), "zenoh"),
         "zenoh": {"scouting": False, "domain": "car", "listen": [endpoint]}},
        first={"modules": [module(TICKER, "first", topic="ticks")], "back_off": {"first_s": 0.05}},
        second=[module(TICKER, "second", topic="tocks")],
    )  # fmt: skip
    journals = [tmp_path / "doubled-ticks", tmp_path / "doubled-tocks"]
    far = launch_file(
        "far",
        {"remote": dict.fromkeys(("ticks", "tocks"), "zenoh"),
         "zenoh": {"scouting": False, "domain": "car", "connect": [endpoint]}},
        third=[module(DOUBLER, "third", sent="ticks", topic="a", journal=journals[0])],
        fourth=[module(DOUBLER, "fourth", sent="tocks", topic="b", journal=journals[1])],
    )  # fmt: skip
    one, two = start("launch", near).up(), start("launch", far).up()
    two.wait_until(lambda: all(len(versions(path)) > 5 for path in journals))
    os.kill(one.process("first")["pid"], signal.SIGKILL)
    seen = [len(versions(path)) for path in journals]
    two.wait_until(lambda: all(len(versions(path)) > count + 5 for path, count in zip(journals, seen, strict=True)))
    assert one.find("died")
    assert one.process("second")["restarts"] == 0
    assert (one.stop(), two.stop()) == (0, 0)


def test_a_queue_that_fills_drops_what_it_must_and_counts_it(start, module, launch_file):
    ticker = module(TICKER, "ticker", topic="ticks", period=2)
    slow = module(DOUBLER, "slow", sent="ticks", topic="doubled", slow_s=0.1)
    node = start("launch", launch_file(source=[ticker], sink=[slow])).up()
    losses = node.wait_until(lambda: node.process("sink")["losses"].get("slow", {}).get("backlog"))
    assert losses > 0

    def rate_of_ticks():
        return next(one for one in node.ask("topics")["topics"] if one["topic"] == "ticks")["rate_hz"]

    assert node.wait_until(lambda: rate_of_ticks() > 50)  # the producer does not wait
    assert node.stop() == 0


def test_a_process_is_what_the_launch_file_says_and_no_more(start, module, launch_file, tmp_path):
    plain = module(PLAIN, "plain", config=f"{{path: {tmp_path / 'notes'}}}")
    cgroup = f"warploom-test-{os.getpid()}/one"
    keys = {
        "cpus": [0],
        "nice": 7,
        "environment": {"WARPLOOM_TEST": 5},
        "process_name": "compute3d_scheduler",
        "cgroup": cgroup,
    }
    other = {"modules": [module(PLAIN, "other")], "cpus": [1000], "nice": -20}
    node = start("launch", launch_file(one={"modules": [plain], **keys}, two=other)).up()
    pid = node.process("one")["pid"]
    child = psutil.Process(pid)
    assert child.cpu_affinity() == [0]
    assert child.nice() == 7
    assert child.environ()["WARPLOOM_TEST"] == "5"
    assert Path(f"/proc/{pid}/comm").read_text().strip() == "compute3d_sched"  # 15 bytes, as the system has it
    joined = cgroup in Path(f"/proc/{pid}/cgroup").read_text()
    warned = any(f"cgroup {cgroup}" in event["message"] for event in node.find("warning"))
    assert joined != warned
    # What is not permitted, or not there, is a warning; the process runs.
    assert any("cpus [1000]: " in message for message in node.process("two")["warnings"])
    # A process without perception does not load what perception needs.
    maps = Path(f"/proc/{pid}/maps").read_text()
    assert not [library for library in ("warp", "onnxruntime", "cv2", "torch") if f"/{library}/" in maps]
    node.ask("restart", process="one")
    node.wait_for("state", 2, process="one", state="running")
    assert node.process("one")["deaths"] == {"restarted": 1}
    node.signal(signal.SIGINT)
    assert node.wait() == 0
    notes = [line.split()[0] for line in (tmp_path / "notes").read_text().splitlines()]
    assert notes == ["start", "stop", "start", "stop"]
    assert not any(Path("/sys/fs/cgroup").glob(f"**/{Path(cgroup).parent}"))
