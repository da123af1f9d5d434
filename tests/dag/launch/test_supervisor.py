"""The supervisor of a node, in this process, with children that speak the protocol and start at once."""

import os
import signal
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest
import yaml

from warploom.dag.launch.control import ControlClient, connect
from warploom.dag.launch.linking import LinkPlan
from warploom.dag.launch.lookup import load_launch_file
from warploom.dag.launch.plan import LaunchPlan
from warploom.dag.launch.run_folder import running_nodes
from warploom.dag.launch.supervisor import Supervisor
from warploom.errors import ConfigError, WarploomError

CHILD = Path(__file__).parent / "parts" / "tiny_child.py"


class Run:
    """A node that ran from its start to its end."""

    def __init__(self, folder, behaviours, links=None, reap=lambda node, orders: [], **keys):
        path = folder / "node.launch.yaml"
        processes = [
            {"name": name, "modules": ["m"], "back_off": {"first_s": 0.01}, **keys.get(name, {})} for name in behaviours
        ]
        path.write_text(yaml.safe_dump({"node": "node", "processes": processes}))
        plan = LaunchPlan(load_launch_file(path), dict.fromkeys(behaviours, ()))
        self.events = []
        self._changed = threading.Condition()
        self.supervisor = Supervisor(
            plan,
            links or {name: LinkPlan() for name in behaviours},
            lambda spec, folder: [sys.executable, "-I", "-S", str(CHILD), behaviours[spec.name]],
            reap=reap,
            on_event=self._on_event,
        )
        self.failure = None
        self.code = None

    def _on_event(self, event):
        with self._changed:
            self.events.append(event)
            self._changed.notify_all()

    def find(self, event, **details):
        return [one for one in list(self.events) if {"event": event, **details}.items() <= one.items()]

    def wait_for(self, event, count=1, **details):
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.find(event, **details)) >= count, 20), self.events
        return self.find(event, **details)[count - 1]

    def ask(self, request, **arguments):
        with ControlClient(self.supervisor.folder.control) as client:
            return client.ask(request, **arguments)

    def through(self, scenario=None):
        """Runs it; the scenario runs beside it in a thread, and asks it to stop in the end."""

        def drive():
            try:
                scenario(self)
            except BaseException as error:
                self.failure = error
            finally:
                for _ in range(2 if self.failure else 1):
                    os.kill(os.getpid(), signal.SIGTERM)

        thread = threading.Thread(target=drive)
        if scenario is not None:
            thread.start()
        self.code = self.supervisor.run()
        if scenario is not None:
            thread.join()
        if self.failure is not None:
            raise self.failure
        return self


@pytest.fixture
def run(tmp_path, run_base):
    before = signal.getsignal(signal.SIGTERM)
    # What comes after the end of a run must not end the tests.
    signal.signal(signal.SIGTERM, lambda *_: None)
    descriptors = len(os.listdir("/proc/self/fd"))
    # Other tests of this run may have begun what outlives them, such as the resource tracker of multiprocessing.
    children_before = set(psutil.Process().children())
    yield lambda behaviours, **keys: Run(tmp_path, behaviours, **keys)
    signal.signal(signal.SIGTERM, before)
    assert not set(psutil.Process().children()) - children_before, "processes are left"
    assert len(os.listdir("/proc/self/fd")) <= descriptors, "descriptors are left"


def states(one, name):
    return [event["state"] for event in one.find("state", process=name)]


def test_all_are_ready_before_the_first_starts_and_consumers_start_first(run):
    links = {
        "a": LinkPlan(exports=("x",)),
        "b": LinkPlan(exports=("y",), imports=("x",)),
        "c": LinkPlan(imports=("y",)),
    }
    one = run({"a": "good", "b": "good", "c": "good"}, links=links).through(lambda node: node.wait_for("up"))
    assert one.code == 0
    order = [(event["state"], event["process"]) for event in one.find("state")]
    running = [name for state, name in order if state == "running"]
    assert running == ["c", "b", "a"]
    assert max(order.index(("ready", name)) for name in "abc") < order.index(("running", "c"))
    assert [event["process"] for event in one.find("exited")] == ["a", "b", "c"]
    assert one.find("ended")[0]["reason"] == "SIGTERM"


def test_none_starts_if_one_cannot_be_built(run):
    one = run({"a": "good", "b": "refuses"}).through()
    assert one.code == 2
    assert one.find("ended")[0]["reason"] == "b: x.yaml:3: components.0: wrong"
    assert "running" not in states(one, "a")
    assert states(one, "a")[-1] == "stopped"


def test_one_that_crashes_once_while_others_wait_is_no_reason_not_to_start(run, tmp_path):
    one = run({"a": "good", "b": f"crashes once {tmp_path / 'mark'}"}).through(lambda node: node.wait_for("up"))
    assert one.code == 0
    assert states(one, "a")[:3] == states(one, "b")[2:5] == ["building", "ready", "running"]


def test_what_is_given_up_ends_the_node_and_says_why(run):
    one = run({"a": "good", "b": "dies at once"}, b={"restarts": {"limit": 2}}).through()
    assert one.code == 1
    reason = one.find("ended")[0]["reason"]
    assert reason == "b: 2 restarts within 60 s did not help; the last time it was ended by SIGKILL"
    assert states(one, "a")[-1] == "stopped"
    assert not one.find("up")


@pytest.mark.parametrize(("behaviour", "code"), [("ends", 0), ("dies at once", 1)])
def test_the_end_of_one_ends_the_node_where_it_says_exit(run, behaviour, code):
    one = run({"a": "good", "b": behaviour}, b={"exception_handler": "exit"}).through()
    assert one.code == code
    assert one.find("ended")[0]["reason"].startswith("b ")
    assert states(one, "a")[-1] == "stopped"


def test_the_others_go_on_where_it_says_ignore(run):
    def scenario(node):
        node.wait_for("state", process="b", state="ended")
        node.wait_for("up")
        states = {process["name"]: process["state"] for process in node.ask("ps")["processes"]}
        assert states == {"a": "running", "b": "ended"}

    one = run({"a": "good", "b": "dies at once"}, b={"exception_handler": "ignore"}).through(scenario)
    assert one.code == 0


def test_a_node_of_which_nothing_is_left_ends(run):
    one = run({"a": "dies at once"}, a={"exception_handler": "ignore"}).through()
    assert (one.code, one.find("ended")[0]["reason"]) == (1, "no process is left")


def test_a_second_signal_leaves_all_at_once_the_time_to_flush(run, tmp_path):
    def scenario(node):
        node.wait_for("up")
        os.kill(os.getpid(), signal.SIGINT)
        node.wait_for("state", state="stopping")
        os.kill(os.getpid(), signal.SIGHUP)  # no haste

    marks = {name: tmp_path / name for name in "ab"}
    # Both are told to stop before the first of them has: in order, b would only be told after a has ended.
    links = {"a": LinkPlan(exports=("x",)), "b": LinkPlan(imports=("x",))}
    behaviours = {name: f"flushes for half a second {mark}" for name, mark in marks.items()}
    one = run(behaviours, links=links).through(scenario)
    assert one.code == 0
    assert all(mark.exists() for mark in marks.values())
    assert [event["code"] for event in one.find("exited")] == [0, 0]
    assert [(event["reason"], event["seconds"]) for event in one.find("hurried")] == [("SIGTERM", 2.0)]
    told = [event["event"] if event["event"] == "exited" else event.get("state") for event in one.events]
    assert told.index("exited") > len(told) - 1 - told[::-1].index("stopping")


def test_after_a_second_signal_what_does_not_stop_is_killed(run):
    def scenario(node):
        node.wait_for("up")
        os.kill(os.getpid(), signal.SIGINT)
        node.wait_for("state", state="stopping")

    one = run({"a": "does not stop"}, a={"stop_timeout_s": 50.0}).through(scenario)
    assert one.code == 0
    assert one.find("died")[0]["reason"] == "did not stop within 2 s; was ended by SIGKILL"


def test_a_third_signal_kills_at_once(run, monkeypatch):
    monkeypatch.setattr("warploom.dag.launch.supervisor.HURRY_S", 50.0)

    def scenario(node):
        node.wait_for("up")
        os.kill(os.getpid(), signal.SIGINT)
        node.wait_for("state", state="stopping")
        os.kill(os.getpid(), signal.SIGINT)
        node.wait_for("hurried")

    one = run({"a": "does not stop"}, a={"stop_timeout_s": 50.0}).through(scenario)
    assert one.code == 0
    assert one.find("died")[0]["reason"] == "was ended by SIGKILL"
    assert [event["seconds"] for event in one.find("hurried")] == [50.0, 0.0]


def test_a_signal_after_the_end_does_what_it_did_before(run):
    came = []
    before = signal.signal(signal.SIGTERM, lambda number, _: came.append(number))
    try:
        run({"a": "ends"}, a={"exception_handler": "exit"}).through()
        os.kill(os.getpid(), signal.SIGTERM)
        assert came == [signal.SIGTERM]
        assert signal.set_wakeup_fd(-1) == -1
    finally:
        signal.signal(signal.SIGTERM, before)


def test_what_dead_processes_left_is_removed_before_and_after_and_between(run):
    calls = []

    def reap(node, orders):
        calls.append((node, orders))
        return ["left"] if len(calls) == 1 else []

    def scenario(node):
        node.wait_for("up")
        os.kill(node.ask("ps")["processes"][0]["pid"], signal.SIGKILL)
        node.wait_for("state", 2, state="running")

    one = run({"a": "good"}, reap=reap).through(scenario)
    # What says how far a producer was stays, while the node does, for when it comes back.
    assert calls == [("node", True), ("node", False), ("node", True)]
    assert one.find("reaped")[0]["removed"] == ["left"]


def test_the_control_plane_answers_and_refuses(run):
    def scenario(node):
        node.wait_for("up")
        assert running_nodes() == ["node"]
        name, client = connect()
        assert name == "node"
        with client:
            status = client.ask("ps")
            assert status["supervisor"]["pid"] == os.getpid()
            process = status["processes"][0]
            assert process["state"] == "running"
            assert process["rss"] > 1e6
            assert process["components"][0]["name"] == "part"
            topic = client.ask("topics")["topics"][0]["topic"]
            assert client.ask("export", topic=topic) == {"process": "a", "topic": topic}
            with pytest.raises(WarploomError, match="nobody commits topic 'none'; known: topic of"):
                client.ask("export", topic="none")
            with pytest.raises(WarploomError, match="no process 'b'; known: a"):
                client.ask("restart", process="b")
            with pytest.raises(WarploomError, match="no request 'pss'; did you mean 'ps'"):
                client.ask("pss")
        with pytest.raises(ConfigError, match="node 'other' does not run; known: node"):
            connect("other")

    assert run({"a": "good"}).through(scenario).code == 0
    with pytest.raises(ConfigError, match="no node runs"):
        connect()


def test_a_node_stops_when_asked_over_its_socket(run):
    def scenario(node):
        node.wait_for("up")
        node.ask("stop")
        node.wait_for("ended")

    assert run({"a": "good"}).through(scenario).find("ended")[0]["reason"] == "asked to stop"


def test_a_second_supervisor_of_the_node_is_refused(run):
    def scenario(node):
        node.wait_for("up")
        other = run({"a": "good"})
        with pytest.raises(ConfigError, match=rf"node 'node' runs already \(process {os.getpid()}\)"):
            other.supervisor.run()
        assert node.ask("ps")["processes"][0]["state"] == "running"

    assert run({"a": "good"}).through(scenario).code == 0


def test_who_watches_is_told_of_everything(run):
    seen = []

    def scenario(node):
        node.wait_for("up")
        import json
        import socket

        with socket.socket(socket.AF_UNIX) as one:
            one.connect(str(node.supervisor.folder.control))
            one.sendall(b'{"request": "watch"}\n')
            lines = one.makefile("rb")
            assert json.loads(lines.readline())["ok"]
            os.kill(node.ask("ps")["processes"][0]["pid"], signal.SIGKILL)
            while not seen or seen[-1].get("state") != "running":
                seen.append(json.loads(lines.readline()))

    run({"a": "good"}).through(scenario)
    assert [event["event"] for event in seen][:2] == ["died", "state"]


def test_a_supervision_that_fails_itself_ends_the_node(run, monkeypatch):
    from warploom.dag.launch.supervised import SupervisedProcess

    async def fails(self, life, report):
        raise RuntimeError("our own mistake")

    monkeypatch.setattr(SupervisedProcess, "_take_report", fails)
    one = run({"a": "good"})
    code = one.through().code
    assert code == 1
    assert "its supervision failed: RuntimeError: our own mistake" in one.find("ended")[0]["reason"]


def test_what_cannot_be_shown_does_not_stop_the_supervision(run):
    def fails(event):
        raise ValueError("closing tag does not match")

    def scenario(node):
        node.wait_for("up")
        shown, node.supervisor._on_event = node.supervisor._on_event, fails
        os.kill(node.ask("ps")["processes"][0]["pid"], signal.SIGKILL)
        while (again := node.ask("ps")["processes"][0])["restarts"] == 0 or again["state"] != "running":
            time.sleep(0.01)
        node.supervisor._on_event = shown

    assert run({"a": "good"}).through(scenario).code == 0


@pytest.mark.parametrize("handler", ["respawn", "exit", "ignore"])
def test_a_restart_that_is_asked_for_is_one_whatever_is_said_of_deaths(run, handler):
    def scenario(node):
        node.wait_for("up")
        for number in range(1, 4):
            node.ask("restart", process="a")
            node.wait_for("state", number + 1, process="a", state="running")
            if number == 1:
                assert not node.find("state", state="back off")
        process = node.ask("ps")["processes"][0]
        assert (process["deaths"], process["restarts"]) == ({"restarted": 3}, 3)

    keys = {"exception_handler": handler, "restarts": {"limit": 1}}
    assert run({"a": "good"}, a=keys).through(scenario).code == 0


def test_what_does_not_run_cannot_be_restarted(run):
    def scenario(node):
        node.wait_for("state", process="a", state="building")
        with pytest.raises(WarploomError, match="process 'a' is not running: it is building"):
            node.ask("restart", process="a")

    run({"a": "never ready"}).through(scenario)


def test_a_plan_that_was_tidied_away_is_there_again_for_the_next_life(run):
    def scenario(node):
        node.wait_for("up")
        plan = node.supervisor.folder.plan("a")
        text = plan.read_text()
        plan.unlink()
        os.kill(node.ask("ps")["processes"][0]["pid"], signal.SIGKILL)
        node.wait_for("state", 2, state="running")
        assert plan.read_text() == text

    assert run({"a": "good"}).through(scenario).code == 0
