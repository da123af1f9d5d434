"""The reference node: each file of its command line has a purpose and is good alone, and all build together."""

import pathlib
import re

import pytest

from warploom.components.checking import check_file, draw_file
from warploom.components.profile import CONF, execution_context, load_profile
from warploom.dag import Process, find_config, load_module
from warploom.dag.launch.linking import plan_links
from warploom.dag.launch.lookup import find_by_hardware, load_launch_file
from warploom.dag.launch.plan import plan_modules
from warploom.errors import ConfigError

NODE = "computing_node_hw50_pandar90_13_600"
HARDWARE = {"hw": "hw50", "lidar": "pandar90", "camera": "13", "radar": "conti430"}

# The reference's command line, word for word.
COMMAND_LINE = """
launcher -c avar_reporter.yaml -c gpu_setup_component.yaml -c gpsbin_component.yaml -c dag_streaming_gnss_rtk.yaml -c dag_streaming_novatel.yaml
 -c localization_onboard_rt6.yaml -c localization_security_monitor.yaml -c localization_gnss_sins.yaml -c scene_manager_onboard.yaml
 -c crowdmap_passback.yaml -c onlinemap_onboard.yaml -c lidar_hesai90.yaml -c camera_13c_ads50_struct.yaml -c all_radar_conti430.yaml
 -c sensor/lidar_hesai90_preprocess_component.yaml -c sensor/gnss_preprocess_component.yaml -c sensor/imu_preprocess_component.yaml
 -c sensor/wheelspeed_preprocess_component.yaml -c perception/ads50_hesai90_setup.yaml -c perception/blindspot_processor.yaml
 -c sensor/camera_13c_preprocess_component.yaml -c sensor/radar_conti430_preprocess_component.yaml -c perception/traffic_light_component.yaml
 -c perception/traffic_fusion_component.yaml -c perception/camera_extrinsics_monitor_component.yaml -c static_transform.yaml -c statistics.yaml
 -c dag_metric_agent.yaml -c tc_trace.yaml -c compute3d_sched.yaml -p compute3d_sched
"""  # noqa: E501
FILES = (*re.findall(r"-c (\S+)", COMMAND_LINE), "patrol_in_3d.yaml", "monitor_imu_extrinsic_onboard.yaml")
BESIDE = ("planning_sched.yaml", "monitors/gpu_monitor.yaml", "monitors/buddyinfo_monitor.yaml")


@pytest.fixture(scope="module")
def launch_file():
    return load_launch_file(CONF / "launch" / f"{NODE}.launch.yaml")


@pytest.fixture(scope="module")
def profile():
    return load_profile("hw50_pandar90_13_600")


@pytest.fixture(scope="module")
def modules(launch_file, profile):
    return plan_modules(launch_file, CONF, sensors=profile.content.sensor_names)


def test_the_command_line_lists_thirty_files_and_the_launch_file_two_more():
    assert len(re.findall(r"-c ", COMMAND_LINE)) == 30
    assert len(set(FILES)) == 32


@pytest.mark.parametrize("name", [*FILES, *BESIDE])
def test_each_file_is_there_with_a_purpose_of_one_line_and_a_component_behind_it(name):
    path = find_config(name, "modules", CONF)
    assert path.samefile(CONF / "modules" / name)
    module = load_module(path).content
    assert module.module == pathlib.Path(name).stem
    assert module.description.endswith(".")
    assert "\n" not in module.description
    assert len(module.description) > 30
    assert module.components
    for component in module.components:
        assert component.class_name.startswith("warploom.components.") or component.graph


@pytest.mark.parametrize("name", [*FILES, *BESIDE])
def test_each_file_is_good_by_itself(name):
    path = CONF / "modules" / name
    assert check_file(str(path))[0] == f"{path}: module {path.stem!r} is good"


def test_a_topic_of_another_module_is_named_with_it():
    lines = check_file(str(CONF / "modules" / "planning_sched.yaml"))
    assert any(re.fullmatch(r"  reads perception/obstacles, which \w[\w-]* gives", line) for line in lines)


def test_a_topic_that_no_module_gives_is_refused(tmp_path):
    path = tmp_path / "mine.yaml"
    text = (CONF / "modules" / "planning_sched.yaml").read_text()
    path.write_text(text.replace("perception/obstacles", "perception/obstacels"))
    with pytest.raises(ConfigError, match="nobody produces topic 'perception/obstacels'"):
        check_file(str(path))


def test_the_launch_file_starts_the_files_of_the_command_line_in_their_order(launch_file):
    compute, planning = launch_file.content.processes
    assert (compute.name, compute.cgroup) == ("compute3d_sched", "app/compute3d_sched")
    assert compute.exception_handler == "respawn"
    assert tuple(compute.modules) == FILES
    assert planning.modules == ["planning_sched.yaml"]


def test_both_forms_of_the_launch_file_mean_the_same(launch_file):
    xml = load_launch_file(CONF / "launch" / f"{NODE}.launch.xml")
    assert xml.content == launch_file.content


def test_it_is_found_by_its_hardware(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert find_by_hardware(HARDWARE, CONF).name == f"{NODE}.launch.yaml"
    with pytest.raises(ConfigError, match="--hw hw50 --lidar pandar90 --camera 13 --radar conti430"):
        find_by_hardware({**HARDWARE, "lidar": "pandar40"}, CONF)


def test_the_whole_node_builds_in_one_process_and_prepares_nothing(modules, profile, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("validation must not open a source")

    monkeypatch.setattr("warploom.components.sources.open_source", refuse)
    files = [file for group in modules.values() for file in group]
    process = Process(files, context=execution_context(profile, "cpu"), prepare=False)
    assert len(process.components) == 34
    with pytest.raises(RuntimeError, match="was only validated"):
        process.start()


def test_its_processes_are_linked_by_the_obstacles_alone(modules):
    links = plan_links(modules)
    assert links["compute3d_sched"].exports == ("perception/obstacles",)
    assert links["planning_sched"].imports == ("perception/obstacles",)


def test_every_idle_component_names_what_it_is_for(modules):
    idle = [
        component
        for file in modules["compute3d_sched"]
        for component in file.content.components
        if component.class_name.endswith(".IdleComponent")
    ]
    assert len(idle) == 21
    for component in idle:
        assert component.config["purpose"]
        assert component.config["missing"]


def test_what_the_profile_names_is_what_the_hardware_says(profile):
    sensors = profile.content.sensors
    assert [len(sensors[kind]) for kind in ("lidar", "camera")] == [1, 13]
    assert {sensor.model for sensor in sensors["radar"]} == {"conti430"}
    assert sensors["lidar"][0].model == "pandar90"
    assert profile.content.mounting_height == 1.9
    assert all(sensor.mounting is not None for kind in ("lidar", "camera", "radar") for sensor in sensors[kind])


def test_the_perception_of_the_node_is_that_of_the_pipeline(modules, profile):
    """The same vertices with the same settings; only the topics differ, and who takes out the vehicle's own points."""
    path = CONF / "modules" / "perception.yaml"
    shipped = load_module(path, {}, profile.content.sensor_names).content.components
    (node,) = [file.content for file in modules["compute3d_sched"] if file.content.module == "ads50_hesai90_setup"]
    for ours, theirs in zip(node.components, shipped, strict=True):
        assert ours.graph.keys() == theirs.graph.keys()
        for name in ours.graph:
            mine, other = ours.graph[name].model_copy(deep=True), theirs.graph[name].model_copy(deep=True)
            for spec in (mine, other):
                spec.config.pop("ego_box", None)
            assert mine == other, name
        assert ours.outputs == theirs.outputs


def test_the_docs_say_the_purpose_of_each_file(repository):
    table = (repository / "docs" / "node.md").read_text()
    for name in (*FILES, *BESIDE):
        description = load_module(CONF / "modules" / name).content.description
        assert f"| `{name}` | {description} |" in table


@pytest.mark.parametrize("form", ["yaml", "xml"])
def test_the_launch_file_is_checked_as_any_other_file(form):
    path = CONF / "launch" / f"{NODE}.launch.{form}"
    lines = check_file(str(path))
    assert lines[0] == f"{path}: node {NODE!r} is good"
    assert lines[1:] == ["  compute3d_sched: 32 modules", "  planning_sched: 1 modules",
                         "    reads perception/obstacles of another process"]  # fmt: skip


def test_it_goes_by_its_name_too_and_a_mistake_in_it_is_told(tmp_path):
    assert NODE in check_file(NODE)[0]
    path = tmp_path / "mine.launch.yaml"
    text = (CONF / "launch" / f"{NODE}.launch.yaml").read_text()
    path.write_text(text.replace("statistics.yaml", "statistiks.yaml"))
    with pytest.raises(ConfigError, match=r"mine\.launch\.yaml:\d+: .*did you mean 'statistics.yaml'"):
        check_file(str(path))
    path.write_text("hello: 1\n")
    with pytest.raises(ConfigError, match="neither a key 'profile' nor a key 'module' nor a key 'processes'"):
        check_file(str(path))


def test_its_graphs_are_drawn():
    assert "cluster" in draw_file(NODE)
