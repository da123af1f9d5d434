"""What the tests of the runtime share: a package that module files can name, and how a topic is fed and watched."""

import sys
import threading
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent / "parts"))


class Topic:
    """A topic seen from outside: commits to it, and remembers everything that its subscribers are told."""

    def __init__(self, window):
        from warploom.datamesh import Output

        self.window = window
        self.entries, self.settled, self.events, self.orders = {}, [], [], []
        self._changed = threading.Condition()
        self._output = Output()
        self._output.bind("test", window)
        window.subscribe(self._on_commit, self._on_settle)

    def _on_commit(self, entry):
        with self._changed:
            self.entries[entry.version] = entry.value
            self.events.append(entry.version)
            self.orders.append((entry.epoch, entry.version))
            self._changed.notify_all()

    def _on_settle(self, version, epoch):
        with self._changed:
            self.settled.append(version)
            self.events.append(version)
            self.orders.append((epoch, version))
            self._changed.notify_all()

    def commit(self, version, value=None, policy=None, **options):
        from warploom.datamesh import CommitPolicy

        with self._output.allocate_change() as change:
            change.set_version(version)
            change.value = value
            policy = CommitPolicy.DISCARD_OUT_OF_ORDER if policy is None else policy
            return self._output.commit(policy, change, **options)

    def settle(self, version):
        self._output.settle(version)

    def new_epoch(self):
        self._output.new_epoch()

    def forget(self):
        """Lets go of what it saw so far."""
        with self._changed:
            for seen in (self.entries, self.settled, self.events, self.orders):
                seen.clear()

    def wait_for_orders(self, *orders):
        """Waits until each (epoch, version) was committed or settled."""
        with self._changed:
            return self._changed.wait_for(lambda: set(orders) <= set(self.orders), 20)

    def wait_for(self, *versions):
        """Waits until each version was committed or settled."""
        with self._changed:
            assert self._changed.wait_for(lambda: set(versions) <= set(self.events), 20), (versions, self.events)


@pytest.fixture
def topic():
    """Makes a Topic of a window."""
    return Topic


@pytest.fixture
def write(tmp_path):
    """Writes a module file and gives its path."""

    def write(text, name="module.yaml"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.fixture
def no_thread_left():
    """The test ends with the threads it began with."""
    before = set(threading.enumerate())
    yield
    left = set(threading.enumerate()) - before
    assert not left, f"threads left: {left}"


@pytest.fixture
def started():
    """Starts components, and stops them at the end in the order in which they are given."""
    components = []

    def start(*new):
        components.extend(new)
        for component in reversed(new):
            component.start()

    yield start
    for component in components:
        component.stop()
