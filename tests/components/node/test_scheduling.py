"""Cores and niceness are set where that is permitted, and what is not is said."""

import os
import subprocess
import sys
import threading

import pytest

from warploom.components.node.scheduling import ProcessScheduling, SchedulingConfig
from warploom.dag import BacklogConfig, Trigger, TriggerConfig
from warploom.datamesh import DataMesh
from warploom.datamesh.clock import ManualClock

pytestmark = pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="only Linux pins processes")

# In a process of its own: affinity and niceness of the tests' own process stay.
CHILD = """
import os, threading, time
from warploom.components.node.scheduling import ProcessScheduling, SchedulingConfig
from warploom.dag import BacklogConfig, Trigger, TriggerConfig
from warploom.datamesh import DataMesh
from warploom.datamesh.clock import ManualClock

stop = threading.Event()
before = threading.Thread(target=stop.wait, name="worker-0", daemon=True)
before.start()
core = min(os.sched_getaffinity(0))
one = ProcessScheduling("sched")
one.bind(DataMesh(clock=ManualClock()), {})
one.init(SchedulingConfig(cpus=[core], nice=3, threads={"worker-*": 7, "*": 4}))
one.set_trigger(TriggerConfig(period_ms=1000), BacklogConfig(), "inline")
one.start()
after = threading.Thread(target=stop.wait, name="worker-1", daemon=True)
after.start()
one.process(Trigger(1))
def nice(thread):
    return os.getpriority(os.PRIO_PROCESS, thread.native_id)
print(sorted(os.sched_getaffinity(before.native_id)) == [core], sorted(os.sched_getaffinity(after.native_id)) == [core],
      nice(before), nice(after), nice(threading.main_thread()), one.idle_because, one.state()["refused"])
one.stop()
"""


def test_it_pins_the_process_and_puts_threads_in_their_order():
    done = subprocess.run([sys.executable, "-c", CHILD], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["True", "True", "7", "7", "4", "None", "nothing"]


def scheduling(monkeypatch=None, **config):
    one = ProcessScheduling("sched")
    one.bind(DataMesh(clock=ManualClock()), {})
    one.init(SchedulingConfig.model_validate(config))
    one.set_trigger(TriggerConfig(period_ms=1000), BacklogConfig(), "inline")
    return one


def test_what_is_not_permitted_is_said_once_and_shown(monkeypatch, caplog):
    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "setpriority", refuse)
    one = scheduling(nice=-5, threads={threading.current_thread().name: -10})
    one.start()
    for version in (1, 2):
        one._set.clear()
        one.process(Trigger(version))
    one.stop()
    name = threading.current_thread().name
    assert one.state()["refused"] == f"nice -5, {name} nice -10"
    assert len([record for record in caplog.records if "is not permitted here" in record.getMessage()]) == 2


def test_cores_that_there_are_not_are_refused_by_the_system_and_shown():
    before = os.sched_getaffinity(0)
    one = scheduling(cpus=[1000])
    one.start()
    one.stop()
    assert os.sched_getaffinity(0) == before
    assert one.state()["refused"] == "cpus 1000"


def test_with_nothing_to_set_it_is_idle():
    assert scheduling().idle_because == "neither cpus nor nice nor threads are given to sched"


@pytest.mark.parametrize(
    ("config", "said"),
    [({"cpus": [-1]}, "a core has a number from 0"), ({"nice": 20}, "less than or equal to 19"),
     ({"threads": {"a": 30}}, "a: niceness is from -20 to 19, not 30")],
)  # fmt: skip
def test_what_makes_no_sense_is_refused(config, said):
    with pytest.raises(ValueError, match=said):
        SchedulingConfig.model_validate(config)
