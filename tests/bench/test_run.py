"""`warploom bench`, run as its users run it: in a process of its own, far from the checkout."""

import importlib.util
import json
import os
import pathlib
import re
import subprocess
import sys

import pytest

from warploom.bench.run import run_benchmarks
from warploom.errors import ConfigError, DeviceError


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Runs the command in a folder of its own, whose own settings for pytest would break it."""
    folder = tmp_path_factory.mktemp("bench")
    (folder / "pytest.ini").write_text("[pytest]\naddopts = --no-such-option\n")

    def run(*arguments, expect=0, **environment):
        command = [sys.executable, "-c", "from warploom.cli import main; main()", "bench", *map(str, arguments)]
        # A worker of xdist is told so by its environment, and pytest-benchmark then measures nothing.
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
        environment = {**inherited, "COLUMNS": "250", **environment}
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        assert done.returncode == expect, done.stdout + done.stderr
        return " ".join((done.stdout + done.stderr).split())

    run.folder = folder
    return run


@pytest.fixture(scope="module")
def first(bench):
    """What a short run printed, and its JSON."""
    output = bench("--filter", "kalman 30-", "--filter", "launch[", "--quick", "--out", "first")
    return output, json.loads((bench.folder / "first" / "benchmark.json").read_text())


def test_the_filters_choose_by_words_and_cpu_is_where_ours_computes(first):
    names = {entry["name"] for entry in first[1]["benchmarks"]}
    assert names == {
        "bench_kalman[30-warploom cpu]",
        "bench_kalman[30-warploom plan cpu]",
        "bench_kalman[30-numpy, batched]",
        "bench_kalman[30-numpy, track by track]",
        "bench_launch[launch-cpu]",
        "bench_launch[recorded-cpu]",
    }


def test_every_filter_that_the_documents_name_chooses_something(bench):
    """By collecting alone, which measures nothing."""
    root = pathlib.Path(__file__).resolve().parents[2]
    texts = [path.read_text() for path in (root / "README.md", *sorted((root / "docs").glob("*.md")))]
    filters = sorted({found for text in texts for found in re.findall(r"warploom bench --filter (\w+)", text)})
    assert {"heads", "simulator", "tracking"} <= set(filters)
    code = (
        "import sys, pytest\n"
        "from unittest.mock import Mock\n"
        "from warploom.bench import run\n"
        "class Each:\n"
        "    @pytest.hookimpl(tryfirst=True)\n"
        "    def pytest_collection_modifyitems(self, items):\n"
        "        for text in sys.argv[1:]:\n"
        "            one = run._Selection([text], 'cpu', False, Mock())\n"
        "            print('CHOSEN', text, sum(one._wants(item) for item in items))\n"
        "options = ['--collect-only', '-q', '-p', 'no:cacheprovider', '--import-mode=importlib', '-c', 'none.ini']\n"
        "pytest.main([str(run._FOLDER), '--rootdir', str(run._FOLDER), *options], plugins=[Each()])\n"
    )
    (bench.folder / "none.ini").write_text("[pytest]\npython_files = bench_*.py\npython_functions = bench_*\n")
    command = [sys.executable, "-c", code, *filters]
    said = subprocess.run(command, cwd=bench.folder, capture_output=True, text=True, check=False).stdout
    counts = dict(re.findall(r"CHOSEN (\w+) (\d+)", said))
    assert set(counts) == set(filters), said[-2000:]
    assert "0" not in counts.values(), counts


def test_times_stand_in_a_table_beside_the_peers_and_in_a_report(first, bench):
    output, measured = first
    assert "numpy, batched" in output
    assert "launch of a kernel, cpu" in output
    report = (bench.folder / "first" / "benchmarks.md").read_text(encoding="utf-8")
    assert "### kalman" in report
    ours = next(e["extra_info"] for e in measured["benchmarks"] if e["extra_info"].get("who") == "warploom")
    assert ours["threads"] >= 1
    assert 0 < ours["busy_cores"] < 128


def test_an_earlier_run_stands_beside_the_new_one(first, bench):
    measured = json.loads(json.dumps(first[1]))
    for entry in measured["benchmarks"]:
        if entry["extra_info"].get("who") == "warploom":
            entry["stats"]["median"] /= 1000  # the function was a thousand times faster then
        if entry["extra_info"].get("who") == "warploom plan":
            entry["stats"]["median"] *= 1000
    (bench.folder / "old.json").write_text(json.dumps(measured))
    output = bench("--filter", "kalman 30-", "--quick", "--compare", "old.json", "--out", "second")
    assert "since the earlier run" in output
    assert "1 of 2 slower by more than 20%" in output
    assert "ratios to the peers" in output


def test_a_name_that_no_benchmark_has_ends_with_2_and_those_that_there_are(bench):
    assert "no benchmark's name has 'abacus'; there are bev, chain, " in bench("--filter", "abacus", expect=2)


def test_where_nothing_could_be_measured_it_says_why(bench):
    output = bench("--filter", "launch_parts", "--out", "none", expect=1, WARPLOOM_THREADS="1")
    assert "nothing was measured: one CPU thread is all that there is" in output


def test_an_earlier_run_of_another_kind_is_refused_by_name(tmp_path):
    with pytest.raises(ConfigError, match=r"missing\.json: cannot be read"):
        run_benchmarks(compare=tmp_path / "missing.json", out=tmp_path / "out")
    (tmp_path / "other.json").write_text('{"benchmarks": []}')
    with pytest.raises(ConfigError, match=r"other\.json: has no keys"):
        run_benchmarks(compare=tmp_path / "other.json", out=tmp_path / "out")


def test_a_device_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(DeviceError, match="no device 'cuda:9'"):
        run_benchmarks(device="cuda:9", out=tmp_path)


@pytest.mark.parametrize("missing", ["pytest", "pytest_benchmark"])
def test_what_it_needs_and_how_to_get_it_is_said(missing, monkeypatch, tmp_path):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: None if name == missing else find(name, *more))
    with pytest.raises(ConfigError, match=rf"needs {missing.replace('_', '-')}, .*pip install 'warploom\[bench\]'"):
        run_benchmarks(out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
