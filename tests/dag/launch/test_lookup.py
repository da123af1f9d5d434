"""Launch files by name and by hardware."""

import pytest

from warploom.dag.launch.lookup import CommandLine, find_by_hardware, find_launch_file, launch_files, load_launch_file
from warploom.errors import ConfigError


@pytest.fixture
def shipped(tmp_path, monkeypatch):
    """A conf folder with three launch files whose names say nothing."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("WARPLOOM_CONF", raising=False)
    folder = tmp_path / "shipped" / "launch"
    folder.mkdir(parents=True)
    text = "node: {0}\nhardware: {{hw: {1}, lidar: {2}, camera: {3}}}\nprocesses: [{{name: p, modules: [m]}}]\n"
    (folder / "alpha.launch.yaml").write_text(text.format("alpha", "hw50", "pandar90", 13))
    (folder / "beta.launch.yaml").write_text(text.format("beta", "hw50", "pandar64", 7))
    (folder / "gamma.launch.xml").write_text(
        "<cybertron><hardware><hw>hw60</hw></hardware><module><name>p</name><dag_conf>m</dag_conf></module></cybertron>"
    )
    (folder / "plain.launch.yaml").write_text("node: plain\nprocesses: [{name: p, modules: [m]}]\n")
    return tmp_path / "shipped"


def test_a_file_is_found_by_what_its_header_says(shipped):
    assert find_by_hardware({"hw": "hw50", "lidar": "pandar90", "camera": "13"}, shipped).name == "alpha.launch.yaml"
    assert find_by_hardware({"lidar": "pandar64"}, shipped).name == "beta.launch.yaml"
    assert find_by_hardware({"hw": "hw60"}, shipped).name == "gamma.launch.xml"


def test_what_fits_none_is_told_with_all_that_there_is(shipped):
    with pytest.raises(ConfigError) as error:
        find_by_hardware({"hw": "hw50", "lidar": "pandar9"}, shipped)
    text = str(error.value)
    assert "no launch file is for --hw hw50 --lidar pandar9; there are:" in text
    assert f"--hw hw50 --lidar pandar90 --camera 13   ({shipped}/launch/alpha.launch.yaml)" in text
    assert "--lidar pandar9: did you mean 'pandar90'" in text


def test_what_fits_several_is_told_with_them(shipped):
    with pytest.raises(ConfigError, match="--hw hw50 fits 2 launch files; say more") as error:
        find_by_hardware({"hw": "hw50"}, shipped)
    assert "alpha" in str(error.value)
    assert "gamma" not in str(error.value)


def test_a_broken_file_does_not_hide_the_others_and_is_named(shipped):
    (shipped / "launch" / "broken.launch.yaml").write_text("hardware: {hw: [1\n")
    assert find_by_hardware({"lidar": "pandar64"}, shipped).name == "beta.launch.yaml"
    with pytest.raises(ConfigError, match=r"not readable: .*broken\.launch\.yaml"):
        find_by_hardware({"hw": "none"}, shipped)


def test_a_file_nested_too_deep_is_broken(shipped):
    (shipped / "launch" / "broken.launch.yaml").write_text("hardware: " + 5000 * "[")
    with pytest.raises(ConfigError, match=r"not readable: .*broken\.launch\.yaml"):
        find_by_hardware({"hw": "none"}, shipped)


def test_a_file_of_ones_own_covers_a_shipped_one_of_its_name(shipped, tmp_path):
    own = tmp_path / "conf" / "launch"
    own.mkdir(parents=True)
    (own / "alpha.launch.yaml").write_text("node: mine\nprocesses: [{name: p, modules: [m]}]\n")
    assert load_launch_file(find_launch_file("alpha", shipped)).content.node == "mine"
    with pytest.raises(ConfigError, match="no launch file is for"):
        find_by_hardware({"lidar": "pandar90"}, shipped)
    assert sorted(launch_files(shipped)) == ["alpha", "beta", "gamma", "plain"]


@pytest.mark.parametrize("name", ["beta", "beta.launch.yaml", "beta.yaml"])
def test_a_file_is_found_by_its_name(shipped, name):
    assert find_launch_file(name, shipped) == shipped / "launch" / "beta.launch.yaml"


def test_a_name_that_is_none_is_told_with_the_nearest(shipped, tmp_path):
    with pytest.raises(ConfigError, match="no launch file 'betta': neither a file nor a name; did you mean 'beta'"):
        find_launch_file("betta", shipped)
    with pytest.raises(ConfigError, match="there is no such file"):
        find_launch_file(str(tmp_path / "x.launch.yaml"), shipped)
    for long in (5000 * "a", "a\0b", 5000 * "a" + ".launch.xml"):
        with pytest.raises(ConfigError, match="no launch file '"):
            find_launch_file(long, shipped)


def test_two_processes_of_one_name_are_refused(tmp_path):
    path = tmp_path / "x.launch.yaml"
    path.write_text("node: n\nprocesses:\n  - {name: p, modules: [m]}\n  - {name: p, modules: [m]}\n")
    with pytest.raises(ConfigError, match=r"x.launch.yaml:4: processes.1.name: there is a process 'p' already"):
        load_launch_file(path)


def test_settings_reach_a_process_by_its_name_or_number(shipped):
    path = shipped / "launch" / "beta.launch.yaml"
    file = load_launch_file(path, {("processes", "p", "nice"): 5, ("processes", "0", "cpus"): [1]})
    assert (file.content.processes[0].nice, file.content.processes[0].cpus) == (5, [1])
    with pytest.raises(ConfigError, match=r"setting launch\.processes\.q\.nice: no process 'q'"):
        load_launch_file(path, {("processes", "q", "nice"): 5})
    with pytest.raises(ConfigError, match=r"\(as set from outside the file\): .*19"):
        load_launch_file(path, {("processes", "p", "nice"): 50})


def test_the_command_line_is_a_launch_file_of_one_process():
    line = CommandLine("compute", ["a.yaml", "b.yaml"], {("processes", "compute", "nice"): 4})
    assert line.content.node == "compute"
    assert line.content.processes[0].modules == ["a.yaml", "b.yaml"]
    assert line.content.processes[0].nice == 4
    assert str(line.error(["processes", 0, "modules", 1], "is bad")) == "-c b.yaml: is bad"
    with pytest.raises(ConfigError, match="a name is"):
        CommandLine("a/b", ["a.yaml"])
