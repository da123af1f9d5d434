"""The plan of the links of a node, and processes that it connects."""

import threading

import pytest

from warploom.dag.launch.linking import LinkPlan, Links, plan_links
from warploom.dag.launch.plan import plan_zenoh
from warploom.dag.modules import load_module
from warploom.dag.process import Process
from warploom.datamesh import CommitPolicy, DataMesh, Output
from warploom.datamesh.transport import SharedMemoryConfig, ZenohConfig
from warploom.errors import ConfigError

DOUBLE = """\
module: double
components:
  - name: double
    kind: data
    class: linking_parts.Double
    trigger: number
    backlog: {{policy: {backlog}, depth: 4}}
    inputs: {{number: {number}}}
    outputs: {{result: {result}}}
"""
SAYS = """\
module: says
components:
  - {name: says, kind: data, class: linking_parts.Says, trigger: {period_ms: 50}, outputs: {text: text}}
"""
LISTENS = """\
module: listens
components:
  - name: listens
    kind: data
    class: linking_parts.Listens
    trigger: number
    inputs: {{number: {number}, other: {other}}}
"""
GRAPH = """\
module: graph
components:
  - name: graph
    kind: dag
    trigger: number
    inputs: {number: b}
    outputs: {sum: c}
    graph:
      add: {processor: linking_parts.Add}
      commit: {processor: warploom.dag.CommitDagProcessor, in: {value: sum}, config: {output: sum}}
"""
PLAIN = "module: plain\ncomponents:\n  - {name: plain, kind: generic, class: linking_parts.Plain}\n"


@pytest.fixture
def modules(tmp_path):
    """Makes the module files of processes of their texts."""

    def make(**processes):
        files = {}
        for process, texts in processes.items():
            files[process] = []
            for number, text in enumerate(texts):
                path = tmp_path / f"{process}_{number}.yaml"
                path.write_text(text)
                files[process].append(load_module(path))
        return files

    return make


def double(number, result, backlog="fifo"):
    return DOUBLE.format(number=number, result=result, backlog=backlog)


def listens(number, other="nothing"):
    return LISTENS.format(number=number, other=other)


class TestPlan:
    """What goes where."""

    def test_what_is_read_elsewhere_is_exported_there_and_imported_here(self, modules):
        plan = plan_links(
            modules(
                first=[double("a", "b"), listens("b")], second=[GRAPH, PLAIN], third=[listens("c", "b")], idle=[PLAIN]
            ),
            remote={"a": "zenoh"},
        )
        assert plan == {
            "first": LinkPlan(exports=("b",), imports=("a",), remote={"a": "zenoh"}),
            "second": LinkPlan(exports=("c",), imports=("b",)),
            "third": LinkPlan(imports=("b", "c")),
            "idle": LinkPlan(),
        }
        assert plan["third"].external == {"b": object, "c": object}

    def test_what_stays_within_a_process_has_no_link(self, modules):
        plan = plan_links(modules(one=[double("a", "b"), listens("b")], other=[PLAIN]), remote={"a": "zenoh"})
        assert plan["one"].exports == ()

    def test_what_goes_between_hosts_is_exported_though_nobody_here_reads_it(self, modules):
        plan = plan_links(modules(one=[double("a", "b")]), remote={"a": "zenoh", "b": "zenoh", "unused": "zenoh"})
        assert plan["one"] == LinkPlan(("b",), ("a",), remote={"a": "zenoh", "b": "zenoh"})

    def test_what_another_process_of_the_host_commits_comes_from_there(self, modules):
        plan = plan_links(modules(one=[double("a", "b")], two=[listens("b")]), remote={"a": "zenoh", "b": "zenoh"})
        assert plan["one"].remote == {"a": "zenoh", "b": "zenoh"}
        assert plan["two"] == LinkPlan(imports=("b",))

    def test_a_backlog_that_blocks_blocks_its_producer_across_processes(self, modules):
        plan = plan_links(
            modules(one=[double("a", "b")], two=[double("b", "c", "block")]), remote={"a": "zenoh", "c": "zenoh"}
        )
        assert plan["two"].blocking == ("b",)

    def test_an_optional_input_needs_no_producer(self, modules):
        assert plan_links(modules(one=[double("a", "b"), listens("b", "nobody")]), remote={"a": "zenoh"})

    def test_one_process_listens_for_other_hosts_and_the_others_connect_to_it(self, modules):
        plans = plan_links(
            modules(idle=[PLAIN], one=[double("a", "b")], two=[listens("b", "d")], three=[double("b", "c")]),
            remote={"a": "zenoh", "c": "zenoh", "d": "zenoh"},
        )
        zenoh = ZenohConfig(connect=("tcp/far:1",), listen=("tcp/0.0.0.0:7447",), domain="car")
        joins = plan_zenoh(plans, zenoh)
        assert joins["one"] == zenoh
        for name in ("two", "three"):
            assert joins[name].connect == ("tcp/far:1", "tcp/0.0.0.0:7447")
            assert (joins[name].listen, joins[name].domain) == ((), "car")
        for alike in (ZenohConfig(connect=("tcp/far:1",)), ZenohConfig(mode="client", connect=("tcp/router:1",))):
            assert set(plan_zenoh(plans, alike).values()) == {alike}

    @pytest.mark.parametrize(
        ("processes", "message"),
        [
            (
                {"one": [double("a", "b")], "two": [double("a", "b")]},
                r"two_0\.yaml:9: components\.0\.outputs\.result: topic 'b' has two producers: 'double' in process "
                r"'one' and 'double' in process 'two'",
            ),
            (
                {"one": [double("a", "b"), GRAPH.replace("sum: c", "sum: b").replace("number: b", "number: a")]},
                r"one_1\.yaml:7: components\.0\.outputs\.sum: topic 'b' has two producers: 'double' and 'graph'",
            ),
            (
                {"one": [double("a", "points")], "two": [listens("point")]},
                r"two_0\.yaml:7: components\.0\.inputs\.number: nobody produces topic 'point'; did you mean 'points'",
            ),
            (
                {"one": [SAYS], "two": [listens("text")]},
                r"two_0\.yaml:7: components\.0\.inputs\.number: topic 'text' carries str from process 'one', not int",
            ),
            (
                {"one": [SAYS], "two": [GRAPH.replace("number: b", "number: text")]},
                r"two_0\.yaml:6: components\.0\.inputs\.number: topic 'text' carries str from process 'one', not int",
            ),
            (
                {"one": [PLAIN.replace("Plain", "Unheard")]},
                r"one_0\.yaml:3: components\.0\.class: .*no class 'Unheard'",
            ),
        ],
    )
    def test_what_does_not_fit_says_where(self, modules, processes, message):
        with pytest.raises(ConfigError, match=message):
            plan_links(modules(**processes), remote={"a": "zenoh"})

    def test_a_transport_that_there_is_not_is_refused(self, modules):
        with pytest.raises(ConfigError, match="topic 'a': no transport 'zeno' between hosts; did you mean 'zenoh'"):
            plan_links(modules(one=[double("a", "b")]), remote={"a": "zeno"})


@pytest.fixture
def links_of(run_base):
    """Makes links of a node; they end with the test."""
    made = []

    def make(process, plan, name, node="node"):
        config = SharedMemoryConfig(memory_bytes=1 << 20, retry_ms=2.0)
        made.append(Links(process, plan, node=node, name=name, shared_memory=config))
        return made[-1]

    yield make
    for one in made:
        one.stop()


def commit(mesh, topic, version, value):
    output = Output()
    output.bind(topic, mesh.window(topic))
    with output.allocate_change() as change:
        change.set_version(version)
        change.value = value
        return output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)


def watch(mesh, topic, count):
    """The versions and values of a topic, and an event once there are so many."""
    got, ended = [], threading.Event()

    def on_commit(entry):
        got.append((entry.version, entry.value))
        if len(got) == count:
            ended.set()

    mesh.window(topic).subscribe(on_commit, lambda *_: None)
    return got, ended


class TestLinks:
    """Processes that are connected."""

    def test_processes_work_as_one_would(self, modules, links_of):
        files = modules(first=[double("a", "b")], second=[GRAPH], third=[double("c", "d")])
        plans = plan_links(files, remote={"a": "zenoh", "d": "zenoh"})
        plans["first"] = LinkPlan(plans["first"].exports, ())  # `a` is committed by the test
        processes = {
            name: Process(files[name], external={"a": int} if name == "first" else plans[name].external)
            for name in files
        }
        links = {name: links_of(process, plans[name], name) for name, process in processes.items() if name != "third"}
        links["third"] = links_of(processes["third"], LinkPlan(imports=("c",)), "third")
        got, ended = watch(processes["third"].mesh, "d", 20)
        try:
            for name in files:
                links[name].start()
                processes[name].start()
            for version in range(20):
                commit(processes["first"].mesh, "a", version, version)
                until_committed(processes["third"].mesh, "d", version)
            assert ended.wait(30)
            assert got == [(version, 2 * (2 * version + 1)) for version in range(20)]
        finally:
            for name in files:
                links[name].stop_imports()
                processes[name].stop()
                links[name].stop()

    def test_a_topic_is_exported_and_imported_while_all_runs(self, links_of):
        mesh, other = DataMesh(), DataMesh()
        first, second = links_of(mesh, LinkPlan(), "first"), links_of(other, LinkPlan(), "second")
        first.start()
        second.start()
        commit(mesh, "topic", 1, "before")
        got, ended = watch(other, "topic", 2)
        first.export("topic")
        first.export("topic")
        second.import_("topic")
        second.import_("topic")
        until_committed(other, "topic", 1)
        commit(mesh, "topic", 2, "after")
        assert ended.wait(30)
        assert got == [(1, "before"), (2, "after")]
        assert first.counters()["topic"]["readers"] == 1
        second.end_import("topic")
        first.end_export("topic")
        assert first.counters() == second.counters() == {}
        commit(mesh, "topic", 3, "unheard")
        second.end_import("topic")
        assert other.window("topic").snapshot().versions == (1, 2)

    def test_a_topic_goes_one_way(self, links_of):
        links = links_of(DataMesh(), LinkPlan(("out",), ("in",)), "first")
        links.start()
        with pytest.raises(ConfigError, match="comes from another process"):
            links.export("in")
        with pytest.raises(ConfigError, match="is committed by this process"):
            links.import_("out")

    def test_where_one_link_fails_none_is_left(self, links_of):
        first = links_of(DataMesh(), LinkPlan(("b",)), "first")
        second = links_of(DataMesh(), LinkPlan(("a", "b")), "second")
        first.start()
        with pytest.raises(ConfigError, match="'b' of node 'node' is exported already"):
            second.start()
        assert second.counters() == {}
        first.stop()
        second.start()
        assert sorted(second.counters()) == ["a", "b"]

    def test_links_stop_and_start_again(self, links_of):
        mesh, other = DataMesh(), DataMesh()
        first, second = links_of(mesh, LinkPlan(("a",)), "first"), links_of(other, LinkPlan((), ("a",)), "second")
        for version in range(3):
            first.start()
            second.start()
            commit(mesh, "a", version, version)
            until_committed(other, "a", version)
            first.stop()
            second.stop()
        assert other.window("a").snapshot().versions == (0, 1, 2)


def until_committed(mesh, topic, version):
    """Waits for a version."""
    ended = threading.Event()
    mesh.window(topic).wait(version, lambda _: ended.set())
    assert ended.wait(30)
