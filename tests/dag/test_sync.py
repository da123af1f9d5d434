"""Processors that connect a graph to the mesh."""

import pytest

from warploom.dag import CommitDagProcessor, Trigger
from warploom.datamesh import DataMesh, Output, Status


@pytest.fixture
def committing():
    """A processor that commits to a window, and the mesh."""
    mesh = DataMesh()
    output = Output()
    output.bind("result", mesh.window("topic"))
    processor = CommitDagProcessor()
    processor.component_outputs = {"result": output}
    processor.init(CommitDagProcessor.Config(output="result"))
    return processor, mesh


def test_commits_at_the_version_of_the_trigger_with_its_time_of_reception(committing):
    processor, mesh = committing
    processor.value.value = "datum"
    assert processor.process(Trigger(5, received_ns=123)) is Status.OK
    entry = mesh.window("topic").snapshot().entry(0)
    assert (entry.version, entry.value, entry.received_ns) == (5, "datum", 123)
    assert entry.committed_ns > 123


def test_an_older_version_is_discarded_and_counted(committing):
    processor, mesh = committing
    processor.value.value = "datum"
    assert [processor.process(Trigger(version)) for version in (5, 4, 5, 6)] == [
        Status.OK,
        Status.OUT_OF_ORDER,
        Status.DUPLICATE,
        Status.OK,
    ]
    assert mesh.losses.as_dict() == {"topic": {"duplicate": 1, "out_of_order": 1}}


def test_without_a_value_nothing_is_published(committing):
    processor, mesh = committing
    with pytest.raises(LookupError, match="'value' has no value"):
        processor.process(Trigger(1))
    assert len(mesh.window("topic").snapshot()) == 0
    assert mesh.losses.as_dict() == {"topic": {"abandoned": 1}}


def test_an_output_that_is_not_there_is_refused(committing):
    processor, _ = committing
    with pytest.raises(ValueError, match="the component has no output 'rseult'; it has: result"):
        processor.init(CommitDagProcessor.Config(output="rseult"))
