"""What the benchmarks share, and what is added to pytest-benchmark's JSON for the report."""

import importlib.metadata
import pathlib

import psutil
import pytest

from warploom.bench.contest import Contest
from warploom.bench.scans import Scans
from warploom.kernels.threads import thread_count

_PEERS = (
    "spconv",
    "small-gicp",
    "kiss-icp",
    "open3d",
    "pypatchworkpp",
    "scipy",
    "scikit-learn",
    "shapely",
    "opencv-python-headless",
    "taichi",
)
_skipped: dict[str, str] = {}
_begun = psutil.cpu_times()


@pytest.fixture(scope="session")
def scans() -> Scans:
    """The clouds, each made once."""
    data = pathlib.Path(__file__).resolve().parent.parent.parent / "shared" / "data"
    return Scans(data if data.is_dir() else None)


@pytest.fixture
def contest(benchmark, scans) -> Contest:
    """Times the contenders of a kernel."""
    return Contest(benchmark, scans)


def pytest_runtest_logreport(report):
    if report.skipped and isinstance(report.longrepr, tuple):
        _skipped[report.nodeid.rpartition("::")[2]] = report.longrepr[2].removeprefix("Skipped: ")


def pytest_benchmark_update_json(config, benchmarks, output_json):
    """The machine, the versions of the peers, and what was skipped for which reason."""
    from warploom.components.machine import describe_machine

    machine = describe_machine()
    machine["threads"] = thread_count()
    for package in _PEERS:
        try:
            machine["versions"][package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    now = psutil.cpu_times()
    stolen, idle = (
        sum(getattr(now, name, 0.0) - getattr(_begun, name, 0.0) for name in names)
        for names in (["steal"], ["idle", "iowait", "guest", "guest_nice"])  # a guest's time is in the user's too
    )
    processor_time = {"stolen_s": stolen, "wanted_s": sum(now) - sum(_begun) - idle}
    output_json["warploom"] = {"machine": machine, "skipped": _skipped, "processor_time": processor_time}
