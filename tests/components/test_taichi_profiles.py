"""The stages and profiles that compute in Taichi, against those that compute in Warp."""

import importlib.util
import os
import pathlib
import subprocess
import sys
import tempfile

import numpy as np
import pytest

import warploom as wl
from warploom.components.checking import check_file
from warploom.components.execution import ExecutionContext
from warploom.components.perception import ClusterProcessor, FilterProcessor, GroundProcessor
from warploom.dag import ProcessorHarness
from warploom.errors import ConfigError

_worker = os.environ.get("PYTEST_XDIST_WORKER", "alone")
os.environ.setdefault(
    "TI_OFFLINE_CACHE_FILE_PATH", str(pathlib.Path(tempfile.gettempdir()) / "warploom_test_cache" / "taichi" / _worker)
)
CONTEXT = ExecutionContext(capacity=150_000)


@pytest.fixture(scope="module")
def frames():
    return list(wl.read("sim:street?seed=2&duration=0.4"))


@pytest.fixture
def in_taichi():
    pytest.importorskip("taichi", reason="Taichi is not installed")


def harness(processor, **config):
    return ProcessorHarness(processor, config, CONTEXT)


@pytest.mark.usefixtures("in_taichi")
def test_stages_give_what_they_give_in_warp(frames):
    """Labels are the same; heights within 0.1 mm, and the masks where no height is that near to a bound."""
    clusters = {"radius": 0.3, "radius_per_metre": 0.01, "min_size": 5}
    filtering, warp = harness(FilterProcessor), harness(GroundProcessor)
    taichi = harness(GroundProcessor, backend="taichi")
    groups = [harness(ClusterProcessor, **clusters, backend=backend) for backend in ("warp", "taichi")]
    for frame in frames:
        filtered = filtering.feed(sensor=frame).run(frame.version)["filtered"]
        expected = warp.feed(filtered=filtered).run(frame.version)["ground"]
        found = taichi.feed(filtered=filtered).run(frame.version)["ground"]
        assert found.sensor_height == pytest.approx(expected.sensor_height, abs=1e-4)
        np.testing.assert_allclose(found.height.numpy(), expected.height.numpy(), atol=1e-4)
        assert (found.mask.numpy() != expected.mask.numpy()).mean() < 1e-4
        ours = [
            group.feed(filtered=filtered, ground=expected).run(frame.version)["clusters"] for group in reversed(groups)
        ]
        assert ours[0].count == ours[1].count > 10
        np.testing.assert_array_equal(ours[0].labels.numpy(), ours[1].labels.numpy())


@pytest.mark.usefixtures("in_taichi")
def test_a_frame_without_points_has_no_clusters(frames):
    frame = frames[0]
    empty = type(frame)(version=frame.version, index=0, points=np.full((7, 4), np.nan, np.float32))
    filtered = harness(FilterProcessor).feed(sensor=empty).run()["filtered"]
    ground = harness(GroundProcessor, backend="taichi").feed(filtered=filtered).run()["ground"]
    assert ground.mask.shape == ground.height.shape == (0,)
    found = harness(ClusterProcessor, backend="taichi").feed(filtered=filtered, ground=ground).run()["clusters"]
    assert found.count == 0
    assert found.labels.shape == (0,)


@pytest.mark.usefixtures("in_taichi")
def test_the_profile_taichi_cpu_finds_the_objects_that_cpu_finds(frames):
    """Boxes and velocities within a millimetre: heights differ by rounding, so a point on a bound may be left out."""
    runs = []
    for profile in ("cpu", "taichi-cpu"):
        with wl.Pipeline.from_profile(profile) as pipeline:
            runs.append(list(pipeline.run(frames)))
    for expected, found in zip(*runs, strict=True):
        assert not found.failed
        np.testing.assert_array_equal(found.clusters, expected.clusters)
        assert len(found.objects) == len(expected.objects) > 10
        for name in ("ids", "classes", "background"):
            np.testing.assert_array_equal(getattr(found.objects, name), getattr(expected.objects, name))
        np.testing.assert_allclose(found.objects.boxes, expected.objects.boxes, atol=1e-3)
        np.testing.assert_allclose(found.objects.velocities, expected.objects.velocities, atol=1e-3)


@pytest.mark.usefixtures("in_taichi")
def test_check_accepts_taichi_cpu():
    assert any("taichi-cpu" in line for line in check_file("taichi-cpu"))


def test_check_says_where_taichi_is_wanted_and_how_to_get_it(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *more: None if name == "taichi" else find(name, *more)
    )
    with pytest.raises(ConfigError, match=r"(?s)ground.*backend.*needs Taichi.*pip install 'warploom\[taichi\]'"):
        check_file("taichi-cpu")
    assert "is good" in check_file("cpu")[0]


def test_a_backend_that_there_is_not_is_refused():
    with pytest.raises(ConfigError, match=r"must be warp or taichi or .*, not 'abacus'"):
        wl.Pipeline.from_profile("cpu", settings={"perception.cluster.backend": "abacus"})


@pytest.mark.usefixtures("in_taichi")
@pytest.mark.parametrize("asked", [["check", "taichi-vulkan"], ["profile", "taichi-vulkan", "--seconds", "1"]])
def test_taichi_vulkan_works_or_says_that_it_cannot_and_the_way_out(asked):
    """In a process of its own, as Taichi computes on one device in a process."""
    command = [sys.executable, "-c", "from warploom.cli import main; main()", *asked]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode == 0:
        assert "is good" in done.stdout or "taichi-vulkan on cpu" in done.stdout
    else:
        assert done.returncode == 2, done.stdout + done.stderr
        assert "ground by taichi:vulkan: Taichi cannot compute on 'taichi:vulkan' here" in done.stderr
        assert "libvulkan1" in done.stderr, "what to install"
        assert "another profile: taichi-cpu, cpu or gpu" in done.stderr, "what to take instead"
        assert "Traceback" not in done.stderr
