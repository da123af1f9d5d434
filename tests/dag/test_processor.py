"""Processors and their ports, each tested alone in a harness."""

from typing import Any

import pytest
from graph_parts import Add, Call, Join
from pydantic import ValidationError

from warploom.dag import In, Out, Processor, ProcessorHarness
from warploom.datamesh import Status


class Derived(Add):
    extra: In[str] = In(optional=True)
    anything: Out


class Sometimes(Processor):
    value: In[int]
    odd: Out[int]

    def process(self, trigger):
        if self.value.value % 2:
            self.odd.value = self.value.value
            return Status.OK
        return Status.MISS


def test_annotations_declare_ports_with_types_and_options_also_inherited_ones():
    ports = Derived().ports
    assert {name: (type(port), port.payload, port.optional) for name, port in ports.items()} == {
        "value": (In, int, False),
        "total": (Out, int, False),
        "extra": (In, str, True),
        "anything": (Out, object, False),
    }
    assert Join().ports["left"].payload is Any


def test_instances_do_not_share_ports():
    a, b = Derived(), Derived()
    a.extra.value = "text"
    assert a.ports["extra"] is a.extra
    assert not b.extra.present


def test_an_absent_port_says_so():
    with pytest.raises(LookupError, match="In 'value' has no value in this run"):
        _ = Add().value.value


def test_none_is_a_value():
    port = In()
    port.value = None
    assert port.present
    port.clear()
    assert not port.present


def test_the_harness_runs_a_processor_without_a_graph():
    harness = ProcessorHarness(Add, {"amount": 5}).feed(value=2)
    assert harness.run(version=7) == {"total": 7}
    assert harness.status is Status.OK
    assert harness.feed(value=10).run() == {"total": 15}


def test_the_harness_gives_only_what_was_written_in_this_run():
    harness = ProcessorHarness(Sometimes)
    assert harness.feed(value=3).run() == {"odd": 3}
    assert harness.feed(value=4).run() == {}
    assert harness.status is Status.MISS


def test_the_harness_gives_version_and_context():
    seen = []
    context = {"Call": lambda trigger, value: seen.append((trigger.version, value))}
    ProcessorHarness(Call, context=context).feed(value="x").run(version=123)
    assert seen == [(123, "x")]


def test_the_harness_refuses_inputs_that_are_not_there():
    for name in ("total", "speed"):
        with pytest.raises(ValueError, match=f"Add has no input '{name}'; it has: value"):
            ProcessorHarness(Add).feed(**{name: 1})


def test_the_harness_validates_the_configuration():
    with pytest.raises(ValidationError, match="amout"):
        ProcessorHarness(Add, {"amout": 1})
    with pytest.raises(ValueError, match="amount must be >= 0"):
        ProcessorHarness(Add, {"amount": -1})


def test_a_processor_must_be_given_something_to_do():
    with pytest.raises(NotImplementedError):
        ProcessorHarness(Processor).run()


def test_the_harness_takes_a_class_and_wants_a_status():
    with pytest.raises(TypeError, match="takes the class of a processor, not"):
        ProcessorHarness(Processor())

    class Forgets(Processor):
        def process(self, trigger):
            pass

    with pytest.raises(TypeError, match="process of Forgets returned None, not a Status"):
        ProcessorHarness(Forgets).run()
