"""The supervision of processes, with children that speak the protocol and start at once."""

import asyncio
import os
import signal
import sys
import time
from pathlib import Path

import psutil
import pytest

from warploom.dag.launch.cgroup import ControlGroups
from warploom.dag.launch.run_folder import RotatedLog
from warploom.dag.launch.schema import ProcessSpec
from warploom.dag.launch.supervised import State, SupervisedProcess

CHILD = Path(__file__).parent / "parts" / "tiny_child.py"
NO_GROUPS = ControlGroups(Path("/nonexistent"), "/")


class Watched:
    """A supervised tiny child, and what was told of it."""

    def __init__(self, folder, behaviour, **keys):
        spec = {"name": "one", "modules": ["m.yaml"], "back_off": {"first_s": 0.01}, **keys}
        self.events = []
        self.cleaned = 0
        self.process = SupervisedProcess(
            ProcessSpec.model_validate(spec),
            [sys.executable, "-I", "-S", str(CHILD), behaviour],
            RotatedLog(folder / "one.log"),
            groups=NO_GROUPS,
            on_event=self.events.append,
            before_start=self._clean,
        )

    def _clean(self):
        self.cleaned += 1

    def find(self, event, **details):
        return [one for one in self.events if {"event": event, **details}.items() <= one.items()]

    def states(self):
        return [event["state"] for event in self.find("state")]


@pytest.fixture
def watched(tmp_path):
    """Runs a scenario with a supervised tiny child in an event loop of its own."""

    def watched(scenario, behaviour="good", **keys):
        one = Watched(tmp_path, behaviour, **keys)

        async def run():
            async with asyncio.timeout(30):
                life = asyncio.create_task(one.process.live())
                try:
                    await scenario(one.process)
                    await life
                finally:
                    one.process.kill()
                    await asyncio.wait([life], timeout=5)

        asyncio.run(run())
        return one

    before = set(os.listdir("/proc/self/fd"))
    # Other tests of this run may have begun what outlives them, such as the resource tracker of multiprocessing.
    children_before = set(psutil.Process().children())
    yield watched
    assert not set(psutil.Process().children()) - children_before, "processes are left"
    assert set(os.listdir("/proc/self/fd")) <= before, "descriptors are left"


async def nothing(process):
    """The end of the process is the end of the scenario."""


async def run_and_stop(process):
    await process.wait_for(State.RUNNING)
    process.ask_to_stop()


def test_a_life_without_trouble(watched):
    one = watched(run_and_stop)
    assert one.states() == ["building", "ready", "running", "stopping", "stopped"]
    assert one.find("exited") == [{"event": "exited", "process": "one", "code": 0}]
    assert one.process.deaths == {}
    assert not one.find("died")


def test_what_refuses_its_configuration_is_not_started_again(watched):
    one = watched(nothing, "refuses")
    assert one.states() == ["building", "gave up"]
    assert one.process.refused == "x.yaml:3: components.0: wrong"
    assert one.process.deaths == {"configuration": 1}


def test_what_crashes_while_it_builds_backs_off_and_is_given_up(watched):
    keys = {"back_off": {"first_s": 0.01, "factor": 3, "max_s": 0.05}, "restarts": {"limit": 4}}
    one = watched(nothing, "crashes building", **keys)
    assert [event["seconds"] for event in one.find("state", state="back off")] == [0.01, 0.03, 0.05, 0.05]
    assert one.states()[-1] == "gave up"
    assert one.process.deaths == {"exit 3": 5}
    assert one.process.restarts.count == one.cleaned == 4
    assert one.find("died")[0]["last_lines"] == ["no such library"]


def test_what_dies_once_goes_on(watched, tmp_path):
    one = watched(run_and_stop, f"crashes once {tmp_path / 'mark'}")
    assert one.states() == ["building", "back off", "building", "ready", "running", "stopping", "stopped"]
    assert one.process.deaths == {"exit 4": 1}


@pytest.mark.parametrize(
    ("behaviour", "cause"), [("dies at once", "signal 9"), ("breaks", "exit 1"), ("ends", "exit 0")]
)
def test_every_end_that_nobody_asked_for_is_a_death(watched, behaviour, cause):
    one = watched(nothing, behaviour, restarts={"limit": 1})
    assert one.process.deaths == {cause: 2}
    assert one.states()[-1] == "gave up"
    if behaviour == "breaks":
        assert one.process.last_death == "ended with exit code 1; RuntimeError: no sensor"


def test_it_serves_once_all_its_parts_have_what_they_need(watched):
    async def scenario(process):
        await process.wait_for(State.RUNNING)
        while process.beat.get("starting"):
            await asyncio.sleep(0.01)
        process.ask_to_stop()

    one = watched(scenario, "warms up")
    served = [event["event"] for event in one.events].index("serving")
    running = one.events.index(one.find("state", state="running")[0])
    assert running < served
    assert one.find("serving")[0]["seconds"] >= 0.3
    assert len(one.find("serving")) == len(watched(run_and_stop).find("serving")) == 1


def test_who_listens_to_a_topic_hears_it_from_the_next_life_too(watched, tmp_path):
    notes = tmp_path / "notes"

    async def scenario(process):
        await process.wait_for(State.RUNNING)
        for topic in ("heard", "left"):
            assert await process.export(topic) == ""
        while not process.beat.get("links"):
            await asyncio.sleep(0.01)
        os.kill(process.pid, signal.SIGKILL)
        await process.wait_for(State.BACKING_OFF, State.BUILDING)
        assert not process.beat, "what the dead one said last is not told of the next"
        while len(notes.read_text().splitlines()) < 3:
            await asyncio.sleep(0.01)
        process.ask_to_stop()

    watched(scenario, f"listened to, notes {notes}")
    said = [line.split() for line in notes.read_text().splitlines()]
    assert [topic for _, topic in said] == ["heard", "left", "heard"]
    assert said[0][0] != said[2][0]


@pytest.mark.parametrize("handler", ["exit", "ignore"])
def test_other_handlers_start_nothing_again(watched, handler):
    one = watched(nothing, "dies at once", exception_handler=handler)
    assert one.states()[-1] == "ended"
    assert one.process.restarts.count == 0
    assert one.process.may_be_missing == (handler == "ignore")


def test_the_last_lines_are_told_and_all_are_in_the_log(watched, tmp_path):
    one = watched(nothing, "talks", exception_handler="ignore")
    assert one.find("died")[0]["last_lines"] == [*(f"line {n}" for n in range(191, 200)), "half a line"]
    assert "SIGSEGV" in one.find("died")[0]["reason"]
    assert (tmp_path / "one.log").read_text() == "".join(f"line {n}\n" for n in range(200)) + "half a line"


def test_what_says_that_a_part_hangs_is_ended(watched):
    one = watched(nothing, "hangs", exception_handler="ignore")
    assert one.process.deaths == {"hung": 1}
    assert one.process.last_death.startswith("hangs: part.process at version 7 for 9.0 s; was ended by ")


def test_on_a_machine_so_busy_that_the_supervisor_is_late_itself_nobody_hangs(watched):
    async def scenario(process):
        await process.wait_for(State.RUNNING)
        await asyncio.sleep(0.3)  # as long as it comes to run, its signs of life arrive
        os.kill(process.pid, signal.SIGSTOP)
        time.sleep(2.0)  # neither of them comes to run
        os.kill(process.pid, signal.SIGCONT)
        await asyncio.sleep(1.5)
        process.ask_to_stop()

    one = watched(scenario, "beats", health_timeout_s=1.0)
    assert one.process.deaths == {}
    assert not one.find("hangs")


def test_what_is_silent_gets_sigterm_then_sigkill(watched):
    one = watched(nothing, "silent", exception_handler="ignore", health_timeout_s=0.2)
    assert one.process.deaths == {"hung": 1}
    assert one.process.last_death == "gave no sign of life for 0.2 s; was ended by SIGKILL"


def test_without_a_health_timeout_silence_is_no_fault(watched):
    async def scenario(process):
        await process.wait_for(State.RUNNING)
        await asyncio.sleep(0.5)
        assert process.state is State.RUNNING
        process.ask_to_stop()

    assert watched(scenario, health_timeout_s=None).process.deaths == {}


@pytest.mark.parametrize("behaviour", ["never ready", "damaged"])
def test_what_is_not_ready_in_time_is_ended(watched, behaviour):
    one = watched(nothing, behaviour, exception_handler="ignore", start_timeout_s=0.3)
    assert "was not ready for 0.3 s; was ended by SIG" in one.process.last_death


def test_what_does_not_come_to_run_in_time_is_ended_too(watched):
    one = watched(nothing, "never starts", exception_handler="ignore", start_timeout_s=0.5)
    assert "did not start its components within 0.5 s; was ended by SIG" in one.process.last_death
    assert "ready" in one.states()


def test_what_does_not_stop_is_killed(watched):
    one = watched(run_and_stop, "does not stop", stop_timeout_s=0.2)
    assert one.states()[-1] == "stopped"
    assert one.process.deaths == {"hung": 1}


def test_a_stop_ends_a_back_off_at_once(watched):
    async def scenario(process):
        await process.wait_for(State.BACKING_OFF)
        process.ask_to_stop()

    one = watched(scenario, "crashes building", back_off={"first_s": 25.0})
    assert one.states()[-1] == "stopped"


def test_what_a_process_started_ends_with_it(watched):
    async def scenario(process):
        await process.wait_for(State.RUNNING)
        group = process.pid
        grandchildren = psutil.Process(group).children()
        assert len(grandchildren) == 1
        process.ask_to_stop()
        await process.wait_for()
        gone, _ = psutil.wait_procs(grandchildren, 5)
        assert gone or grandchildren[0].status() == psutil.STATUS_ZOMBIE

    watched(scenario, "leaves a grandchild")


def test_an_order_is_answered_or_times_out_or_is_refused(watched):
    async def answered(process):
        await process.wait_for(State.RUNNING)
        assert (await process.ask({"do": "export", "topic": "t"}))["ok"]
        process.ask_to_stop()
        await process.wait_for()
        with pytest.raises(ConnectionError, match="it is stopped"):
            await process.ask({"do": "export", "topic": "t"})

    async def deaf(process):
        await process.wait_for(State.RUNNING)
        with pytest.raises(TimeoutError):
            await process.ask({"do": "export", "topic": "t"}, timeout_s=0.1)
        process.ask_to_stop()

    async def dies(process):
        await process.wait_for(State.RUNNING)
        asked = asyncio.create_task(process.ask({"do": "export", "topic": "t"}))
        await asyncio.sleep(0.05)
        os.kill(process.pid, signal.SIGKILL)
        with pytest.raises(ConnectionError, match="ended"):
            await asked
        process.ask_to_stop()

    watched(answered)
    watched(deaf, "deaf")
    watched(dies, "deaf")


def test_what_cannot_be_executed_is_a_death_like_others(tmp_path):
    spec = ProcessSpec.model_validate(
        {"name": "one", "modules": ["m"], "restarts": {"limit": 1}, "back_off": {"first_s": 0.0}}
    )
    events = []
    process = SupervisedProcess(
        spec, ["/nonexistent/program"], RotatedLog(tmp_path / "log"), groups=NO_GROUPS, on_event=events.append
    )
    asyncio.run(process.live())
    assert process.state is State.GAVE_UP
    assert process.deaths == {"not started": 2}
    assert "No such file" in process.last_death


def test_a_restart_that_is_asked_for_is_told_as_one(watched):
    async def scenario(process):
        await process.wait_for(State.RUNNING)
        process.restart()
        await process.wait_for(State.BACKING_OFF, State.BUILDING)
        await process.wait_for(State.RUNNING)
        process.ask_to_stop()

    one = watched(scenario)
    assert one.process.deaths == {"restarted": 1}
    assert one.states()[-1] == "stopped"
