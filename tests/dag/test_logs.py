"""Logging: where it goes, and how often the same thing is said."""

import logging

import pytest

from warploom.dag import DataProcessComponent, In, Process, Processor, Status, load_module
from warploom.dag.logs import RepeatLimit, component_logger, start_logging, stop_logging
from warploom.datamesh import Input
from warploom.errors import ConfigError


@pytest.fixture(autouse=True)
def leave_logging_as_it_was():
    root = logging.getLogger()
    level = root.level
    yield
    stop_logging()
    root.setLevel(level)


def test_a_process_logs_to_the_terminal_and_to_its_file(tmp_path, capsys):
    path = start_logging("info", tmp_path / "logs", "compute3d")
    assert path == tmp_path / "logs" / "compute3d.log"
    component_logger("tracking").info("frame %d", 7)
    component_logger("tracking").debug("not this")
    logging.getLogger("elsewhere").warning("beware")
    text = path.read_text()
    assert "INFO" in text
    assert "MainThread warploom.component.tracking: frame 7" in text
    assert "beware" in text
    assert "not this" not in text
    assert "warploom.component.tracking: frame 7" in capsys.readouterr().err


def test_starting_again_takes_the_place_of_the_first(tmp_path, capsys):
    first = start_logging("info", tmp_path, "one")
    second = start_logging("warning", tmp_path, "two")
    logging.getLogger("x").warning("once")
    assert first.read_text() == ""
    assert second.read_text().count("once") == 1
    assert capsys.readouterr().err.count("once") == 1
    stop_logging()
    logging.getLogger("x").warning("after")
    assert "after" not in second.read_text()


def test_the_file_is_rotated(tmp_path, monkeypatch):
    monkeypatch.setattr("warploom.dag.logs._FILE_BYTES", 2000)
    start_logging("info", tmp_path, "big")
    for number in range(300):
        logging.getLogger(f"logger{number}").info("a line of some length, so that the file is soon full")
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["big.log", *(f"big.log.{i}" for i in range(1, 6))]
    assert all(path.stat().st_size <= 2000 for path in tmp_path.iterdir())


def record(text="frame %d failed", args=(1,), name="a", level=logging.ERROR):
    return logging.LogRecord(name, level, "file", 1, text, args, None)


def test_repeats_are_left_out_and_counted():
    now = [0.0]
    limit = RepeatLimit(most=3, seconds=10.0, clock=lambda: now[0])
    passed = [bool(limit.filter(record(args=(number,)))) for number in range(10)]
    assert passed == [True] * 3 + [False] * 7
    now[0] = 10.0
    after = limit.filter(record(args=(99,)))
    assert after.getMessage() == "frame 99 failed (7 more of this kind since)"
    assert limit.filter(record(args=(100,))).getMessage() == "frame 100 failed"


@pytest.mark.parametrize(
    "other",
    [
        record(name="b"),
        record(level=logging.WARNING),
        record("another", ()),
        record("%s failed", ("ground",)),
    ],
)
def test_another_kind_has_a_count_of_its_own(other):
    limit = RepeatLimit(most=1)
    assert limit.filter(record())
    assert not limit.filter(record())
    assert limit.filter(other)


def test_who_is_named_makes_a_kind():
    limit = RepeatLimit(most=1)
    assert limit.filter(record("%s failed at %d", ("ground", 1)))
    assert limit.filter(record("%s failed at %d", ("cluster", 1)))
    assert not limit.filter(record("%s failed at %d", ("ground", 2)))


def test_kinds_without_end_are_forgotten():
    limit = RepeatLimit()
    for number in range(5000):
        limit.filter(record(f"text {number}", ()))
    assert len(limit._kinds) <= 1024


def test_bad_arguments_are_refused(tmp_path):
    with pytest.raises(ValueError, match="'loud' is none of debug, info, warning, error"):
        start_logging("loud")
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="the log cannot be written"):
        start_logging("info", tmp_path / "file" / "below")


class Says(Processor):
    value: In[int]

    def process(self, trigger):
        self.log.warning("value %d", self.value.value)
        return Status.OK


class SaysToo(DataProcessComponent):
    value: Input[int]

    def process(self, trigger):
        self.log.warning("version %d", trigger.version)
        return Status.OK


def test_each_component_and_vertex_has_a_logger_of_its_name(write, topic, caplog):
    text = f"""\
module: says
components:
  - name: graph
    kind: dag
    trigger: value
    inputs: {{value: sensor/value}}
    hand_off: inline
    graph:
      first: {{processor: {__name__}.Says}}
  - name: plain
    class: {__name__}.SaysToo
    kind: data
    trigger: value
    inputs: {{value: sensor/value}}
    hand_off: inline
"""
    process = Process([load_module(write(text))], external={"sensor/value": int})
    process.start()
    topic(process.mesh.window("sensor/value")).commit(5, 7)
    process.stop()
    assert sorted((one.name, one.getMessage()) for one in caplog.records) == [
        ("warploom.component.graph.first", "value 7"),
        ("warploom.component.plain", "version 5"),
    ]
