"""Taichi, started once with a cache for each worker; and the clouds on which it is held against Warp."""

import os
import pathlib
import tempfile

import numpy as np
import pytest

_worker = os.environ.get("PYTEST_XDIST_WORKER", "alone")
os.environ.setdefault(
    "TI_OFFLINE_CACHE_FILE_PATH", str(pathlib.Path(tempfile.gettempdir()) / "warploom_test_cache" / "taichi" / _worker)
)


@pytest.fixture(scope="session", autouse=True)
def arch() -> str:
    """The device on which Taichi runs: the CPU, or what `TI_ARCH` says."""
    pytest.importorskip("taichi", reason="Taichi is not installed")
    from warploom.errors import DeviceError
    from warploom.kernels.taichi.device import start

    try:
        return start()
    except DeviceError as error:
        pytest.skip(str(error))


def _normal(seed: int, n: int) -> np.ndarray:
    points = np.random.default_rng(seed).normal(0, [20, 20, 1.5, 1], (n, 4)).astype(np.float32)
    points[::3, 2] = np.round(points[::3, 2], 1)  # many equal heights
    return points


def _awkward() -> dict[str, np.ndarray]:
    random, normal = np.random.default_rng(0), _normal(1, 3000)
    broken = normal.copy()
    broken[random.random(3000) < 0.1, random.integers(0, 3)] = np.nan
    broken[::17, 1] = np.inf
    broken[::19, 2] = -np.inf
    crowded = np.concatenate([random.normal(low, 0.05, (30_000, 4)) for low in (0.0, 0.8, 3.0)])
    line = np.zeros((2000, 4))
    line[:, 0] = np.linspace(-30, 30, 2000)
    plane = random.uniform(-30, 30, (3000, 4))
    plane[:, 2] = -1.7
    lattice = np.stack([*np.meshgrid(*[np.arange(-4, 4) * 0.5] * 3), np.zeros((8, 8, 8))], axis=-1).reshape(-1, 4)
    clouds = {
        "none": normal[:0],
        "one": normal[:1],
        "normal": normal,
        "not finite": broken,
        "all NaN": np.full((50, 4), np.nan),
        "duplicates": np.repeat(normal[:40], 50, axis=0),
        "in one place": np.repeat(normal[:1], 50_000, axis=0),
        "crowded": crowded,
        "a line": line,
        "a plane": plane,
        "a lattice": lattice,
        "far": normal * [5e3, 5e3, 5e4, 1],
        "denormal": normal * 1e-42,
        "signed zeros": np.where(random.random((500, 4)) < 0.5, -0.0, 0.0),
    }
    return {name: points.astype(np.float32) for name, points in clouds.items()}


_AWKWARD = _awkward()


@pytest.fixture(params=_AWKWARD)
def awkward(request) -> np.ndarray:
    """Each of the clouds on which kernels like to fail, shape (n, 4), float32."""
    return _AWKWARD[request.param]


@pytest.fixture(scope="session")
def normal():
    """A function of seed and number of points that makes a cloud with equal heights."""
    return _normal


@pytest.fixture(scope="session")
def street() -> np.ndarray:
    """A simulated sweep."""
    from warploom.models.simulator import Simulator

    return Simulator(seed=3, lidar="xt32", duration=1.0, turning=False).frame(0).points


@pytest.fixture(scope="session")
def scans(shared_data) -> list[np.ndarray]:
    """Real sweeps."""
    return [
        np.fromfile(path, np.float32).reshape(-1, 4)
        for path in sorted((shared_data / "semantic_kitti" / "full").glob("*.bin"))
    ]
