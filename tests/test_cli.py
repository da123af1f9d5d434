"""The command as a user runs it: outputs, messages, exit codes."""

import io
import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

EXAMPLES = pathlib.Path(__file__).resolve().parent.parent / "examples"


@pytest.fixture(scope="module")
def scans(tmp_path_factory) -> pathlib.Path:
    """A folder of four scans, the second truncated."""
    import warploom as wl

    folder = tmp_path_factory.mktemp("scans")
    for frame in wl.read("sim:street?seed=5&duration=0.4"):
        frame.points.tofile(folder / f"{frame.index:06d}.bin")
    whole = (folder / "000001.bin").read_bytes()
    (folder / "000001.bin").write_bytes(whole[:-7])
    return folder


def test_the_installed_command_runs():
    """The one test of the entry point itself, in a process of its own."""
    command = [pathlib.Path(sys.executable).with_name("warploom"), "graph"]
    assert "module perception" in subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_demo_writes_objects_report_recording_and_picture(warploom, tmp_path):
    output = warploom("--log-dir", "logs", "demo", "--seconds", "0.5", "--out", "out", "--trace", "out/trace.json")
    assert "whole frame" in output
    assert "ground F1" in output
    lines = (tmp_path / "out" / "objects.jsonl").read_text().splitlines()
    assert len(lines) == 5
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["frames"] == 5
    assert report["ground_f1"] > 0.9
    assert report["latency_ms"]["total"]["median"] > 0
    total = report["latency_ms"]["total"]
    assert total["median"] <= total["p90"] <= total["p99"] <= total["max"]
    assert report["metrics"]["latency_ms"]["perception/obstacles"]["count"] == 5
    assert report["metrics"]["runs"]["tracking.track"] == {"ok": 5}
    assert report["trace"]["events_dropped"] == 0
    assert {event["ph"] for event in json.loads((tmp_path / "out" / "trace.json").read_text())} >= set("MXbestfC")
    assert len(list((tmp_path / "logs").glob("warploom-*.log"))) == 1
    assert (tmp_path / "out" / "run.mcap").stat().st_size > 1000
    assert (tmp_path / "out" / "frame.png").read_bytes().startswith(b"\x89PNG")


def test_run_keeps_the_frames_around_a_truncated_one_and_reports_it(warploom, scans, tmp_path):
    warploom("run", "--source", f"kitti:{scans}", "--out", "out")
    records = [json.loads(line) for line in (tmp_path / "out" / "objects.jsonl").read_text().splitlines()]
    assert [record["frame"] for record in records] == [0, 2, 3]
    keys = ["version", "frame", "objects", "missing_inputs", "frame_id", "velocity_reference", "latency_ms"]
    assert list(records[0]) == keys
    skipped = json.loads((tmp_path / "out" / "report.json").read_text())["frames_skipped"]
    assert len(skipped) == 1
    assert "000001.bin" in skipped[0]["path"]


def test_the_same_run_twice_gives_the_same_objects(warploom, scans, tmp_path):
    for out in ("a", "b"):
        warploom("run", "--source", scans, "--out", out, "--no-mcap")

    def without_latency(name):
        records = [json.loads(line) for line in (tmp_path / name / "objects.jsonl").read_text().splitlines()]
        return [{key: value for key, value in record.items() if key != "latency_ms"} for record in records]

    assert without_latency("a") == without_latency("b")


def test_frames_limits_the_run(warploom, scans, tmp_path):
    warploom("run", "--source", scans, "--out", "out", "--frames", 1, "--no-mcap")
    assert len((tmp_path / "out" / "objects.jsonl").read_text().splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["run"], 2, "Missing option '--source'"),
        (["run", "--source", "nowhere.bin"], 2, "nowhere.bin"),
        (["run", "--source", "bogus:thing"], 2, "unknown scheme"),
        (["run", "--source", "sim:street?seeed=1"], 2, "did you mean 'seed'"),
        (["run", "--source", "sim:street", "--profile", "nope"], 2, "no profile 'nope'"),
        (["run", "--source", "sim:street", "--device", "cuda:9"], 2, "no device 'cuda:9'"),
        (["run", "--source", "sim:street", "--set", "perception.cluster.radius"], 2, "expected key=value"),
        (["run", "--source", "sim:street", "--set", "perception.cluster.radius=-2"], 2, "greater than 0"),
        (["check", "missing.yaml"], 2, "there is no such file"),
        (["graph", "perception", "--format", "jpeg"], 2, "neither text nor mermaid nor svg"),
        (["--log-level", "loud", "info"], 2, "none of debug"),
        (["head", "train", "--out", "x", "--minutes", "1", "--iterations", "2"], 2, "either minutes or iterations"),
        (["head", "train", "--all"], 0, "--learning-rate"),
        (["head", "train", "--out", "x", "--start-from", "pillar", "--iterations", "2"], 2, "pillar is not there"),
        (["head", "show", "pillar_center_int8"], 0, "name: pillar_center_int8"),
        (["head", "import", "yolo", "x.onnx"], 2, "no importer 'yolo'; there are: pointpillars"),
        (["eval", "detection", "--data", "sim:street", "--head", "pillar"], 2, "pillar: cannot read the head's card"),
        (["eval", "detection", "--data", "sim:street", "--score", "0.3", "--score", "7"], 2, "from 0 to 1, not 7"),
        (["eval", "detection", "--data", "sim:street", "--score", "nan"], 2, "from 0 to 1, not nan"),
        (
            ["eval", "detection", "--data", "sim:street", "--out", "/dev/null"],
            1,
            "/dev/null: the folder cannot be made",
        ),
    ],
)
def test_bad_usage_says_what_and_ends_with_its_code(warploom, arguments, code, message):
    assert message in " ".join(warploom(*arguments, expect=code).split())


@pytest.mark.parametrize(
    ("providers", "code", "message"),
    [
        ("[tensorrt, cpu]", 0, "no provider tensorrt here"),
        ("[cuda]", 2, "add cpu to fall back"),
        ("[gpu]", 2, "'cuda'"),
    ],
)
def test_heads_are_evaluated_where_the_profile_says(warploom, tmp_path, providers, code, message):
    profile = tmp_path / "mine.yaml"
    profile.write_text(
        f"profile: mine\nmodules: [perception]\nsettings: {{perception.detect.providers: {providers}}}\n"
    )
    scene = "sim:scenes?seeds=500&lidar=vlp16"
    out = ["--out", str(tmp_path / "out"), "--pictures", "0"]
    said = warploom("eval", "detection", "--profile", str(profile), "--data", scene, *out, expect=code)
    assert message in " ".join(said.split())
    if not code:
        assert message in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize(("missing", "arguments"), [
    ("torch", ["head", "import", "pointpillars", "x.pth"]),
    ("torch", ["head", "import", "fcn3d", "x.npz"]),
    ("torch", ["head", "import", "twinlitenet", "x.pth"]),
    ("onnx", ["head", "quantize"]),
    ("pytest", ["bench", "--filter", "voxelize"]),
])  # fmt: skip
def test_what_needs_an_extra_names_it(missing, arguments, tmp_path):
    """In a process of its own, in which the library cannot be imported."""
    (tmp_path / "sitecustomize.py").write_text(
        "import importlib.machinery as machinery\n"
        "find = machinery.PathFinder.find_spec\n"
        "machinery.PathFinder.find_spec = staticmethod(\n"
        f"    lambda name, *more: None if name.split('.')[0] == '{missing}' else find(name, *more)\n)\n"
    )
    run = subprocess.run(
        [pathlib.Path(sys.executable).with_name("warploom"), *arguments],
        env=os.environ | {"PYTHONPATH": str(tmp_path)}, cwd=tmp_path, capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode == 2
    assert "Traceback" not in run.stderr
    extra = "bench" if missing == "pytest" else "torch"
    assert f"{missing}, which is not installed: pip install 'warploom[{extra}]'" in run.stderr


def test_a_recording_of_which_nothing_can_be_read_is_a_run_that_failed(warploom, tmp_path):
    (tmp_path / "scan.bin").write_bytes(b"seven b")
    assert "scan.bin" in warploom("run", "--source", "scan.bin", expect=1)


def test_a_wrong_key_in_a_module_file_names_file_line_and_the_nearest_key(warploom, tmp_path):
    (tmp_path / "mine.yaml").write_text(
        "module: mine\ncomponents:\n  - name: a\n    kind: dag\n    trigger: sensor\n"
        "    inputs: {sensor: lidar/points}\n"
        "    graph:\n      filter:\n        processor: warploom.components.perception.FilterProcessor\n"
        "        config:\n          point_rnage: [0, 0, 0, 1, 1, 1]\n"
    )
    output = warploom("check", "mine.yaml", expect=2)
    assert (
        "mine.yaml:11: components.0.graph.filter.config.point_rnage: unknown key; did you mean 'point_range'" in output
    )


def test_check_accepts_what_ships(warploom):
    assert "is good" in warploom("check", "cpu")
    assert "is good" in warploom("check", "perception")


def test_graph_draws_text_and_mermaid(warploom):
    text = warploom("graph")
    assert "filtered -> [ground] -> ground" in text
    mermaid = warploom("graph", "perception", "--format", "mermaid")
    assert mermaid.startswith("flowchart")
    assert "c_perception_filter -- filtered --> c_perception_ground" in mermaid


def test_graph_draws_a_picture_of_a_module_or_a_whole_profile(warploom):
    import xml.etree.ElementTree as ET

    for name in ("perception", "cpu", "gpu"):
        picture = ET.fromstring(warploom("graph", name, "--format", "svg"))
        texts = {text.text for text in picture.iter("{http://www.w3.org/2000/svg}text")}
        assert {"lidar/points", "filter", "track", "perception (dag)", "perception/obstacles"} <= texts


def test_a_recorded_run_is_replayed_and_played(warploom, monkeypatch):
    output = warploom("record", "--source", "sim:street?seed=7&duration=0.5", "--out", "a.mcap")
    assert "a.mcap: 5 frames, 30 commits" in output
    output = warploom("replay", "a.mcap", "--verify", "--workers", 1, "--workers", 2, "--workers", 8)
    assert output.count("bit-exact: all 15 commits have the recorded hashes") == 3
    assert "8 workers: given 5 of camera/objects, 5 of lidar/points, 5 of radar/objects" in output
    output = warploom("replay", "a.mcap", "--verify", "--set", "perception.cluster.min_size=11", expect=1)
    assert "NOT bit-exact" in output
    assert "differs" in output
    output = warploom("play", "a.mcap", "--fast", "--seek", 0.2, "--loop", 2, "--topic", "lidar/points")
    assert "played 6 of lidar/points" in output
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n\nq\n"))
    output = warploom("play", "a.mcap", "--step", "--topic", "perception/obstacles")
    assert "played 2 of perception/obstacles" in output, "one for each Enter; the third was a q"
    assert warploom("info", "a.mcap").count("warploom.SensorFrame") == 1


@pytest.mark.parametrize("command", ["replay", "play"])
def test_a_file_that_is_no_recording_is_refused(warploom, tmp_path, command):
    (tmp_path / "a.mcap").write_bytes(b"nothing")
    assert "a.mcap: is no recording that" in warploom(command, "a.mcap", expect=1)
    assert "No such file" in warploom(command, "b.mcap", expect=1)


def test_info_tells_the_machine_or_what_a_file_holds(warploom, scans):
    assert "warp-lang" in warploom("info")
    assert "4" in warploom("info", scans)


def commands(group, path=()):
    """The words of every command of a group, of its groups too."""
    for name, command in group.commands.items():
        yield from commands(command, (*path, name)) if hasattr(command, "commands") else [(*path, name)]


def test_every_command_has_help_with_an_example(warploom):
    import typer

    from warploom.cli import app

    words = list(commands(typer.main.get_command(app)))
    assert {("run",), ("eval", "detection"), ("head", "show")} < set(words)
    for each in words:
        assert "Example:" in warploom(*each, "--help"), each


def test_the_example_of_an_own_processor_runs():
    command = [sys.executable, str(EXAMPLES / "own_processor" / "run.py")]
    output = subprocess.run(command, capture_output=True, text=True, check=True, cwd="/").stdout
    assert len(output.splitlines()) == 10
    assert "the nearest at" in output


def test_the_example_of_your_scans_runs(scans, tmp_path):
    np.save(tmp_path / "scan.npy", np.fromfile(scans / "000000.bin", np.float32).reshape(-1, 4))
    command = [sys.executable, str(EXAMPLES / "your_scans.py"), str(tmp_path / "scan.npy")]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "clusters" in output


@pytest.mark.parametrize(
    ("command", "number"), [("record", signal.SIGTERM), ("run", signal.SIGHUP), ("record", signal.SIGINT)]
)
def test_what_is_ended_by_a_signal_finishes_what_it_writes(warploom, tmp_path, command, number):
    from warploom.datamesh.recording_reader import Recording

    out = tmp_path / ("a.mcap" if command == "record" else "out")
    file = out if command == "record" else out / "run.mcap"
    one = subprocess.Popen(
        [sys.executable, "-c", "from warploom.cli import main; main()", command, "--realtime",
         "--source", "sim:street?duration=60", "--out", str(out)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    try:
        end = time.monotonic() + 120
        while not file.exists() or file.stat().st_size < 100_000:
            assert one.poll() is None, one.communicate()
            assert time.monotonic() < end
            time.sleep(0.05)
        one.send_signal(number)
        _, errors = one.communicate(timeout=60)
    finally:
        one.kill()
    assert one.returncode == 128 + number, errors
    assert "Traceback" not in errors
    assert "messages: " in warploom("info", str(file))
    if command == "record":
        assert Recording(file).broken is None


def test_a_recording_that_broke_off_is_a_command_that_failed(warploom, tmp_path, monkeypatch):
    from warploom.components import recording

    (tmp_path / "a.mcap").write_bytes(b"")
    summary = recording.RecordSummary(tmp_path / "a.mcap", 5, failure="No space left on device")
    monkeypatch.setattr(recording, "record_source", lambda *_, **__: summary)
    output = warploom("record", "--source", "sim:street", "--out", "a.mcap", expect=1)
    assert "the recording broke off: No space left on device" in output
