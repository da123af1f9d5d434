"""Components that the tests make, and what they are made of."""

import threading

from graph_parts import Call, Doubler

from warploom.dag import BacklogConfig, CommitDagProcessor, DagComponent, In, Out, Processor, Vertex
from warploom.datamesh import Status

WAIT = 20.0
FIFO, BLOCK = BacklogConfig(policy="fifo", depth=30), BacklogConfig(policy="block")


def doubler(
    mesh, context=None, backlog=FIFO, name="doubler", topics=("number", "double"), hand_off="thread", trigger="number"
):
    component = Doubler(name, context)
    component.bind(mesh, {"number": topics[0], "double": topics[1]})
    component.set_trigger(trigger, backlog, hand_off)
    return component


def joining(mesh, trigger, backlog=FIFO, hand_off="thread", prefix=""):
    """A graph that joins the two inputs that trigger it."""
    component = DagComponent("join")
    component.add_handles(["left", "right"], ["output"])
    component.bind(mesh, {name: f"{prefix} {name}".strip() for name in ("left", "right", "output")})
    join, commit = JoinOptional(), CommitDagProcessor()
    commit.component_outputs = component.outputs
    commit.init(CommitDagProcessor.Config(output="output"))
    vertices = [
        Vertex("join", join, {"left": "left", "right": "right"}, {"joined": "joined"}),
        Vertex("commit", commit, {"value": "joined"}, {}),
    ]
    component.set_graph(vertices, workers=1, in_flight=1)
    component.set_trigger(trigger, backlog, hand_off)
    return component


class JoinOptional(Processor):
    left: In[object] = In(optional=True)
    right: In[object] = In(optional=True)
    joined: Out[object]

    def process(self, trigger):
        self.joined.value = tuple(port.value if port.present else None for port in (self.left, self.right))
        return Status.OK


class Tick(Call):
    """Takes its value, or None where time triggers."""

    value: In[object] = In(optional=True)

    def process(self, trigger):
        value = self.value.value if self.value.present else None
        self.result.value = self.context[self.name](trigger, value)
        return Status.OK


def dag(
    mesh,
    *acts,
    kind=DagComponent,
    backlog=FIFO,
    topics=("input", "output"),
    workers=2,
    in_flight=1,
    hand_off="thread",
    trigger="input",
    reads=("input",),
    **calls,
):
    """A chain of vertices `v0`, `v1` … that do `acts`, and one that commits the result of the last."""
    component = kind(calls.pop("name", "dag"))
    component.add_handles(["input"], ["output"])
    component.bind(mesh, {"input": topics[0], "output": topics[1]})
    vertices = []
    for number, act in enumerate(acts):
        processor = Call() if reads else Tick()
        processor.name, processor.context = f"v{number}", {f"v{number}": act, **calls}
        source = f"v{number - 1}" if number else "input"
        vertices.append(Vertex(processor.name, processor, {"value": source}, {"result": processor.name}))
    commit, config = CommitDagProcessor(), CommitDagProcessor.Config(output="output")
    commit.component_outputs = component.outputs
    commit.init(config)
    vertices.append(Vertex("commit", commit, {"value": f"v{len(acts) - 1}"}, {}, config=config))
    component.set_graph(vertices, workers=workers, in_flight=in_flight)
    component.set_trigger(trigger, backlog, hand_off)
    return component


class Holding:
    """An act that holds the frames that it is told to, until they are released."""

    def __init__(self, *versions):
        self.held = {version: threading.Event() for version in versions}
        self.reached = {version: threading.Event() for version in versions}
        self.started = []

    def __call__(self, trigger, value):
        self.started.append(trigger.version)
        if trigger.version in self.held:
            self.reached[trigger.version].set()
            assert self.held[trigger.version].wait(WAIT)
        return value

    def wait_until_held(self, version):
        assert self.reached[version].wait(WAIT)

    def release(self, version):
        self.held[version].set()


def same(trigger, value):
    return value


def failing_at(*versions):
    def act(trigger, value):
        if trigger.version in versions:
            raise ValueError("bad frame")
        return value

    return act
