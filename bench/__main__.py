"""Every file of benchmarks in a process of its own, then one report: a file that fails takes no other's results along.

`python -m warploom.bench --out docs/benchmarks.md` is what `make bench` runs. Each file's JSON and its output stay in
the folder `--keep`.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from ..errors import ConfigError
from .report import write_report
from .results import merge_measured, read_measured

_FOLDER = Path(__file__).resolve().parent


def _run(file: Path, keep: Path, seconds: float, limit: float) -> str:
    """Runs one file; what went wrong, or nothing."""
    written = keep / f"{file.stem}.json"
    written.unlink(missing_ok=True)
    options = ("only", f"max-time={seconds}", "columns=median,iqr,rounds", "sort=name", f"json={written}")
    command = [sys.executable, "-m", "pytest", str(file), *(f"--benchmark-{option}" for option in options)]
    with (keep / f"{file.stem}.log").open("w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True)
        try:
            code = process.wait(limit)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)  # pytest then writes what it has measured
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(30)
            return f"took more than {limit:g} s"
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # and what it started
            process.wait()
    return "" if code == 0 else f"pytest ended with {code}; see {log.name}"


def main() -> None:
    """Runs them and writes the report; ends with 1 where a file failed."""
    parser = argparse.ArgumentParser(prog="python -m warploom.bench", description=__doc__)
    parser.add_argument("files", type=Path, nargs="*", help="files of benchmarks; by default all")
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks.md"), help="the report")
    parser.add_argument(
        "--keep", type=Path, default=Path(".benchmarks/report"), help="folder for each file's JSON and output"
    )
    parser.add_argument("--max-time", type=float, default=0.4, help="seconds that a benchmark is repeated for")
    parser.add_argument("--limit", type=float, default=600.0, help="seconds after which a file is given up")
    given = parser.parse_args()
    given.keep.mkdir(parents=True, exist_ok=True)
    files = given.files or sorted(_FOLDER.glob("bench_*.py"))
    failures, measured = 0, []
    for file in files:
        start = time.perf_counter()
        wrong = _run(file, given.keep, given.max_time, given.limit)
        failures += bool(wrong)
        sys.stdout.write(f"{file.stem}: {time.perf_counter() - start:.0f} s{f', {wrong}' if wrong else ''}\n")
        sys.stdout.flush()
        try:
            measured.append(read_measured(given.keep / f"{file.stem}.json"))
        except ConfigError:
            if not wrong:
                sys.stdout.write(f"{file.stem}: measured nothing\n")
    if not measured:
        sys.exit("nothing was measured")
    written = write_report(merge_measured(measured), given.out)
    sys.stdout.write(f"{', '.join(str(path) for path in written)} written\n")
    sys.exit(1 if failures else 0)


if __name__ == "__main__":
    main()
