"""Who runs a component: the thread that receives what triggers it, where that keeps nobody waiting."""

import pytest

from warploom.dag.launch.handing import hand_over
from warploom.dag.modules import load_module

MODULE = """
module: test
components:
  - name: reader
    kind: {kind}
    class: some.Class
    inputs: {{data: {topic}, slow: map}}
    trigger: {trigger}
    {more}
  - name: other
    kind: data
    class: some.Class
    inputs: {{other: {other}}}
    trigger: other
    hand_off: thread
"""


@pytest.fixture
def handed(tmp_path):
    """Who runs the component `reader`."""

    def handed(kind="data", topic="far", trigger="data", more="", other="elsewhere"):
        path = tmp_path / "test.yaml"
        path.write_text(MODULE.format(kind=kind, topic=topic, trigger=trigger, more=more, other=other))
        file = load_module(path)
        hand_over([file], ["far", "elsewhere"])
        assert file.content.components[1].hand_off == "thread", "it says so itself"
        return file.content.components[0].hand_off

    return handed


def test_what_one_topic_from_elsewhere_triggers_runs_in_the_thread_that_receives_it(handed):
    assert handed() == "inline"


@pytest.mark.parametrize(
    "where",
    [
        {"topic": "near"},
        {"other": "far"},
        {"kind": "dag", "more": "graph: {one: {processor: some.Processor, in: {x: data}}}"},
        {"trigger": "{any: [data, slow]}"},
        {"trigger": "{all: [data, slow]}"},
        {"trigger": "{period_ms: 10}"},
        {"more": "hand_off: thread"},
        {"more": "backlog: {policy: block, depth: 2}"},
    ],
    ids=str,
)
def test_otherwise_it_has_threads_of_its_own(handed, where):
    assert handed(**where) == "thread"
