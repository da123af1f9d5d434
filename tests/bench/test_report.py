"""The report on a run that was made by hand."""

import copy
import json
import subprocess
import sys

import pytest

from warploom.bench.report import read_results, render

MEASURED = {
    "datetime": "2030-01-02T03:04:05+00:00",
    "commit_info": {"id": "0123456789abcdef", "dirty": True},
    "warploom": {
        "machine": {
            "processor": "Example 9000", "cores": 2, "memory_gib": 8.0, "system": "Linux x86_64", "python": "3.12.1",
            "devices": ["cpu"], "versions": {"numpy": "2.4.0"},
        },
        "skipped": {"bench_bev[warploom cuda:0-KITTI]": "no CUDA device here"},
    },
    "benchmarks": [],
}  # fmt: skip


def entry(who, seconds, **more):
    info = {"kernel": "cluster", "on": "KITTI", "size": 51_000, "who": who, "device": "cpu", "threads": 1}
    return {"stats": {"median": seconds}, "extra_info": {**info, "accuracy": "", **more}}


def report_of(*entries):
    return render({**copy.deepcopy(MEASURED), "benchmarks": list(entries)})


def row(text, start):
    line = next(line for line in text.splitlines() if line.startswith(f"| {start}"))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_a_peer_stands_beside_ours_with_ratio_goal_and_accuracy():
    text = report_of(
        entry("warploom", 0.005),
        entry("warploom plan", 0.004),
        entry("scipy", 0.250, goal=1 / 80, accuracy="9 clusters, same partition"),
        entry("open3d", 0.010, threads=2),
    )
    assert row(text, "KITTI | 51,000 | cpu | 5.00 | 4.00 | scipy") == [
        "KITTI", "51,000", "cpu", "5.00", "4.00", "scipy", "1", "250", "1/50", "≤ 1/80", "**no**",
        "9 clusters, same partition",
    ]  # fmt: skip
    assert row(text, "KITTI | 51,000 | cpu | 5.00 | 4.00 | open3d")[6:11] == ["2", "10.0", "1/2", "", ""]


def test_a_goal_that_is_reached_is_said():
    text = report_of(entry("warploom", 0.003), entry("scipy", 0.250, goal=1 / 80))
    assert row(text, "KITTI")[8:11] == ["1/83.3", "≤ 1/80", "yes"]


def test_the_time_of_a_peer_with_a_timer_of_its_own_is_that_timers():
    measured = {**MEASURED, "benchmarks": [entry("warploom", 0.002), entry("pypatchworkpp", 0.02, own_timer_s=0.01)]}
    assert read_results(measured)[1].seconds == 0.01
    assert row(render(measured), "KITTI")[7:9] == ["10.0 †", "1/5"]


def test_ours_without_a_peer_and_on_another_device_has_a_row_of_its_own():
    text = report_of(
        entry("warploom", 0.02, on="street"),
        entry("warploom", 0.001, device="cuda:0"),
        entry("scipy", 0.1, goal=0.01),
    )
    assert row(text, "street")[2:9] == ["cpu", "20.0", "", "", "", "", ""]
    # The goals are those of one CPU beside another.
    assert row(text, "KITTI | 51,000 | cuda:0")[8:11] == ["1/100", "", ""]


def test_machine_versions_figures_stages_and_what_was_skipped_are_named():
    figure = {"name": "peak resident memory", "value": 900.0, "unit": "MiB", "goal": 2048.0, "note": "1000 frames"}
    late = {"name": "first frame, warm", "value": 4.25, "unit": "s", "goal": 4.0, "note": ""}
    text = report_of(
        {"stats": {}, "extra_info": {"figures": [figure, late], "on": "street"}},
        {
            "stats": {},
            "extra_info": {"on": "street", "stages": {"perception.ground": {"run_ms": 3.21, "wait_ms": 0.0}}},
        },
        {"stats": {}, "extra_info": {"first_calls": {"cluster": {"cold_s": 2.5, "warm_s": 0.02, "second_s": 0.003}}}},
    )
    assert "Example 9000, 2 cores, 8.0 GiB" in text
    assert "2030-01-02" in text
    assert "commit: 0123456789ab and changes" in text
    assert "numpy 2.4.0" in text
    assert row(text, "peak resident") == ["peak resident memory", "900 MiB", "≤ 2048 MiB", "yes", "1000 frames"]
    assert row(text, "first frame")[1:4] == ["4.25 s", "≤ 4 s", "**no**"]
    assert row(text, "perception.ground")[1] == "3.21"
    assert row(text, "cluster") == ["cluster", "2.50", "0.0200", "3.00"]
    assert "no CUDA device here: `bench_bev[warploom cuda:0-KITTI]`" in text


def test_every_table_has_as_many_cells_in_each_row_as_in_its_head():
    text = report_of(entry("warploom", 0.005, accuracy="a | b"), entry("scipy", 0.25, goal=0.1))
    table = [line.replace("\\|", "") for line in text.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in table}) == 1


@pytest.mark.parametrize("content", ["{", "{}"])
def test_a_file_of_another_kind_is_refused_by_name(content, tmp_path):
    path = tmp_path / "other.json"
    path.write_text(content)
    command = [sys.executable, "-m", "warploom.bench.report", str(path), "--out", str(tmp_path / "report.md")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1
    assert "other.json" in done.stderr
    assert not (tmp_path / "report.md").exists()


def test_the_command_writes_the_report(tmp_path):
    path, out = tmp_path / "benchmark.json", tmp_path / "docs" / "report.md"
    path.write_text(json.dumps({**MEASURED, "benchmarks": [entry("warploom", 0.005)]}))
    subprocess.run([sys.executable, "-m", "warploom.bench.report", str(path), "--out", str(out)], check=True)
    assert out.read_text(encoding="utf-8").startswith("# Benchmarks\n")
