"""Taichi's runtime: how it starts, what it refuses, and what the four functions take and give with it."""

import importlib.util
import subprocess
import sys
import threading

import numpy as np
import pytest
import torch
import warp as wp

import warploom as wl
from warploom.errors import DeviceError

RANGE = (-40.0, -40.0, -4.0, 40.0, 40.0, 4.0)
CALLS = {
    "voxelize": lambda points, **options: wl.voxelize(points, 0.5, RANGE, **options).features,
    "segment_ground": lambda points, **options: wl.segment_ground(points, **options).height,
    "bev": lambda points, **options: wl.bev(points, RANGE, (80, 80), **options),
    "cluster": lambda points, **options: wl.cluster(points, 0.7, **options),
}


@pytest.fixture(params=CALLS)
def call(request):
    return CALLS[request.param]


def test_start_names_the_device(arch):
    from warploom.kernels.taichi.device import start

    assert arch in ("taichi:cpu", "taichi:vulkan", "taichi:metal", "taichi:cuda")
    assert start() == start(arch) == arch


def test_it_leaves_denormal_numbers_alone(arch):
    tiny = np.array([1e-42], np.float32)
    assert (tiny * np.float32(1.0))[0] == tiny[0] > 0


def test_a_second_device_is_refused(arch):
    from warploom.kernels.taichi.device import start

    other = "taichi:vulkan" if arch != "taichi:vulkan" else "taichi:cpu"
    with pytest.raises(DeviceError, match="one device in a process"):
        start(other)


def test_an_unknown_backend_is_refused(call, normal):
    with pytest.raises(ValueError, match=r"backend must be 'warp' or 'taichi' or .*, not 'cuda'"):
        call(normal(0, 10), backend="cuda")


def test_a_backend_may_name_the_device(call, normal, arch):
    call(normal(0, 10), backend=arch)
    other = "taichi:metal" if arch != "taichi:metal" else "taichi:cpu"
    with pytest.raises(DeviceError, match=f"here already on {arch!r}, so not on {other!r}"):
        call(normal(0, 10), backend=other)


def test_without_taichi_the_way_to_install_it_is_told(call, normal, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pip install 'warploom\[taichi\]'"):
        call(normal(0, 10), backend="taichi")


def test_every_family_of_arrays(call, normal):
    points = normal(2, 2000)
    expected = call(points)
    for given, kind in (
        (points, np.ndarray),
        (torch.from_numpy(points), torch.Tensor),
        (wp.array(points, dtype=wp.float32, device="cpu"), wp.array),
    ):
        result = call(given, backend="taichi")
        assert isinstance(result, kind)
        np.testing.assert_allclose(result if kind is np.ndarray else result.numpy(), expected, rtol=1e-6, atol=1e-3)


def test_every_layout_of_arrays(call, normal):
    points = normal(3, 2000)
    expected = call(points)
    read_only = points.copy()
    read_only.setflags(write=False)
    wide = np.zeros((4000, 6), np.float32)
    wide[::2, 1:5] = points
    layouts = [read_only, wide[::2, 1:5], np.asfortranarray(points), points.astype(np.float64), points[::-1][::-1]]
    for given in layouts:
        before = given.copy()
        np.testing.assert_allclose(call(given, backend="taichi"), expected, rtol=1e-6, atol=1e-3)
        np.testing.assert_array_equal(given, before)


def test_wrong_points_are_told(call):
    with pytest.raises(TypeError, match="points must be"):
        call([[0.0, 1.0, 2.0]], backend="taichi")
    with pytest.raises(TypeError, match="points must be of a floating type"):
        call(np.zeros((3, 3), np.int32), backend="taichi")
    with pytest.raises(ValueError, match="points must have shape"):
        call(np.zeros((3, 2), np.float32), backend="taichi")


def test_threads_may_call_at_the_same_time(normal):
    clouds = [normal(seed, 3000) for seed in range(4)]
    expected = [[call(points) for call in CALLS.values()] for points in clouds]
    found = [[] for _ in clouds]

    def work(number):
        for _ in range(5):
            found[number] = [call(clouds[number], backend="taichi") for call in CALLS.values()]

    threads = [threading.Thread(target=work, args=(number,)) for number in range(len(clouds))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for ours, theirs in zip(found, expected, strict=True):
        for result, wanted in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(result, wanted, rtol=1e-6, atol=1e-3)


def run(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def test_it_starts_without_a_word():
    done = run("from warploom.kernels.taichi.device import start; start(threads=1)")
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == ""


def test_a_taichi_that_someone_started_is_used_if_its_arithmetic_is_strict():
    code = """
import taichi
taichi.init(arch=taichi.cpu, fast_math=False)
from warploom.errors import DeviceError
from warploom.kernels.taichi.device import start
assert start() == "taichi:cpu"
taichi.init(arch=taichi.cpu, fast_math=False)
try:
    start()
except DeviceError as error:
    print(error)
"""
    done = run(code)
    assert "Taichi has been reset" in done.stdout, done.stderr


def test_a_taichi_that_someone_started_with_loose_arithmetic_is_refused():
    code = """
import taichi
taichi.init(arch=taichi.cpu)
from warploom.errors import DeviceError
from warploom.kernels.taichi.device import start
try:
    start()
except DeviceError as error:
    print(error)
"""
    assert "with fast_math" in run(code).stdout


def test_vulkan():
    """All four on a Vulkan device, where there is one."""
    code = """
import sys
import numpy as np
import warploom as wl
from warploom.errors import DeviceError
from warploom.kernels.taichi.device import start
try:
    start("taichi:vulkan")
except DeviceError as error:
    print("skip", error)
    sys.exit()
points = np.random.default_rng(0).normal(0, [15, 15, 1, 1], (5000, 4)).astype(np.float32)
limits = (-40.0, -40.0, -4.0, 40.0, 40.0, 4.0)
for options in ((0.5, limits), (0.02, limits)):
    ours, theirs = wl.voxelize(points, *options, backend="taichi"), wl.voxelize(points, *options)
    for name in ("features", "coords", "counts"):
        assert np.array_equal(getattr(ours, name), getattr(theirs, name)), name
assert np.array_equal(wl.bev(points, limits, (80, 80), backend="taichi"), wl.bev(points, limits, (80, 80)))
assert np.array_equal(wl.cluster(points, 0.712, backend="taichi"), wl.cluster(points, 0.712))
ours, theirs = wl.segment_ground(points, backend="taichi"), wl.segment_ground(points)
assert (ours.mask != theirs.mask).sum() <= 1
assert np.allclose(ours.height, theirs.height, atol=1e-3)
print("equal")
"""
    done = run(code)
    assert done.returncode == 0, done.stderr
    if "skip" in done.stdout:
        pytest.skip("no Vulkan device here: " + done.stdout)
    assert "equal" in done.stdout
