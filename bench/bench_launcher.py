"""The launcher: what a supervisor costs while nothing happens, how fast a node starts and a killed process is back."""

import json
import os
import pty
import signal
import subprocess
import sys
import tempfile
import threading
import time

import numpy as np
import psutil
import pytest
import yaml

from warploom.bench.contest import peer, record_figure
from warploom.dag.launch.control import connect
from warploom.dag.launch.listening import listen

COMMAND = "from warploom.cli import main; main()"
IDLE_S = 5.0
KILLS = 3
REFERENCE = {"hw": "hw50", "lidar": "pandar90", "camera": "13", "radar": "conti430"}
PEAK = """
peak = next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM"))
import os, time; times = os.times(); sys.stderr.write(f"USED {peak} {times.user + times.system}")
"""
MODULE = """\
module: {name}
components:
  - {{name: {name}, kind: generic, class: warploom.bench.launched.Nothing}}
  - name: {name}_commits
    kind: data
    class: warploom.bench.launched.Commits
    trigger: {{period_ms: 100}}
    outputs: {{out: {name}/out}}
"""
SUPERVISORD = """\
[supervisord]
nodaemon=true
logfile={folder}/log
pidfile={folder}/pid
"""


class Node:
    """A launched node whose events are read, or shown on a terminal."""

    def __init__(self, arguments, *, terminal=False):
        self.events = []
        self._changed = threading.Condition()
        self._terminal = pty.openpty() if terminal else None
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-c", COMMAND, "launch", *arguments],
            stdout=subprocess.PIPE if self._terminal is None else self._terminal[1],
            env={**os.environ, "TERM": "xterm"},
        )
        if self._terminal is not None:
            os.close(self._terminal[1])
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self):
        if self._terminal is None:
            for line in self.process.stdout:
                with self._changed:
                    self.events.append((time.perf_counter(), json.loads(line)))
                    self._changed.notify_all()
            return
        try:
            while data := os.read(self._terminal[0], 1 << 16):
                if "up: seconds" in data.decode(errors="replace"):
                    with self._changed:
                        self.events.append((time.perf_counter(), {"event": "up"}))
                        self._changed.notify_all()
        except OSError:  # the end of a terminal
            pass

    def wait_for(self, count=1, **wanted):
        """The time of an event, and the event."""

        def found():
            return [one for one in self.events if wanted.items() <= one[1].items()]

        with self._changed:
            over = time.monotonic() + 120
            while len(found()) < count:
                self._changed.wait(0.5)
                assert self.process.poll() is None, f"it has ended: {self.events}"
                assert time.monotonic() < over, self.events
        return found()[count - 1]

    def close(self):
        """Stops it."""
        self.process.terminate()
        self.process.wait(60)
        self._thread.join()
        if self._terminal is not None:
            os.close(self._terminal[0])
        else:
            self.process.stdout.close()


def small_node(folder, processes):
    """Writes the launch file of a node whose processes do next to nothing."""
    for number in range(processes):
        (folder / f"m{number}.yaml").write_text(MODULE.format(name=f"m{number}"))
    keys = {"back_off": {"first_s": 0.0}, "restarts": {"limit": 1000}}
    content = {
        "node": "bench",
        "processes": [{"name": f"p{n}", "modules": [f"m{n}.yaml"], **keys} for n in range(processes)],
    }
    path = folder / "bench.launch.yaml"
    path.write_text(yaml.safe_dump(content))
    return str(path)


@pytest.fixture
def node(tmp_path, monkeypatch):
    nodes = []

    def node(*launched, **how):
        """Of so many small processes, or of what is named as on the command line."""
        arguments = [small_node(tmp_path, launched[0])] if isinstance(launched[0], int) else launched
        nodes.append(Node(arguments, **how))
        return nodes[-1]

    with tempfile.TemporaryDirectory(prefix="warploom-") as run:  # the path of a socket is short
        monkeypatch.setenv("WARPLOOM_RUN", run)
        yield node
        for one in nodes:
            one.close()


def idle_share(pid, seconds=IDLE_S):
    """The share of a core that a process uses while nothing happens [%], and how often it wakes up in a second."""
    one = psutil.Process(pid)
    time.sleep(1.0)
    before, woken, start = one.cpu_times(), one.num_ctx_switches(), time.perf_counter()
    time.sleep(seconds)
    after, woken_after, passed = one.cpu_times(), one.num_ctx_switches(), time.perf_counter() - start
    spent = after.user + after.system - before.user - before.system
    return 100 * spent / passed, (woken_after.voluntary - woken.voluntary) / passed


@pytest.mark.slow
@pytest.mark.parametrize(("processes", "terminal"), [(2, False), (8, False), (2, True)])
def bench_idle_supervisor(benchmark, node, processes, terminal):
    """What watching costs: signs of life come, nothing else happens."""
    one = node(processes, terminal=terminal)
    one.wait_for(event="up")
    shares = []
    benchmark.pedantic(lambda: shares.append(idle_share(one.process.pid)), rounds=1)
    share, woken = shares[0]
    memory = psutil.Process(one.process.pid).memory_info().rss / 2**20
    name = f"idle supervisor of {processes} processes" + (", table on a terminal" if terminal else "")
    note = f"CPU time over {IDLE_S:g} s; wakes {woken:.1f} times a second; {memory:.0f} MiB"
    benchmark.extra_info.update(kernel="launcher", on=f"{processes} processes")
    record_figure(benchmark, name, share, "% of a core", goal=1.0, note=note)


@pytest.mark.slow
def bench_idle_supervisord(benchmark, tmp_path):
    """The same of supervisord, whose processes sleep and give no signs of life."""
    peer("supervisor")
    text = SUPERVISORD.format(folder=tmp_path)
    for number in range(2):
        text += f"[program:p{number}]\ncommand=/bin/sleep 1000\n"
    (tmp_path / "supervisord.conf").write_text(text)
    command = [sys.executable, "-W", "ignore", "-m", "supervisor.supervisord", "-c", str(tmp_path / "supervisord.conf")]
    one = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        time.sleep(2.0)
        shares = []
        benchmark.pedantic(lambda: shares.append(idle_share(one.pid)), rounds=1)
    finally:
        one.terminate()
        one.wait(60)
    note = f"CPU time over {IDLE_S:g} s; wakes {shares[0][1]:.1f} times a second"
    benchmark.extra_info.update(kernel="launcher", on="2 processes")
    record_figure(benchmark, "supervisord of 2 processes", shares[0][0], "% of a core", note=note)


@pytest.mark.slow
def bench_start_and_respawn(benchmark, node):
    """From the command to all processes running; and from kill -9 to the process running again."""
    start = time.perf_counter()
    one = node(2)
    up = one.wait_for(event="up")[0] - start
    told, back = [], []

    def kill():
        number = len(told) + 1
        pid = one.wait_for(number, event="state", process="p0", state="running")[1]["pid"]
        killed = time.perf_counter()
        os.kill(pid, signal.SIGKILL)
        told.append(one.wait_for(number, event="died", process="p0")[0] - killed)
        back.append(one.wait_for(number + 1, event="state", process="p0", state="running")[0] - killed)

    benchmark.extra_info.update(kernel="launcher", on="2 processes")
    benchmark.pedantic(kill, rounds=KILLS)
    record_figure(benchmark, "warploom launch of 2 processes, to all running", up, "s", note="from the command")
    note = f"median of {KILLS}"
    record_figure(benchmark, "death noticed after kill -9", np.median(told) * 1e3, "ms", note=note)
    record_figure(benchmark, "kill -9 to running again, back-off 0", np.median(back), "s", note=note)


class Heard:
    """When each commit of a topic of the only node was here."""

    def __init__(self, topic):
        self.times = []
        self._topic = topic
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def _listen(self):
        name, client = connect(None)
        with client:
            for entry in listen(client, name, self._topic, "bench", 0.1, ends=False, past=False):
                if self._stopping.is_set():
                    return
                if entry is not None:
                    self.times.append(time.perf_counter())

    def first_after(self, begin, least=1):
        """The first time after another, once so many have come after it."""
        end = time.perf_counter() + 120
        while len(after := [one for one in self.times if one > begin]) < least:
            assert time.perf_counter() < end, "nothing came"
            time.sleep(0.01)
        return after[0]

    def stop(self):
        """Listens no more."""
        self._stopping.set()
        self._thread.join()


@pytest.mark.slow
def bench_recovery_of_the_reference_node(benchmark, node):
    """From kill -9 of the process that holds driver and perception to the next obstacles, heard in another process."""
    one = node(*(f"--{key}={value}" for key, value in REFERENCE.items()))
    begin = time.perf_counter()
    one.wait_for(event="up")
    heard = Heard("perception/obstacles")
    first = heard.first_after(begin, least=20) - begin
    running, served, obstacles = [], [], []

    def kill():
        number = len(running) + 1
        process = "compute3d_sched"
        pid = one.wait_for(number, event="state", process=process, state="running")[1]["pid"]
        killed = time.perf_counter()
        os.kill(pid, signal.SIGKILL)
        running.append(one.wait_for(number + 1, event="state", process=process, state="running")[0] - killed)
        # What had been committed before the kill may still arrive.
        obstacles.append(heard.first_after(killed + min(0.5, running[-1]), least=10) - killed)
        served.append(one.wait_for(number + 1, event="serving", process=process)[0] - killed)

    benchmark.extra_info.update(kernel="launcher", on="reference node")
    try:
        benchmark.pedantic(kill, rounds=2)
    finally:
        heard.stop()
    note = f"least of {len(obstacles)}; the simulator plays the hardware"
    record_figure(benchmark, "reference node, from the command to obstacles", first, "s", note="kernels in the cache")
    record_figure(benchmark, "reference node, kill -9 to running again", min(running), "s", note=note)
    record_figure(benchmark, "reference node, kill -9 to serving", min(served), "s", note=note)
    record_figure(benchmark, "reference node, kill -9 to obstacles", min(obstacles), "s", goal=6.0, note=note)


def used_by(arguments, folder):
    """The peak of resident memory [MiB] and the CPU time [s] of a command, in a process of its own."""
    code = f"import sys; from warploom.cli import main; sys.argv = ['warploom', *{arguments!r}]\n"
    code += f"try:\n    main()\nexcept SystemExit as ended:\n    assert not ended.code\n{PEAK}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder, check=True)
    peak, cpu = done.stderr.rpartition("USED ")[2].split()
    return int(peak) / 1024, float(cpu)


@pytest.mark.slow
def bench_check(benchmark, tmp_path):
    """What `--check` of the reference node costs: classes are imported, nothing is compiled."""
    arguments = ["launch", "--check", *(f"--{key}={value}" for key, value in REFERENCE.items())]
    used = []
    benchmark.extra_info.update(kernel="launcher", on="reference node")
    benchmark.pedantic(lambda: used.append(used_by(arguments, tmp_path)), rounds=2)
    cpu = min(cpu for _, cpu in used)
    record_figure(benchmark, "launch --check of the reference node", cpu, "s of CPU", goal=3.0, note="least of 2")


@pytest.mark.slow
def bench_memory_of_cpu_min(benchmark, tmp_path):
    """The peak of resident memory of the demo with the smallest profile."""
    arguments = ["demo", "--profile", "cpu-min", "--seconds", "2", "--out", str(tmp_path / "out")]
    used = []
    benchmark.extra_info.update(kernel="launcher", on="demo, 2 s")
    benchmark.pedantic(lambda: used.append(used_by(arguments, tmp_path)), rounds=1)
    record_figure(benchmark, "demo with cpu-min, peak of resident memory", used[0][0], "MiB", goal=1024.0)
