"""Classes that the module files of the tests name."""

from typing import Any, ClassVar

from warploom.dag import Component, DagComponent, DataProcessComponent, In, Out, Processor, ProcessorConfig
from warploom.datamesh import CommitPolicy, Input, Output, Status


class AddConfig(ProcessorConfig):
    amount: int = 1
    label: str = ""
    parts: tuple[int, ...] = ()


class Add(Processor):
    Config = AddConfig

    value: In[int]
    total: Out[int]

    def init(self, config):
        if config.amount < 0:
            raise ValueError(f"amount must be >= 0, not {config.amount}")
        self.amount = config.amount

    def process(self, trigger):
        if self.context == ("fail", trigger.version):
            raise RuntimeError("no sum today")
        self.total.value = self.value.value + self.amount
        return Status.OK


class Describe(Processor):
    total: In[int]
    text: Out[str]

    def process(self, trigger):
        self.text.value = str(self.total.value)
        return Status.OK


class Shout(Processor):
    text: In[str]
    loud: Out[str]

    def process(self, trigger):
        self.loud.value = self.text.value.upper()
        return Status.OK


class Join(Processor):
    left: In[Any]
    right: In[Any] = In(optional=True)
    joined: Out[Any]

    def process(self, trigger):
        self.joined.value = (self.left.value, self.right.value if self.right.present else None)
        return Status.OK


class Call(Processor):
    """Does what the context says for a vertex of its name: `context[name](trigger, value)`."""

    value: In[Any]
    result: Out[Any]

    def process(self, trigger):
        self.result.value = self.context[self.name](trigger, self.value.value)
        return Status.OK

    def close(self):
        self.context.get("close", lambda name: None)(self.name)


class Unmakeable(Processor):
    def __init__(self):
        raise OSError("no such camera")

    def process(self, trigger):
        return Status.OK


class NotAProcessor:
    pass


class Doubler(DataProcessComponent):
    number: Input[int]
    double: Output[int]

    def process(self, trigger):
        with self.number.access() as snapshot:
            index = snapshot.version_index(trigger.version)
            if index < 0:
                return Status.MISS
            value = snapshot[index]
        if self.context == ("fail", trigger.version):
            raise RuntimeError("no double today")
        if self.context == ("exit", trigger.version):
            raise SystemExit(3)
        with self.double.allocate_change() as change:
            change.set_version(trigger.version, trigger.received_ns)
            change.value = value * 2
            return self.double.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)


class TwoInputs(DataProcessComponent):
    number: Input[int]
    side: Input[int]
    double: Output[int]

    def process(self, trigger):
        with self.double.allocate_change() as change:
            change.set_version(trigger.version)
            change.value = dict(trigger.inputs)
            return self.double.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)


class Graph(DagComponent):
    pass


class Source(Component):
    """Has an output and no trigger."""

    number: Output[int]


class Plain:
    """A plain class, which knows nothing of warploom."""

    events: ClassVar[list] = []

    def __init__(self, label):
        if not label:
            raise ValueError("a label is needed")
        self.label = label

    def start(self):
        self.events.append(("start", self.label))

    def stop(self):
        self.events.append(("stop", self.label))


class BadStart(Plain):
    def start(self):
        raise RuntimeError("port in use")


class BadStop(Plain):
    def stop(self):
        raise RuntimeError("stuck")


class Silent:
    """Neither starts nor stops."""
