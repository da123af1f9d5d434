"""A run of the benchmarks as it is written, made by hand."""

import copy

import pytest

MEASURED = {
    "datetime": "2030-01-02T03:04:05+00:00",
    "commit_info": {"id": "0123456789abcdef", "dirty": True},
    "warploom": {
        "machine": {
            "processor": "Example 9000", "cores": 2, "memory_gib": 8.0, "system": "Linux x86_64", "python": "3.12.1",
            "devices": ["cpu"], "versions": {"numpy": "2.4.0"}, "threads": 2,
        },
        "skipped": {"bench_bev[warploom cuda:0-KITTI]": "no CUDA device here"},
    },
    "benchmarks": [],
}  # fmt: skip


def make_entry(who, seconds, **more):
    info = {"kernel": "cluster", "on": "KITTI", "size": 51_000, "who": who, "device": "cpu", "threads": 1}
    return {"stats": {"median": seconds}, "extra_info": {**info, "accuracy": "", **more}}


@pytest.fixture(scope="session")
def entry():
    """A function of contender, seconds and further facts that makes one benchmark."""
    return make_entry


@pytest.fixture(scope="session")
def run_of():
    """A function of benchmarks that makes a run of them."""
    return lambda *entries: {**copy.deepcopy(MEASURED), "benchmarks": list(entries)}
