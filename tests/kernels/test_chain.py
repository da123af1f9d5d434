"""The chain against its steps, called one by one through their own functions: equal to the bit, frame after frame."""

import functools
import re
import threading

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

import warploom as wl
from warploom.kernels import chain as chain_module
from warploom.kernels.chain import CHAIN_STAGES
from warploom.kernels.cpu_graph import is_alone
from warploom.kernels.pillar import pillarize
from warploom.kernels.threads import set_thread_count, thread_count

EVERY_STAGE = wl.ChainConfig(stages=CHAIN_STAGES)
SMALL = wl.ChainConfig(
    stages=CHAIN_STAGES,
    point_range=(-30, -30, -5, 30, 30, 5),
    ego_box=(-1, -1, -3, 1, 1, 1),
    radius=0.7,
    min_size=3,
    pillar_size=(0.5, 0.5, 8.0),
    pillar_range=(-20, -20, -4, 20, 20, 4),
    max_points=5,
    max_pillars=3000,
    channel_range=(-20, -20, -2, 20, 20, 6),
    channel_cell=0.5,
    bev_range=(-20, -20, -4, 20, 20, 4),
    bev_shape=(50, 70),
)


def scene(n=4000, seed=0):
    """A road with blocks on it, noise, points on the own vehicle and some that are not finite."""
    rng = np.random.default_rng(seed)
    points = np.empty((n, 4), np.float32)
    points[:, :2] = rng.uniform(-35, 35, (n, 2))
    points[:, 2] = rng.normal(-1.8, 0.02, n)
    points[:, 3] = rng.uniform(0, 1, n)
    standing = np.arange(n) % 3 == 0
    block = rng.integers(0, 40, n)
    points[standing, :2] = rng.uniform(-25, 25, (40, 2))[block[standing]] + rng.normal(0, 0.5, (standing.sum(), 2))
    points[standing, 2] = rng.uniform(-1.6, 0.5, standing.sum())
    points[::97, rng.integers(0, 3)] = np.nan
    points[5::211, :2] *= 0.01
    return points


def step_by_step(points, config):
    """The chain's stages through the public functions."""
    kept = wl.filter_points(points, point_range=config.point_range, ego_box=config.ego_box)
    cloud = kept.points
    ground = wl.segment_ground(cloud, sensor_height=config.sensor_height)
    with np.errstate(invalid="ignore"):
        stands = ~ground.mask & (ground.height >= config.min_height) & (ground.height <= config.max_height)
    labels = np.full(len(cloud), -1, np.int32)
    labels[stands] = wl.cluster(cloud[stands], config.radius, config.min_size, radius_per_metre=config.radius_per_metre)
    return {
        "xyz": cloud[:, :3],
        "intensity": cloud[:, 3],
        "index": kept.index,
        "ground": ground.mask,
        "height": ground.height,
        "labels": labels,
        "boxes": wl.fit_boxes(cloud, labels, method=config.box_method, min_size=config.min_box_size),
        "channels": pillarize(
            cloud,
            sensor_height=ground.sensor_height,
            point_range=config.channel_range,
            cell=config.channel_cell,
        ),
        "bev": wl.bev(cloud, config.bev_range, config.bev_shape),
        "pillars": wl.voxelize(cloud, config.pillar_size, config.pillar_range, config.max_points, config.max_pillars),
        "sensor_height": ground.sensor_height,
        "dropped": (kept.non_finite, kept.out_of_range, kept.ego),
    }


def assert_same(result, expected, stages=CHAIN_STAGES):
    """Every byte, NaN included."""
    names = ["xyz", "intensity", "index", "ground", "height"]
    names += [{"cluster": "labels"}.get(stage, stage) for stage in stages if stage != "pillars"]
    for name in names:
        ours, theirs = getattr(result, name), expected[name]
        assert ours.dtype == theirs.dtype, name
        assert ours.shape == theirs.shape, name
        assert ours.tobytes() == np.ascontiguousarray(theirs).tobytes(), name
    if "pillars" in stages:
        for name in ("features", "coords", "counts"):
            ours, theirs = getattr(result.pillars, name), getattr(expected["pillars"], name)
            assert ours.shape == theirs.shape
            assert ours.tobytes() == theirs.tobytes(), name
        for name in ("dropped_points", "dropped_voxels", "outside"):
            assert getattr(result.pillars, name) == getattr(expected["pillars"], name)
    assert result.sensor_height == expected["sensor_height"]
    assert (result.dropped.non_finite, result.dropped.out_of_range, result.dropped.ego) == expected["dropped"]


@pytest.fixture(scope="module")
def frames():
    """Six consecutive sweeps of a simulated street, every third point."""
    from warploom.models.simulator import Simulator

    return [frame.points[::3] for frame in Simulator(seed=11, duration=0.6, turning=False)]


@pytest.fixture(params=[False, True], ids=["direct", "captured"])
def captured(request):
    return request.param


def test_equals_its_steps_frame_after_frame(frames, captured):
    chain = wl.KernelChain(config=EVERY_STAGE, capacity=60_000, captured=captured)
    for points in frames:
        result = chain(points)
        assert_same(result, step_by_step(points, EVERY_STAGE))
        assert not result.overflow
        assert result.cluster_count == len(result.boxes) == result.labels.max() + 1 > 5


def test_the_way_of_work_for_gpus_gives_the_same(monkeypatch, captured):
    """All plans as they work on a GPU, whose counts decide nothing on the host either."""
    ways = {
        "PointFilter": "scan",
        "GroundSegment": "shared",
        "EuclideanCluster": "shared",
        "Voxelize": "sort",
        "PillarGrid": "shared",
        "BevMaps": "shared",
    }
    for name, method in ways.items():
        monkeypatch.setattr(chain_module, name, functools.partial(getattr(chain_module, name), method=method))
    chain = wl.KernelChain(config=SMALL, capacity=4096, captured=captured)
    for seed, n in enumerate((4000, 10, 0, 4096, 1, 2500)):
        points = scene(n, seed)
        assert_same(chain(points), step_by_step(points, SMALL))


def test_clouds_may_grow_shrink_and_be_empty(captured):
    """Nothing of a frame is left in the next."""
    chain = wl.KernelChain(config=SMALL, capacity=4096, captured=captured)
    for seed, n in enumerate((4000, 10, 0, 4096, 1, 2500, 0, 3)):
        points = scene(n, seed)
        assert_same(chain(points), step_by_step(points, SMALL))


@pytest.mark.real
def test_equals_its_steps_on_real_scans(shared_data, captured):
    files = sorted((shared_data / "semantic_kitti" / "full").glob("*.bin"))[:3]
    files += sorted((shared_data / "kitti_object" / "velodyne").glob("*.bin"))[:2]
    chain = wl.KernelChain(config=EVERY_STAGE, capacity=130_000, captured=captured)
    for file in files:
        points = np.fromfile(file, np.float32).reshape(-1, 4)
        assert_same(chain(points), step_by_step(points, EVERY_STAGE))


@settings(max_examples=15, deadline=None)
@given(n=st.integers(0, 600), seed=st.integers(0, 2**16), capacity=st.sampled_from([600, 1000]))
def test_any_cloud_equals_its_steps(n, seed, capacity):
    from warploom.kernels.plan import plan_for

    points = scene(n, seed)
    chain = plan_for(wl.KernelChain, config=SMALL, capacity=capacity, captured=bool(seed % 2))
    assert_same(chain(points), step_by_step(points, SMALL))


def test_points_beyond_the_capacity_are_left_out_and_counted(captured):
    points = scene(3000)
    chain = wl.KernelChain(config=SMALL, capacity=2000, captured=captured)
    result = chain(points)
    assert_same(result, step_by_step(points[:2000], SMALL))
    assert result.dropped.over_capacity == 1000
    assert result.overflow
    again = chain(points[:2000])
    assert again.dropped.over_capacity == 0
    assert not again.overflow


def test_clusters_beyond_the_boxes_are_left_out_and_counted(captured):
    points = scene(4000)
    config = wl.ChainConfig(stages=("cluster", "boxes"), min_size=3, radius=0.5, max_boxes=5)
    expected = step_by_step(points, config)
    result = wl.KernelChain(config=config, capacity=4096, captured=captured)(points)
    clusters = len(expected["boxes"])
    assert clusters > 10
    assert result.cluster_count == clusters
    assert result.labels.tobytes() == expected["labels"].tobytes()
    assert result.boxes.tobytes() == expected["boxes"][:5].tobytes()
    assert result.dropped.clusters_without_box == clusters - 5
    assert result.dropped.points_without_box == (expected["labels"] >= 5).sum()
    assert result.overflow


def test_pillars_beyond_the_room_are_left_out_and_counted(captured):
    points = scene(4000)
    config = wl.ChainConfig(stages=("pillars",), pillar_range=(-20, -20, -4, 20, 20, 4), max_pillars=100, max_points=2)
    result = wl.KernelChain(config=config, capacity=4096, captured=captured)(points)
    expected = step_by_step(points, config)
    assert_same(result, expected, config.stages)
    assert len(result.pillars) == 100
    assert result.dropped.pillars_beyond == expected["pillars"].dropped_voxels > 0
    assert result.dropped.pillar_points == expected["pillars"].dropped_points > 0
    assert result.dropped.pillar_outside == expected["pillars"].outside > 0
    assert result.overflow


@pytest.mark.parametrize(
    "stages",
    [(), ("cluster",), ("cluster", "boxes"), ("pillars",), ("channels",), ("bev",), ("cluster", "bev", "channels")],
    ids=lambda stages: "+".join(stages) or "ground alone",
)
def test_stages_may_be_left_out(stages, captured):
    import dataclasses

    config = dataclasses.replace(SMALL, stages=stages)
    points = scene(2000)
    result = wl.KernelChain(config=config, capacity=2048, captured=captured)(points)
    assert_same(result, step_by_step(points, config), stages)
    for stage, name in (("cluster", "labels"), ("boxes", "boxes"), ("pillars", "pillars"), ("bev", "bev")):
        assert (getattr(result, name) is None) == (stage not in stages)


def test_the_number_of_threads_does_not_matter(captured):
    points, before = scene(4000), thread_count()
    expected = step_by_step(points, SMALL)
    try:
        for threads in (1, 2, 3, 7):
            set_thread_count(threads)
            assert_same(wl.KernelChain(config=SMALL, capacity=4096, captured=captured)(points), expected)
    finally:
        set_thread_count(before)


def test_chains_of_several_threads_do_not_disturb_each_other(captured):
    """Eight rounds each of three chains on clouds of their own."""
    clouds = [scene(3000, seed) for seed in range(3)]
    expected = [step_by_step(points, SMALL) for points in clouds]
    chains = [wl.KernelChain(config=SMALL, capacity=3000, captured=captured) for _ in clouds]
    failures = []

    def work(number):
        try:
            for _ in range(8):
                assert_same(chains[number](clouds[number]), expected[number])
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures


def test_by_default_it_records_on_a_cpu_only_where_no_other_thread_could_launch():
    """A chain made beside the main thread, which may be launching kernels, does not."""
    made = []
    thread = threading.Thread(target=lambda: made.append(wl.KernelChain(config=SMALL, capacity=1000)))
    thread.start()
    thread.join()
    assert made[0].captured is False
    assert wl.KernelChain(config=SMALL, capacity=1000).captured is is_alone()
    points = scene(800)
    assert_same(made[0](points), step_by_step(points, SMALL))


def test_arrays_of_other_kinds_and_layouts():
    import torch

    points = scene(2000)
    chain = wl.KernelChain(config=SMALL, capacity=2048)
    expected = step_by_step(points, SMALL)
    read_only = points.copy()
    read_only.setflags(write=False)
    wide = np.zeros((2000, 7), np.float32)
    wide[:, :4] = points
    for other in (read_only, wide, wide[:, :4], points.astype(np.float64), np.asfortranarray(points)):
        before = other.copy()
        assert_same(chain(other), expected)
        np.testing.assert_array_equal(other, before)
    tensors = chain(torch.from_numpy(points))
    assert isinstance(tensors.labels, torch.Tensor)
    assert isinstance(tensors.pillars.features, torch.Tensor)
    assert tensors.boxes.numpy().tobytes() == expected["boxes"].tobytes()
    arrays = chain(wp.array(points, device="cpu"))
    assert isinstance(arrays.bev, wp.array)
    assert arrays.bev.numpy().tobytes() == expected["bev"].tobytes()


def test_without_intensity_it_is_zero():
    """Also where the frame before had one."""
    points = scene(2000)
    chain = wl.KernelChain(config=SMALL, capacity=2048)
    chain(points)
    bare = points.copy()
    bare[:, 3] = 0
    assert_same(chain(points[:, :3]), step_by_step(bare, SMALL))


def test_views_are_of_the_chains_own_memory():
    points = scene(2000)
    chain = wl.KernelChain(config=SMALL, capacity=2048)
    view, copy = chain(points, copy=False), chain(points)
    assert np.shares_memory(view.boxes, chain.boxes.numpy())
    assert not np.shares_memory(copy.boxes, chain.boxes.numpy())
    assert_same(view, step_by_step(points, SMALL))
    labels = copy.labels.copy()
    chain(scene(2000, 1))
    assert np.array_equal(copy.labels, labels)


def test_device_arrays_may_be_written_and_read_without_the_host(device):
    points = scene(2000)
    chain = wl.KernelChain(config=SMALL, capacity=2048, device=device)
    wp.copy(chain.points, wp.array(points, device=device), count=points.size)
    chain.count.fill_(2000)
    chain.launch()
    expected = step_by_step(points, SMALL)
    kept = int(chain.kept.numpy()[0])
    assert kept == len(expected["xyz"])
    assert np.array_equal(chain.labels.numpy()[:kept], expected["labels"])
    assert int(chain.cluster_count.numpy()[0]) == len(expected["boxes"])
    assert np.array_equal(chain.result().index, expected["index"])


def test_the_examples_of_the_docs_run(repository, tmp_path, monkeypatch, frames, capsys):
    """On the CPU; the lines that need a kernel of the reader's are left out."""
    blocks = re.findall(r"```python\n(.*?)```", (repository / "docs" / "kernels.md").read_text(encoding="utf-8"), re.S)
    (tmp_path / "scans").mkdir()
    for name in ("000000.bin", "scans/000000.bin", "scans/000001.bin"):
        frames[0].astype(np.float32).tofile(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    code = "".join(blocks).replace('device="cuda:0"', "captured=True").replace("my_kernel(", "print(")
    names: dict = {}
    exec(compile(code, "kernels.md", "exec"), names)
    assert np.array_equal(names["found"].labels, wl.KernelChain(config=wl.ChainConfig(radius=0.6))(frames[0]).labels)
    assert capsys.readouterr().out


def test_lanes_on_streams_begin_after_the_fork_and_end_before_the_join(monkeypatch):
    """On streams that only take notes: what a GPU is told, in order."""
    told = []

    class Stream:
        def __init__(self, name):
            self.name = name

        def record_event(self, event):
            told.append((self.name, "records", event))

        def wait_event(self, event):
            told.append((self.name, "waits for", event))

    class Scoped:
        def __init__(self, stream, sync_enter):
            assert not sync_enter  # which would be a wait that the graph does not need
            self.stream = stream

        def __enter__(self):
            told.append((self.stream.name, "is entered"))

        def __exit__(self, *_):
            told.append((self.stream.name, "is left"))

    chain = wl.KernelChain(config=SMALL, capacity=1000, captured=False)
    monkeypatch.setattr(chain_module.wp, "get_stream", lambda device: Stream("main"))
    monkeypatch.setattr(chain_module.wp, "ScopedStream", Scoped)
    object.__setattr__(chain, "_forked", "fork")
    object.__setattr__(chain, "_side", [(Stream("side"), "side done"), (Stream("unused"), "never")])
    chain._run_on_streams([lambda: told.append("first lane"), lambda: told.append("second lane")])
    assert told == [
        ("main", "records", "fork"),
        ("side", "waits for", "fork"),
        ("side", "is entered"),
        "second lane",
        ("side", "is left"),
        ("side", "records", "side done"),
        "first lane",
        ("main", "waits for", "side done"),
    ]


@pytest.mark.cuda
@pytest.mark.parametrize("captured", [False, True])
def test_a_gpu_gives_what_a_cpu_gives(frames, captured):
    """Integers and what is copied exactly; heights and boxes to 1e-4, as the compilers round differently."""
    if not wp.is_cuda_available():
        pytest.skip("no CUDA device here")
    chain = wl.KernelChain(config=EVERY_STAGE, capacity=60_000, device="cuda:0", captured=captured)
    reference = wl.KernelChain(config=EVERY_STAGE, capacity=60_000)
    for points in frames:
        ours, expected = chain(points), reference(points)
        for name in ("index", "xyz", "intensity", "ground", "labels"):
            assert np.array_equal(getattr(ours, name), getattr(expected, name)), name
        assert np.array_equal(ours.pillars.features, expected.pillars.features)
        assert np.array_equal(ours.pillars.coords, expected.pillars.coords)
        assert np.array_equal(ours.bev, expected.bev)
        np.testing.assert_allclose(ours.height, expected.height, atol=1e-4)
        np.testing.assert_allclose(ours.boxes, expected.boxes, atol=1e-4)
        assert ours.dropped == expected.dropped


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: wl.ChainConfig(stages=("cluster", "maps")), "stages must be of cluster, .*'maps'"),
        (lambda: wl.ChainConfig(stages=("boxes",)), "must have 'cluster'"),
        (lambda: wl.ChainConfig(min_height=2, max_height=1), "min_height must be at most max_height"),
        (lambda: wl.KernelChain(capacity=0), "capacity must be at least 1"),
        (lambda: wl.KernelChain(config=wl.ChainConfig(radius=-1)), "radius must be"),
        (lambda: wl.KernelChain(config=wl.ChainConfig(bev_shape=(0, 5))), "shape must be"),
        (lambda: wl.KernelChain(config=SMALL, capacity=10)(np.zeros((4, 2), np.float32)), "points must have shape"),
    ],
)
def test_wrong_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_integers_are_refused():
    with pytest.raises(TypeError, match="floating"):
        wl.KernelChain(config=SMALL, capacity=10)(np.zeros((4, 4), np.int32))
