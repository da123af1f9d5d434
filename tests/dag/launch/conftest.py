"""What the tests of the launcher share: nodes in a run folder of the test's own, and files to launch."""

import os
import signal
import sys
from pathlib import Path

import pytest
import yaml

PARTS = Path(__file__).parent / "parts"
sys.path.insert(0, str(PARTS))

from launch_nodes import Node  # noqa: E402


@pytest.fixture(autouse=True)
def interruptible():
    """SIGINT works, here and in the nodes: a shell has what runs in its background ignore it, and that is inherited."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def run_base(tmp_path, monkeypatch):
    """The folder of the nodes' runtime files."""
    monkeypatch.setenv("WARPLOOM_RUN", str(tmp_path / "run"))
    return tmp_path / "run"


@pytest.fixture
def start(run_base, tmp_path, monkeypatch):
    """Starts a node with the command's arguments, by a command `before` that runs it in another way."""
    nodes = []

    def start(*arguments, before=(), **environment):
        paths = [str(PARTS), *filter(None, [os.environ.get("PYTHONPATH")])]
        variables = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), **environment}
        nodes.append(Node(arguments, variables, tmp_path, before))
        return nodes[-1]

    yield start
    for node in nodes:
        node.close()
    left = [child for node in nodes for child in node.children()]
    assert not left, f"processes left: {left}"


@pytest.fixture
def module(tmp_path):
    """Writes a module file by one of the texts above."""

    def module(text, name, **values):
        defaults = {"period": 20, "size": 16, "hang_after": 0, "journal": "", "slow_s": 0.0, "config": "{}"}
        path = tmp_path / f"{name}.yaml"
        path.write_text(text.format(name=name, **{**defaults, **values}), encoding="utf-8")
        return path.name

    return module


@pytest.fixture
def launch_file(tmp_path):
    """Writes a launch file of processes: name → modules and further keys."""

    def launch_file(node="node", _head=None, **processes):
        content = {
            "node": node,
            **(_head or {}),
            "processes": [
                {"name": name, **(keys if isinstance(keys, dict) else {"modules": keys})}
                for name, keys in processes.items()
            ],
        }
        path = tmp_path / f"{node}.launch.yaml"
        path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
        return path

    return launch_file
