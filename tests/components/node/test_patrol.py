"""The patrol: what it finds not well in what the supervisor says, and what it does where nobody answers."""

import os

import pytest

from warploom.components.node import patrol
from warploom.components.node.patrol import ProcessPatrol, ProcessPatrolConfig, alarms_of, node_of, seen_in
from warploom.dag import Trigger
from warploom.datamesh import DataMesh, Status
from warploom.errors import WarploomError


def said(name="a", **more):
    one = {"name": name, "state": "running", "pid": 7, "restarts": 0, "silent_s": 0.2, "rss": 100 << 20, **more}
    return {"processes": [one]}


def alarms(now, before=None, **config):
    return alarms_of(seen_in(now), seen_in(before) if before else (), ProcessPatrolConfig(**config))


def test_a_process_that_runs_gives_no_alarm():
    assert alarms(said(), said()) == ()


@pytest.mark.parametrize(
    ("now", "before", "config", "alarm"),
    [
        (said(pid=None, state="gave up", rss=0), None, {}, "a does not run: gave up"),
        (said(restarts=2), said(restarts=1), {}, "a was started again, 2 times so far"),
        (said(silent_s=7.25), None, {"silent_s": 5}, "a gave no sign of life for 7.2 s"),
        (said(), None, {"resident_mib": 99}, "a has 100 MiB, more than 99"),
    ],
)
def test_what_is_not_well_is_said(now, before, config, alarm):
    assert alarms(now, before, **config) == (alarm,)


def test_restarts_before_the_first_look_are_no_alarm():
    assert alarms(said(restarts=4)) == ()


def test_a_process_without_figures_is_seen_all_the_same():
    (seen,) = seen_in({"processes": [{"name": "a", "state": "waiting", "silent_s": None, "pid": None}]})
    assert seen.pid == -1
    assert seen.silent_s != seen.silent_s


class Supervisor:
    """Answers as a supervisor does, until it ends."""

    def __init__(self, *answers):
        self.answers = list(answers)
        self.closed = 0

    def ask(self, request):
        assert request == "ps"
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def close(self):
        self.closed += 1

    __enter__ = lambda self: self  # noqa: E731
    __exit__ = lambda self, *_: None  # noqa: E731


def patrolling():
    one = ProcessPatrol("patrol")
    mesh = DataMesh()
    one.bind(mesh, {"report": "r"})
    one.init(ProcessPatrolConfig())
    return one, mesh


def test_it_finds_its_node_by_its_own_process_and_reports(monkeypatch, caplog):
    supervisor = Supervisor(said(), said(restarts=1), said(restarts=1), WarploomError("the supervisor has ended"))
    monkeypatch.setattr(patrol, "node_of", lambda pid: "the_node" if pid == os.getpid() else None)
    monkeypatch.setattr(patrol, "connect", lambda node: (node, supervisor))
    one, mesh = patrolling()
    assert [one.process(Trigger(k)) for k in (1, 2, 3)] == [Status.OK] * 3
    reports = [mesh.window("r").snapshot()[k] for k in range(3)]
    assert [report.alarms for report in reports] == [(), ("a was started again, 1 times so far",), ()]
    assert reports[0].node == "the_node"
    assert caplog.text.count("started again") == 1
    assert one.idle_because is None
    assert one.state() == {"processes": 1, "alarms": "none"}
    assert one.process(Trigger(4)) is Status.MISS
    assert one.idle_because == "the supervisor has ended"
    assert supervisor.closed == 1


def test_a_process_that_no_supervisor_started_has_nobody_to_watch(monkeypatch, tmp_path):
    monkeypatch.setenv("WARPLOOM_RUN", str(tmp_path))
    assert node_of(os.getpid()) is None
    one, _ = patrolling()
    assert one.process(Trigger(1)) is Status.MISS
    assert one.idle_because == "no supervisor started this process, so there are no others to watch"


def test_nodes_that_do_not_answer_are_passed_over(monkeypatch):
    monkeypatch.setattr(patrol, "running_nodes", lambda: ["dead", "other", "mine"])

    def client(path):
        if "dead" in str(path):
            raise WarploomError("no answer")
        return Supervisor(said(pid=os.getpid() if "mine" in str(path) else 1))

    monkeypatch.setattr(patrol, "ControlClient", client)
    assert node_of(os.getpid()) == "mine"
