"""The reference's form of a launch file."""

import pytest

from warploom.dag.launch.lookup import load_launch_file
from warploom.dag.launch.plan import plan_modules
from warploom.dag.launch.xml import XmlLaunchFile
from warploom.errors import ConfigError

GOOD = """\
<cybertron>
  <hardware><hw>hw50</hw><camera>13</camera></hardware>
  <module>
    <name>compute3d_sched</name>
    <type>energon</type>
    <process_name>compute3d_sched</process_name>
    <cgroup>app/compute3d_sched</cgroup>
    <exception_handler>respawn</exception_handler>
    <dag_conf>avar_reporter.yaml</dag_conf>
    <dag_conf>perception/blindspot_processor.yaml</dag_conf>
  </module>
  <module>
    <name>planning_sched</name>
    <cpus>0, 1</cpus>
    <nice>-5</nice>
    <environment><OMP_NUM_THREADS>2</OMP_NUM_THREADS></environment>
    <back_off><first_s>1.5</first_s></back_off>
    <restarts><limit>7</limit></restarts>
    <health_timeout_s>2.5</health_timeout_s>
    <dag_conf>planning.yaml</dag_conf>
  </module>
</cybertron>
"""


EMPTY_MODULE = "module: avar_reporter\ncomponents: []\n"


def load(tmp_path, text, changes=None):
    path = tmp_path / "computing_node_hw50.launch.xml"
    path.write_text(text, encoding="utf-8")
    return XmlLaunchFile(path, changes)


def test_the_reference_form_is_read(tmp_path):
    spec = load(tmp_path, GOOD).content
    assert spec.node == "computing_node_hw50"
    assert (spec.hardware.hw, spec.hardware.camera, spec.hardware.lidar) == ("hw50", "13", None)
    compute, planning = spec.processes
    assert (compute.name, compute.type, compute.cgroup) == ("compute3d_sched", "warploom", "app/compute3d_sched")
    assert compute.modules == ["avar_reporter.yaml", "perception/blindspot_processor.yaml"]
    assert (planning.cpus, planning.nice, planning.environment) == ([0, 1], -5, {"OMP_NUM_THREADS": "2"})
    assert (planning.back_off.first_s, planning.restarts.limit, planning.health_timeout_s) == (1.5, 7, 2.5)


def test_settings_from_outside_go_before_the_file(tmp_path):
    spec = load(tmp_path, GOOD, {("processes", 1, "nice"): 3, ("node",): "other"}).content
    assert (spec.node, spec.processes[1].nice) == ("other", 3)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("<nice>-5</nice>", "<nise>5</nise>", r":15: unknown element <nise>; did you mean 'nice'"),
        ("<nice>-5</nice>", "<nice>high</nice>", r":15: module\[2\]/nice: .*integer.*found 'high'"),
        ("<nice>-5</nice>", "<nice>1</nice><nice>2</nice>", r":15: <nice> stands twice; the first is on line 15"),
        ("<nice>-5</nice>", "<nice><b>1</b></nice>", r":15: <nice> holds <b>; expected a text"),
        ("<type>energon</type>", "<type>binary</type>", r":5: module\[1\]/type: .*found 'binary'"),
        ("<type>energon</type>", "<type kind='a'>energon</type>", r":5: <type> has the attribute 'kind'"),
        ("<dag_conf>planning.yaml</dag_conf>", "", r":12: module\[2\]/dag_conf: this element is missing"),
        ("<dag_conf>planning.yaml</dag_conf>", "<dag_conf/>", r":20: <dag_conf>: expected the name of a module file"),
        ("<limit>7</limit>", "<limits>7</limits>", r":18: unknown element <limits>; did you mean 'limit'"),
        ("<hw>hw50</hw>", "<hw>hw50", r":2: is not XML: mismatched tag"),
        ("cybertron>", "energon>", r":1: <energon>: expected <cybertron>"),
        ("  <module>\n    <name>planning_sched</name>", "  <module>text<name>p</name>", r":12: <module> holds both"),
    ],
)
def test_each_mistake_names_file_line_and_what_was_expected(tmp_path, old, new, expected):
    assert old in GOOD
    with pytest.raises(ConfigError, match=r"computing_node_hw50\.launch\.xml" + expected):
        load(tmp_path, GOOD.replace(old, new))


def test_mistakes_that_are_found_later_are_told_in_words_of_the_file_too(tmp_path):
    with pytest.raises(ConfigError, match=r"launch\.xml:1: module: this element is missing"):
        load(tmp_path, "<cybertron><node>empty</node></cybertron>")
    path = tmp_path / "twice.launch.xml"
    path.write_text(GOOD.replace("planning_sched", "compute3d_sched"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"launch\.xml:13: module\[2\]/name: there is a process 'compute3d_sched'"):
        load_launch_file(path)
    (tmp_path / "avar_reporter.yaml").write_text(EMPTY_MODULE)
    file = load(tmp_path, GOOD.replace("blindspot", "blidnspot"))
    with pytest.raises(ConfigError, match=r"launch\.xml:10: module\[1\]/dag_conf\[2\]: no module file 'perception/b"):
        plan_modules(file, tmp_path / "conf")


@pytest.mark.parametrize(
    "head",
    [
        '<!DOCTYPE a [<!ENTITY x "xx"><!ENTITY y "&x;&x;&x;&x;">]>',
        '<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]>',
        '<!DOCTYPE cybertron SYSTEM "http://localhost/x.dtd">',
    ],
)
def test_entities_are_refused_before_they_mean_anything(tmp_path, head):
    with pytest.raises(ConfigError, match=":1: a document type or an entity is declared; both are refused"):
        load(tmp_path, head + GOOD.replace("compute3d_sched</name>", "&y;</name>"))


@pytest.mark.parametrize("encoding", ["UTF-1e400", "shift_jis", "rot13"])
def test_an_encoding_that_cannot_be_read_is_told(tmp_path, encoding):
    path = tmp_path / "x.launch.xml"
    path.write_text(f'<?xml version="1.0" encoding="{encoding}"?><cybertron/>')
    with pytest.raises(ConfigError, match=r"x.launch.xml:1: cannot be read: .*write it in UTF-8"):
        XmlLaunchFile(path)


def test_what_is_endless_deep_or_huge_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="deep"):
        load(tmp_path, "<cybertron>" + "<a>" * 50_000)
    with pytest.raises(ConfigError, match="a launch file has at most"):
        load(tmp_path, "<cybertron>" + " " * 1_100_000 + "</cybertron>")
    with pytest.raises(ConfigError, match="is not XML"):
        load(tmp_path, "")
    with pytest.raises(ConfigError, match="cannot be read"):
        XmlLaunchFile(tmp_path / "none.xml")
