"""The start: import, compilation of the kernels, the first frame; and what one launch costs."""

import json
import os
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest
import warp as wp

from warploom.bench.contest import peer, record_figure
from warploom.components.pipeline import Pipeline
from warploom.errors import ModelError
from warploom.kernels.threads import launch_parts, thread_count

COMMAND = "from warploom.cli import main; main()"
REPEATS = 5


@wp.kernel
def _add_one(values: wp.array(dtype=wp.int32)):
    i = wp.tid()
    values[i] = values[i] + 1


@wp.kernel
def _add_one_in_part(part: int, parts: int, values: wp.array(dtype=wp.int32)):
    values[part] = values[part] + parts


def in_process(*arguments, cache=None):
    """Runs Python with its own kernel cache: seconds that it took, and what it printed."""
    environment = {**os.environ}
    if cache is not None:
        environment |= {"WARP_CACHE_PATH": str(cache), "TI_OFFLINE_CACHE_FILE_PATH": str(cache / "taichi")}
    start = time.perf_counter()
    done = subprocess.run([sys.executable, *arguments], env=environment, capture_output=True, text=True)
    seconds = time.perf_counter() - start
    assert done.returncode == 0, done.stderr
    return seconds, done.stdout


def bench_import(benchmark):
    """`import warploom` in a fresh interpreter, beside an interpreter that imports nothing."""
    code = "import time; t = time.perf_counter(); import warploom; print(time.perf_counter() - t)"
    said = []
    benchmark.extra_info.update(kernel="import", on="warploom")
    benchmark.pedantic(lambda: said.append(float(in_process("-c", code)[1])), rounds=REPEATS, warmup_rounds=1)
    record_figure(benchmark, "import warploom", np.median(said[1:]), "s", goal=0.3, note=f"median of {REPEATS}")


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["warp", "taichi"])
def bench_compilation(benchmark, backend, tmp_path):
    """The first call of each function with an empty kernel cache, then with that cache filled, in new processes."""
    if backend == "taichi":
        peer("taichi")
    benchmark.extra_info.update(kernel="compilation", on=f"cpu, {backend}")
    arguments = ("-m", "warploom.bench.first_calls", backend)
    _, cold = benchmark.pedantic(in_process, args=arguments, kwargs={"cache": tmp_path}, rounds=1)
    _, warm = in_process(*arguments, cache=tmp_path)
    cold, warm = json.loads(cold), json.loads(warm)
    benchmark.extra_info["first_calls"] = {
        name: {"cold_s": cold[name][0], "warm_s": warm[name][0], "second_s": warm[name][1]} for name in cold
    }
    what = "kernels of the API" if backend == "warp" else "kernels of the API in Taichi"
    everything = sum(first for first, _ in cold.values())
    record_figure(benchmark, f"{what}, compiled", everything, "s", note=f"{len(cold)} functions")
    everything = sum(first for first, _ in warm.values())
    record_figure(benchmark, f"{what}, from the cache", everything, "s", note=f"{len(warm)} functions")


@pytest.mark.slow
def bench_first_frame(benchmark, scans, tmp_path):
    """`warploom run --frames 1` on a scan of about 120 thousand points, as a whole: from the shell and back."""
    try:
        Pipeline.from_profile("cpu").close()
    except ModelError as error:
        pytest.skip(f"the profile cpu cannot run: {error}")
    np.save(tmp_path / "scan.npy", scans.cloud("street 120k"))
    out, cache = tmp_path / "out", tmp_path / "cache"
    run = ("-c", COMMAND, "run", "--source", str(tmp_path / "scan.npy"), "--frames", "1", "--out", str(out))

    def first_frame():
        return json.loads((out / "report.json").read_text())["seconds"]["first_frame"]

    benchmark.extra_info.update(kernel="first frame", on="street")
    seconds, _ = benchmark.pedantic(in_process, args=run, kwargs={"cache": cache}, rounds=1)
    record_figure(
        benchmark, "first frame, empty kernel cache", seconds, "s", goal=30.0,
        note=f"the whole of `warploom run --frames 1`; the frame is there {first_frame():.2f} s after the imports",
    )  # fmt: skip
    warm = [in_process(*run, cache=cache)[0] for _ in range(REPEATS)]
    record_figure(
        benchmark, "first frame, warm", np.median(warm), "s", goal=4.0,
        note=f"median of {REPEATS}; the frame is there {first_frame():.2f} s after the imports",
    )  # fmt: skip
    shutil.rmtree(cache)


def bench_launch_parts(benchmark):
    """One launch in as many parts as there may be threads, all at once, beside one in one part."""
    parts = thread_count()
    if parts == 1:
        pytest.skip("one CPU thread is all that there is")
    values = wp.zeros(parts, dtype=wp.int32, device="cpu")
    benchmark.extra_info.update(kernel="launch in parts", on="cpu")
    benchmark(launch_parts, _add_one_in_part, parts, [values])
    if benchmark.stats is not None:
        micros = benchmark.stats.stats.median * 1e6
        record_figure(benchmark, f"launch of a kernel in {parts} parts at once, cpu", micros, "µs", note="median")


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("how", ["launch", "recorded"])
def bench_launch(benchmark, how, device):
    """One launch of one thread: through `wp.launch`, or as a recorded command."""
    if device != "cpu" and not wp.is_cuda_available():
        pytest.skip("no CUDA device here")
    values = wp.zeros(1, dtype=wp.int32, device=device)
    wp.launch(_add_one, 1, inputs=[values], device=device)
    command = wp.launch(_add_one, 1, inputs=[values], device=device, record_cmd=True)
    benchmark.extra_info.update(kernel=how, on=device)
    if how == "launch":
        benchmark(wp.launch, _add_one, 1, [values], device=device)
    else:
        benchmark(command.launch)
    name = "launch of a kernel" if how == "launch" else "launch of a recorded command"
    if benchmark.stats is not None:
        record_figure(benchmark, f"{name}, {device}", benchmark.stats.stats.median * 1e6, "µs", note="median")
