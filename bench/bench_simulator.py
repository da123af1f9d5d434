"""The simulator: sweeps in an instant and in a turn, images, scenes alone and as views of one street."""

import pytest

from warploom.kernels.threads import set_thread_count, thread_count
from warploom.models.simulator import Camera, Simulator, sample_scene, sample_views


@pytest.fixture
def one_thread():
    before = thread_count()
    set_thread_count(1)
    yield
    set_thread_count(before)


@pytest.mark.parametrize("kind", ["instant", "turning", "turning, visibility"])
def bench_sweep_of_hdl64(benchmark, one_thread, kind):
    """One of 137,984 beams on one core, the truth included; real time is 100 ms."""
    drive = Simulator(seed=7, turning="turning" in kind, visibility="visibility" in kind)
    drive.frame(0)
    frame = benchmark.pedantic(lambda: drive.frame(3), rounds=12, warmup_rounds=2)
    benchmark.extra_info.update(
        points=len(frame.points), beams=drive.lidar.lines * drive.lidar.columns, objects=len(frame.boxes)
    )


def bench_image(benchmark, one_thread):
    """640 × 360 pixels with depth, instances and boxes."""
    drive, camera = Simulator(seed=7, lidar="vlp16"), Camera()
    view = benchmark.pedantic(lambda: drive.image(3, camera), rounds=5, warmup_rounds=1)
    benchmark.extra_info.update(objects=len(view.ids))


def bench_scene(benchmark):
    """A scene with its street, the meshes already there."""
    sample_scene(0, lidar="hdl64")
    benchmark.pedantic(lambda: sample_scene(1, lidar="hdl64"), rounds=3, warmup_rounds=1)


def bench_eight_views_of_a_street(benchmark):
    """What eight scans cost that share their street."""
    sample_views(1, 8, lidar="hdl64")
    benchmark.pedantic(lambda: sample_views(1, 8, lidar="hdl64"), rounds=2)
    benchmark.extra_info.update(views=8)
