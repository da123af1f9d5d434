"""What all tests share: the real data, the devices, a Warp cache for each worker."""

import os
import pathlib
import sys
import tempfile

import pytest

# The kernel cache is not safe across processes: each xdist worker has its own, before Warp is imported.
_worker = os.environ.get("PYTEST_XDIST_WORKER")
if _worker:
    _base = os.environ.get("WARP_CACHE_PATH") or os.path.join(tempfile.gettempdir(), "warploom_test_cache")
    os.environ["WARP_CACHE_PATH"] = os.path.join(_base, _worker)

ROOT = pathlib.Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def repository() -> pathlib.Path:
    """The root of the checkout."""
    return ROOT


@pytest.fixture(scope="session")
def shared_data() -> pathlib.Path:
    """The folder of real scans beside the checkout; the test is skipped where it is absent."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the real scans (../shared/data) are not here")
    return folder


def _has_cuda() -> bool:
    import warp as wp

    from warploom.kernels import device  # noqa: F401  (starts Warp quietly)

    return wp.is_cuda_available()


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=pytest.mark.cuda)])
def device(request) -> str:
    """Each compute device in turn."""
    if request.param != "cpu" and not _has_cuda():
        pytest.skip("no CUDA device here")
    return request.param


@pytest.fixture
def warploom(monkeypatch, capfd, tmp_path):
    """Runs the command in this process, in the test's folder, and gives its output."""
    from warploom.cli import main
    from warploom.dag.logs import stop_logging

    def run(*arguments, expect=0):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["warploom", *map(str, arguments)])
        code = 0
        try:
            main()
        except SystemExit as stop:
            code = stop.code or 0
        finally:
            stop_logging()
        output = "".join(capfd.readouterr())
        assert code == expect, output
        return output

    return run
