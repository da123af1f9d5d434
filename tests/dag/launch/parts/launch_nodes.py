"""A node of real processes, started as a user starts it, and module files to run in it."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil

TIMEOUT = 60.0  # for what takes a second on a machine that does nothing else


class Node:
    """A supervisor in a process of its own, and what it told."""

    def __init__(self, arguments, environment, cwd, before=()):
        self.environment = environment
        self.events = []
        self._changed = threading.Condition()
        self._ended = False
        command = [*before, sys.executable, "-P", "-c", "from warploom.cli import main; main()", *map(str, arguments)]
        self.supervisor = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, cwd=cwd,
            start_new_session=True,
        )  # fmt: skip
        self.errors = ""
        self._threads = [threading.Thread(target=self._read), threading.Thread(target=self._read_errors)]
        for thread in self._threads:
            thread.start()

    def _read(self):
        for line in self.supervisor.stdout:
            with self._changed:
                try:
                    self.events.append(json.loads(line))
                except ValueError:
                    self.events.append({"event": "text", "text": line.rstrip()})
                self._changed.notify_all()
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _read_errors(self):
        self.errors = self.supervisor.stderr.read()

    def find(self, event, **details):
        """The events of a kind so far."""
        wanted = {"event": event, **details}
        return [one for one in list(self.events) if wanted.items() <= one.items()]

    def wait_for(self, event, count=1, **details):
        """Waits until there are so many events of a kind; gives the last of them."""
        with self._changed:
            there = self._changed.wait_for(lambda: len(self.find(event, **details)) >= count or self._ended, TIMEOUT)
            found = self.find(event, **details)
            assert there, f"not in time: {event} {details}; so far {self.events}"
            assert len(found) >= count, f"never: {event} {details}; {self.events} {self.errors}"
            return found[count - 1]

    def up(self):
        self.wait_for("up")
        return self

    def ask(self, request, **arguments):
        from warploom.dag.launch.control import ControlClient

        launching = self.wait_for("launching")
        with ControlClient(Path(self.environment["WARPLOOM_RUN"]) / launching["node"] / "control.sock") as client:
            return client.ask(request, **arguments)

    def process(self, name):
        """What `ps` says of a process."""
        return next(one for one in self.ask("ps")["processes"] if one["name"] == name)

    def wait_until(self, condition, seconds=TIMEOUT):
        """Waits until a condition holds, which is looked at now and then."""
        until = time.monotonic() + seconds
        while not (found := condition()):
            assert time.monotonic() < until, f"not in time; {self._told()}"
            time.sleep(0.05)
        return found

    def _told(self):
        """What can be known of a node that does not do what it should: its state, and the stacks of its processes."""
        texts = [str(self.events[-8:])]
        for process in self.ask("ps")["processes"]:
            texts.append(f"{process['name']} {process['state']} {process['losses']} {process['links']}")
            if process["state"] == "running":
                os.kill(process["pid"], signal.SIGUSR1)
        time.sleep(0.5)
        texts += [path.read_text()[-4000:] for path in Path(self.environment["WARPLOOM_RUN"]).glob("*/log/*.log")]
        return "\n".join(texts)

    def signal(self, number=signal.SIGTERM):
        self.supervisor.send_signal(number)

    def wait(self):
        """The exit code, once it has ended."""
        code = self.supervisor.wait(TIMEOUT)
        for thread in self._threads:
            thread.join()
        return code

    def stop(self):
        self.signal()
        return self.wait()

    def children(self):
        """The processes of this node that live, by whatever parent."""
        plans = f"{self.environment['WARPLOOM_RUN']}/"
        found = []
        for one in psutil.process_iter():
            with contextlib.suppress(psutil.Error):
                if any(part.startswith(plans) for part in one.cmdline()) and one.status() != psutil.STATUS_ZOMBIE:
                    found.append(one)
        return found

    def close(self):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.supervisor.pid, signal.SIGKILL)
        self.supervisor.wait()
        left = self.children()
        for child in left:
            with contextlib.suppress(psutil.Error):
                child.kill()
        psutil.wait_procs(left, 10)
        for thread in self._threads:
            thread.join()
        self.supervisor.stdout.close()
        self.supervisor.stderr.close()


TICKER = """\
module: {name}
components:
  - name: {name}
    kind: data
    class: launch_parts.Ticker
    trigger: {{period_ms: {period}}}
    config: {{size: {size}, hang_after: {hang_after}, journal: "{journal}"}}
    outputs: {{out: {topic}}}
"""
DOUBLER = """\
module: {name}
components:
  - name: {name}
    kind: data
    class: launch_parts.Doubler
    trigger: sent
    backlog: {{policy: fifo, depth: 24}}
    config: {{journal: "{journal}", slow_s: {slow_s}}}
    inputs: {{sent: {sent}}}
    outputs: {{out: {topic}}}
"""
WRITER = """\
module: {name}
components:
  - name: {name}
    kind: data
    class: launch_parts.Writer
    trigger: sent
    backlog: {{policy: fifo, depth: 24}}
    config: {{path: "{path}"}}
    inputs: {{sent: {sent}}}
"""
PLAIN = """\
module: {name}
components:
  - {{name: {name}, kind: generic, class: launch_parts.Plain, config: {config}}}
"""
