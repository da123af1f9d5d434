import pytest

from warploom.dag.configuration import ConfigFile
from warploom.dag.launch.schema import HardwareSpec, LaunchSpec, ProcessSpec
from warploom.errors import ConfigError

GOOD = """\
node: one
hardware: {hw: hw50, lidar: pandar90, camera: 13, radar: conti430}
processes:
  - name: compute
    type: energon
    modules: [a.yaml]
    cgroup: /app/compute
    environment: {OMP_NUM_THREADS: 2}
"""


def load(tmp_path, text):
    path = tmp_path / "x.launch.yaml"
    path.write_text(text, encoding="utf-8")
    return ConfigFile(path, LaunchSpec)


def test_a_launch_file_is_read(tmp_path):
    spec = load(tmp_path, GOOD).content
    process = spec.processes[0]
    assert (process.type, process.cgroup, process.environment) == ("warploom", "app/compute", {"OMP_NUM_THREADS": "2"})
    assert spec.hardware == HardwareSpec(hw="hw50", lidar="pandar90", camera="13", radar="conti430")
    assert spec.hardware.described() == "--hw hw50 --lidar pandar90 --camera 13 --radar conti430"
    assert (process.exception_handler, process.restarts.limit, process.back_off.factor) == ("respawn", 5, 2.0)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("node: one", "nodee: one", r":1: nodee: unknown key; did you mean 'node'\?"),
        ("node: one", "node: ../up", r":1: node: a name is 1 to 64 letters"),
        ("    type: energon", "    type: energonn", r":5: processes.0.type: .*'warploom', found 'energonn'"),
        ("modules: [a.yaml]", "modules: []", r":6: processes.0.modules: "),
        ("modules: [a.yaml]", "module: [a.yaml]", r"processes.0.module: unknown key; did you mean 'modules'"),
        ("/app/compute", "app/../../system", r":7: processes.0.cgroup: a cgroup is a path below the root"),
        ("OMP_NUM_THREADS: 2", "OMP_NUM_THREADS: [2]", r":8: .*must be a text or a number"),
        ("OMP_NUM_THREADS: 2", "A=B: 2", r"a text without '='"),
        ("camera: 13", "cameras: 13", r":2: hardware.cameras: unknown key; did you mean 'camera'"),
        ("    cgroup", "    nice: 77\n    cgroup", r":7: processes.0.nice: .*19, found 77"),
        ("    cgroup", "    cpus: [0, -1]\n    cgroup", r":7: processes.0.cpus: a CPU is a number"),
        ("    cgroup", "    exception_handler: restart\n    cgroup", r":7: .*'respawn', 'exit' or 'ignore'"),
        ("    cgroup", "    restarts: {limits: 3}\n    cgroup", r":7: .*did you mean 'limit'"),
        ("    cgroup", "    health_timeout: 3\n    cgroup", r":7: .*did you mean 'health_timeout_s'"),
        ("    cgroup", "    nice: true\n    cgroup", r":7: processes.0.nice: expected no true"),
        ("    cgroup", "    health_timeout_s: false\n    cgroup", r":7: .*health_timeout_s: expected no false"),
        ("    cgroup", "    cpus: [true]\n    cgroup", r":7: processes.0.cpus"),
        ("    cgroup", '    process_name: "a\\0b"\n    cgroup', r":7: processes.0.process_name: .* can be shown"),
        ("OMP_NUM_THREADS: 2", 'A: "b\\0c"', r":8: .*A must not have a character 0"),
        ("processes:", "zenoh: {listen: [7447]}\nprocesses:", r":3: zenoh.listen"),
        ("processes:", "zenoh: {listen: ['127.0.0.1:7447']}\nprocesses:", r":3: zenoh.listen: .* such as tcp/"),
        ("processes:", "zenoh: {connect: ['']}\nprocesses:", r":3: zenoh.connect: .* such as tcp/"),
        ("processes:", "shared_memory: {memory_bytes: 18446744073709551616}\nprocesses:", r":3: .*memory_bytes: "),
        ("processes:", "remote: {t: dds}\nprocesses:", r":3: remote.t: .*'zenoh', found 'dds'"),
    ],
)
def test_each_mistake_names_file_line_key_and_what_was_expected(tmp_path, old, new, expected):
    assert old in GOOD
    with pytest.raises(ConfigError, match=r"x\.launch\.yaml" + ".*" + expected):
        load(tmp_path, GOOD.replace(old, new))


def test_names_become_files_and_are_kept_short():
    for name in ("", "a/b", "..", ".hidden", "a b", "x" * 65, "é"):
        with pytest.raises(ValueError, match="a name is"):
            ProcessSpec(name=name, modules=["m"])
