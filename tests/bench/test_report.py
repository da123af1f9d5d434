"""The report on a run that was made by hand."""

import json
import os
import subprocess
import sys

import pytest

from warploom.bench.report import render, write_report
from warploom.bench.results import merge_measured, read_results


@pytest.fixture
def report_of(run_of):
    return lambda *entries: render(run_of(*entries))


def cells(line):
    return [cell.strip() for cell in line.replace("\\|", "¦").strip("|").split("|")]


def row(text, start, section="Kernels beside"):
    """The first row of a section that starts so, by the heads of its columns; of two of one name the first."""
    lines = text.partition(f"## {section}")[2].splitlines()
    at = next(number for number, line in enumerate(lines) if line.startswith(f"| {start}"))
    head = max(number for number in range(at) if lines[number].startswith("|---"))
    named = {}
    for name, cell in zip(cells(lines[head - 1]), cells(lines[at]), strict=True):
        named.setdefault(name if name not in named else f"{name} of peer", cell)
    return named


def test_a_peer_stands_beside_ours_with_ratio_goal_and_accuracy(report_of, entry):
    text = report_of(
        entry("warploom", 0.005, threads=2, busy_cores=1.74),
        entry("warploom plan", 0.004),
        entry("scipy", 0.250, goal=1 / 80, accuracy="9 clusters, same partition"),
        entry("open3d", 0.010, threads=2),
    )
    assert row(text, "KITTI | 51,000 | cpu | 5.00 | 4.00 | 1.7 | scipy") == {
        "on": "KITTI", "size": "51,000", "device": "cpu", "function [ms]": "5.00", "plan [ms]": "4.00", "cores": "1.7",
        "peer": "scipy", "peer [ms]": "250", "cores of peer": "1", "ratio": "1/50", "goal": "≤ 1/80",
        "reached": "**no**", "accuracy": "9 clusters, same partition",
    }  # fmt: skip
    beside = row(text, "KITTI | 51,000 | cpu | 5.00 | 4.00 | 1.7 | open3d")
    assert [beside[name] for name in ("cores of peer", "ratio", "goal", "reached")] == ["2", "1/2", "", ""]


def test_the_summary_has_what_has_a_goal(report_of, entry):
    text = report_of(
        entry("warploom", 0.003, accuracy="exact"), entry("scipy", 0.250, goal=1 / 80), entry("open3d", 0.1)
    )
    assert "Reached: 1 of 1" in text
    summary = row(text, "cluster", "Goals")
    assert [summary[name] for name in ("ratio", "goal", "reached", "accuracy")] == ["1/83.3", "≤ 1/80", "yes", "exact"]
    assert "open3d" not in text.partition("## Goals")[2].partition("## ")[0]


def test_what_the_host_gave_to_others_is_told_over_all_files(run_of, entry):
    runs = [run_of(entry("warploom", 0.003)) for _ in range(3)]
    assert "stolen" not in render(merge_measured(runs))
    for run, stolen in zip(runs, (1.0, 29.0), strict=False):  # the third is of a machine that does not tell
        run["warploom"]["processor_time"] = {"stolen_s": stolen, "wanted_s": 50.0}
    assert "- stolen: of the processor time that was wanted here meanwhile, the host gave 30% to others" in render(
        merge_measured(runs)
    )


def test_one_thread_has_a_column_where_it_was_timed(report_of, entry):
    text = report_of(
        entry("warploom", 0.003), entry("warploom, 1 thread", 0.006), entry("scipy", 0.1), entry("spconv", 0.1, on="x")
    )
    assert row(text, "KITTI")["1 thread [ms]"] == "6.00"
    assert "it may use 2 (`WARPLOOM_THREADS`)" in text
    assert "1 thread [ms]" not in report_of(entry("warploom", 0.003), entry("scipy", 0.1))


def test_what_was_asked_for_is_said_once(report_of, entry):
    text = report_of(entry("warploom", 0.003, how="steps of 0.5 m"), entry("scipy", 0.1, how="steps of 0.5 m"))
    assert text.count("Steps of 0.5 m.") == 1


def test_the_time_of_a_peer_with_a_timer_of_its_own_is_that_timers(run_of, entry):
    measured = run_of(entry("warploom", 0.002), entry("pypatchworkpp", 0.02, own_timer_s=0.01))
    assert read_results(measured)[1].seconds == 0.01
    beside = row(render(measured), "KITTI")
    assert (beside["peer [ms]"], beside["ratio"]) == ("10.0 †", "1/5")


def test_ours_without_a_peer_and_on_another_device_has_a_row_of_its_own(report_of, entry):
    text = report_of(
        entry("warploom", 0.02, on="street"),
        entry("warploom", 0.001, device="cuda:0"),
        entry("scipy", 0.1, goal=0.01),
    )
    alone = row(text, "street")
    assert (alone["function [ms]"], alone["peer"], alone["ratio"]) == ("20.0", "", "")
    # The goals are those of one CPU beside another.
    on_gpu = row(text, "KITTI | 51,000 | cuda:0")
    assert (on_gpu["ratio"], on_gpu["goal"], on_gpu["reached"], on_gpu["cores"]) == ("1/100", "", "", "")


def test_scores_have_their_difference_and_whether_the_goal_is_reached(report_of):
    score = {
        "name": "mean F1", "on": "KITTI", "ours": 99.42, "theirs": 99.11, "peer": "patchwork", "unit": "%",
        "gain": 0.3, "note": "4 scans", "lower_is_better": False,
    }  # fmt: skip
    below = {**score, "name": "worst scan", "ours": 98.5, "gain": -0.5}
    error = {**score, "name": "error", "unit": "m", "ours": 0.07, "theirs": 0.10, "gain": 0.05, "lower_is_better": True}
    alone = {**error, "name": "all", "theirs": None}
    text = report_of({"stats": {}, "extra_info": {"scores": [score, below, error, alone]}})
    found = [row(text, name, "How right") for name in ("mean", "worst", "error", "all")]
    assert [r["difference"] for r in found] == ["+0.31", "-0.61", "-0.030", ""]
    assert [r["goal"] for r in found] == ["≥ 0.3", "≥ -0.5", "≤ −0.05", ""]
    assert [r["reached"] for r in found] == ["yes", "**no**", "**no**", ""]
    assert [r["ours"] for r in found] == ["99.42 %", "98.50 %", "0.070 m", "0.070 m"]


def test_machine_versions_figures_stages_and_what_was_skipped_are_named(report_of):
    figure = {"name": "peak resident memory", "value": 900.0, "unit": "MiB", "goal": 2048.0, "note": "1000 frames"}
    late = {"name": "first frame, warm", "value": 4.25, "unit": "s", "goal": 4.0, "note": ""}
    text = report_of(
        {"stats": {}, "extra_info": {"figures": [figure, late], "on": "street"}},
        {
            "stats": {},
            "extra_info": {"on": "street", "stages": {"perception.ground": {"run_ms": 3.21, "wait_ms": 0.0}}},
        },
        {
            "stats": {},
            "extra_info": {"on": "cpu", "first_calls": {"cluster": {"cold_s": 2.5, "warm_s": 0.02, "second_s": 0.003}}},
        },
    )
    assert "Example 9000, 2 cores, 8.0 GiB" in text
    assert "2030-01-02" in text
    assert "commit: 0123456789ab and changes" in text
    assert "numpy 2.4.0" in text
    peak = row(text, "peak resident", "The frame and the start")
    assert list(peak.values()) == ["peak resident memory", "900 MiB", "≤ 2048 MiB", "yes", "1000 frames"]
    assert list(row(text, "first frame", "The frame and the start").values())[1:4] == ["4.25 s", "≤ 4 s", "**no**"]
    assert row(text, "perception.ground", "Stages")["own work, median [ms]"] == "3.21"
    assert list(row(text, "cluster", "First calls").values()) == ["cluster", "2.50", "0.0200", "3.00"]
    assert "no CUDA device here: `bench_bev[warploom cuda:0-KITTI]`" in text


def test_every_table_has_as_many_cells_in_each_row_as_in_its_head(report_of, entry):
    text = report_of(entry("warploom", 0.005, accuracy="a | b"), entry("scipy", 0.25, goal=0.1))
    for table in text.replace("\\|", "").split("\n\n"):
        lines = [line for line in table.splitlines() if line.startswith("|")]
        assert len({line.count("|") for line in lines}) <= 1


def test_plots_are_named_in_the_report_and_lie_beside_it(run_of, entry, tmp_path):
    sizes = (10_000, 100_000, 1_000_000)
    names = ("street 10k", "street 120k", "street 500k")
    entries = [entry("warploom", n / 1e7, on=on, size=n) for on, n in zip(names, sizes, strict=True)]
    entries.append(entry("scipy", 1.0, on=names[0], size=sizes[0], goal=1 / 80))
    written = write_report(run_of(*entries), tmp_path / "deep" / "speed.md")
    assert [path.name for path in written] == ["speed.md", "speed-ratios.svg", "speed-cost.svg"]
    text = written[0].read_text(encoding="utf-8")
    for path in written[1:]:
        assert f"]({path.name})" in text
        assert path.read_text(encoding="utf-8").startswith("<svg")
    alone = write_report(run_of(entry("warploom", 1.0)), tmp_path / "alone.md")
    assert [path.name for path in alone] == ["alone.md"]
    assert ".svg" not in alone[0].read_text(encoding="utf-8")


@pytest.mark.parametrize("content", ["{", "{}", "[]", None])
def test_a_file_of_another_kind_is_refused_by_name(content, tmp_path):
    path = tmp_path / "other.json"
    if content is not None:
        path.write_text(content)
    command = [sys.executable, "-m", "warploom.bench.report", str(path), "--out", str(tmp_path / "report.md")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1
    assert "other.json" in done.stderr
    assert not (tmp_path / "report.md").exists()


def test_the_command_writes_the_report(run_of, entry, tmp_path):
    path, out = tmp_path / "benchmark.json", tmp_path / "docs" / "report.md"
    path.write_text(json.dumps(run_of(entry("warploom", 0.005))))
    subprocess.run([sys.executable, "-m", "warploom.bench.report", str(path), "--out", str(out)], check=True)
    assert out.read_text(encoding="utf-8").startswith("# Benchmarks\n")


def test_several_runs_become_one_report(run_of, entry, tmp_path):
    """Ours and its peer may stand in different files."""
    paths = [tmp_path / f"{who}.json" for who in ("warploom", "scipy")]
    for path, run in zip(paths, (entry("warploom", 0.005), entry("scipy", 0.25, goal=0.1)), strict=True):
        path.write_text(json.dumps(run_of(run)))
    out = tmp_path / "report.md"
    command = [sys.executable, "-m", "warploom.bench.report", *map(str, paths), "--out", str(out)]
    subprocess.run(command, check=True)
    assert "1/50" in out.read_text()


def test_a_file_of_benchmarks_that_fails_takes_no_other_along(tmp_path):
    timed = "def bench_it(benchmark):\n    benchmark.extra_info.update(kernel='k', on='x')\n    benchmark(lambda: 1)\n"
    settings = "from warploom.bench.conftest import pytest_benchmark_update_json\n"
    (tmp_path / "conftest.py").write_text(settings)
    (tmp_path / "pytest.ini").write_text("[pytest]\npython_files = bench_*.py\npython_functions = bench_*\n")
    (tmp_path / "bench_good.py").write_text(timed)
    (tmp_path / "bench_half.py").write_text(timed + "def bench_bad(benchmark):\n    raise ValueError('bad')\n")
    (tmp_path / "bench_gone.py").write_text("import no_such_module_at_all\n")
    files = [str(tmp_path / f"bench_{name}.py") for name in ("gone", "half", "good")]
    command = [sys.executable, "-m", "warploom.bench", *files, "--out", str(tmp_path / "b.md"), "--max-time", "0.01"]
    # A worker of xdist is told so by its environment, and pytest-benchmark then measures nothing.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    done = subprocess.run(
        [*command, "--keep", str(tmp_path / "keep")], capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 1
    assert "bench_gone: " in done.stdout
    assert done.stdout.count("pytest ended with") == 2
    assert (tmp_path / "b.md").read_text().startswith("# Benchmarks")
    assert sorted(path.name for path in (tmp_path / "keep").glob("*.json")) == ["bench_good.json", "bench_half.json"]
