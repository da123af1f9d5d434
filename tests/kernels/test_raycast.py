"""Ray casting against a brute-force Möller–Trumbore intersection in float64, and against Open3D's Embree scene."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels.meshes import MeshSet
from warploom.kernels.raycast import MATERIALS, LidarCast, raycast
from warploom.kernels.threads import set_thread_count, thread_count

# float32 coordinates of up to about 60 m: a few units in the last place of a distance.
DISTANCE_TOLERANCE = 2e-4


def brute_force(vertices, faces, origins, directions):
    """Distance and face of the nearest hit, float64, one triangle after the other."""
    origins = origins.astype(np.float64)
    directions = directions / np.linalg.norm(directions.astype(np.float64), axis=1, keepdims=True)
    best = np.full(len(origins), np.inf)
    which = np.full(len(origins), -1)
    for k, (a, b, c) in enumerate(vertices.astype(np.float64)[faces]):
        e1, e2 = b - a, c - a
        p = np.cross(directions, e2)
        det = p @ e1
        with np.errstate(divide="ignore", invalid="ignore"):
            s = origins - a
            u = (s * p).sum(1) / det
            q = np.cross(s, e1)
            v = (directions * q).sum(1) / det
            t = (q @ e2) / det
        hit = (np.abs(det) > 1e-12) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < best)
        best[hit], which[hit] = t[hit], k
    return best, which


def soup(seed, faces=300, rays=2000):
    random = np.random.default_rng(seed)
    centres = random.normal(0, 15, (faces, 1, 3))
    vertices = (centres + random.normal(0, 2, (faces, 3, 3))).reshape(-1, 3).astype(np.float32)
    corners = np.arange(3 * faces, dtype=np.int32).reshape(faces, 3)
    origins = random.normal(0, 4, (rays, 3)).astype(np.float32)
    directions = random.normal(0, 1, (rays, 3)).astype(np.float32)
    return vertices, corners, origins, directions


def agrees(distance, expected):
    """Equal hits but for rays that graze an edge: at most one in a thousand."""
    hit = np.isfinite(expected)
    same = (np.isfinite(distance) == hit) & (
        ~hit | (np.abs(np.where(hit, distance, 0) - np.where(hit, expected, 0)) < DISTANCE_TOLERANCE)
    )
    return same.mean() >= 0.999


def test_hits_are_those_of_a_brute_force_search():
    vertices, faces, origins, directions = soup(0)
    hits = raycast(vertices, faces, origins, directions)
    expected, which = brute_force(vertices, faces, origins, directions)
    assert agrees(hits.distance, expected)
    assert (hits.face == which).mean() >= 0.999
    assert np.isfinite(expected).mean() > 0.2


def fan(n, spread=0.02, seed=0):
    """Rays of one origin, each near the one before, as those of a sensor."""
    random = np.random.default_rng(seed)
    azimuth = np.linspace(0, spread * n, n) + random.uniform(0, 6)
    elevation = 0.4 * np.sin(azimuth * 3)
    directions = np.stack([np.cos(azimuth), np.sin(azimuth), elevation], axis=1).astype(np.float32)
    return np.zeros((n, 3), np.float32), directions


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([1e-3, 1.0, 1e5]), st.integers(1, 40))
def test_sizes_and_odd_faces_do_no_harm(seed, size, faces):
    """Duplicates, points, lines and faces that are not finite: what is left is hit as if they were not there."""
    random = np.random.default_rng(seed)
    vertices, corners, _, _ = soup(seed, faces=faces)
    origins, directions = fan(64, 0.05, seed)
    vertices = (vertices * size).astype(np.float32)
    odd = np.concatenate([corners[:3], corners[:3, [0, 0, 1]], corners[:3, [2, 2, 2]]])
    broken = random.normal(0, size, (6, 3)).astype(np.float32)
    broken[[0, 4], [1, 2]] = np.nan, np.inf
    all_vertices = np.concatenate([vertices, broken])
    all_corners = np.concatenate([corners, odd, len(vertices) + np.arange(6, dtype=np.int32).reshape(2, 3)])
    plain = raycast(vertices, corners, origins, directions)
    got = raycast(vertices, np.concatenate([corners, odd]), origins, directions)
    assert np.array_equal(plain.distance, got.distance)
    with_broken = raycast(all_vertices, all_corners, origins, directions)
    assert not np.isnan(with_broken.distance).any()
    assert (with_broken.face < len(all_corners)).all()


def test_rays_that_are_not_finite_or_go_nowhere_hit_nothing():
    vertices, faces, _, _ = soup(11)
    origins, directions = fan(64)
    bad = [3, 17, 18, 40]
    directions[3], directions[17], origins[18], directions[40] = np.nan, np.inf, np.nan, 0.0
    hits = raycast(vertices, faces, origins, directions)
    assert (hits.face[bad] == -1).all()
    assert np.isinf(hits.distance[bad]).all()
    good = np.setdiff1d(np.arange(64), bad)
    clean = raycast(vertices, faces, origins[good], directions[good])
    assert np.array_equal(hits.distance[good], clean.distance)


def test_hits_are_those_of_open3d():
    o3d = pytest.importorskip("open3d", reason="Open3D cannot be loaded here", exc_type=ImportError)
    vertices, faces, origins, directions = soup(1, faces=20_000, rays=20_000)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(faces.astype(np.uint32)))
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    answer = scene.cast_rays(o3d.core.Tensor(np.hstack([origins, unit]).astype(np.float32)))
    hits = raycast(vertices, faces, origins, directions)
    assert agrees(hits.distance, answer["t_hit"].numpy())


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.1, 50.0))
def test_length_of_a_direction_does_not_matter(seed, length):
    vertices, faces, origins, directions = soup(seed, faces=50, rays=200)
    one = raycast(vertices, faces, origins, directions)
    other = raycast(vertices, faces, origins, directions * np.float32(length))
    hit = np.isfinite(one.distance) & np.isfinite(other.distance)
    close = np.isclose(one.distance[hit], other.distance[hit], atol=DISTANCE_TOLERANCE)
    assert close.sum() >= 0.99 * hit.sum()
    assert (np.isfinite(one.distance) == np.isfinite(other.distance)).mean() > 0.99


def test_normals_stand_on_the_faces_hit():
    vertices, faces, origins, directions = soup(2)
    hits = raycast(vertices, faces, origins, directions)
    found = hits.face >= 0
    a, b, c = vertices[faces[hits.face[found]]].transpose(1, 0, 2).astype(np.float64)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    assert np.allclose(np.abs((normal * hits.normal[found]).sum(1)), 1.0, atol=1e-3)


def test_nothing_is_hit_beyond_the_maximum_distance():
    vertices, faces, origins, directions = soup(3)
    hits = raycast(vertices, faces, origins, directions, max_distance=10.0)
    assert np.all((hits.distance <= 10.0) | np.isinf(hits.distance))


def test_torch_in_torch_out():
    torch = pytest.importorskip("torch")
    vertices, faces, origins, directions = soup(4, faces=40, rays=30)
    hits = raycast(*(torch.from_numpy(a) for a in (vertices, faces, origins, directions)))
    assert isinstance(hits.distance, torch.Tensor)
    assert np.array_equal(hits.face.numpy(), raycast(vertices, faces, origins, directions).face)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"faces": np.zeros((0, 3), np.int32)}, "faces"),
        ({"origins": np.zeros((5, 2), np.float32)}, "origins"),
        ({"directions": np.zeros((7, 3), np.float32)}, "directions"),
        ({"max_distance": 0.0}, "max_distance"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    vertices, faces, origins, directions = soup(5, faces=10, rays=5)
    arguments = {"vertices": vertices, "faces": faces, "origins": origins, "directions": directions} | change
    with pytest.raises(ValueError, match=message):
        raycast(**arguments)


# The plan: instances, materials, sensor.

PLAIN, GHOST, HALF = 1, 2, 3


def materials():
    table = np.zeros((MATERIALS, 6), np.float32)
    table[PLAIN] = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0
    table[GHOST] = 1.0, 1.0, 0.0, 0.0, 0.0, 0.0
    table[HALF] = 1.0, 0.5, 0.0, 0.0, 0.0, 0.0
    return table


def beams(n=4000):
    random = np.random.default_rng(6)
    directions = random.normal(0, 1, (n, 3))
    return (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)


def caster(meshes, directions, **options):
    n = len(directions)
    settings = {"range_noise": 0.0, "drop_out": 0.0, "min_range": 0.01, "reach": 1e4, "max_range": 500.0} | options
    cast = LidarCast(meshes=meshes, beams=directions, ring=np.arange(n) % 7, time=np.linspace(0, 0.1, n), **settings)
    cast.set_materials(materials())
    return cast


def affine(random, k):
    """Random turns, uneven scales and moves."""
    transforms = np.tile(np.eye(4), (k, 1, 1))
    for matrix in transforms:
        turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
        matrix[:3, :3] = turn * random.uniform(0.5, 2.0, 3)
        matrix[:3, 3] = random.normal(0, 12, 3)
    return transforms


def test_instances_are_hit_as_if_they_were_one_mesh(device):
    random = np.random.default_rng(7)
    shapes = [soup(seed, faces=30)[:2] for seed in (1, 2, 3)]
    meshes = MeshSet(device, max_faces=1000)
    for vertices, faces in shapes:
        meshes.add(vertices * 0.2, faces, np.full(len(faces), PLAIN + 256 * 5))
    which, transforms = random.integers(0, 3, 12), affine(random, 12)
    directions = beams()
    cast = caster(meshes, directions)
    cast.place(which, transforms)
    cast.aim(np.eye(4))
    cast.launch()

    world, owner = [], []
    for k, m in enumerate(which):
        vertices, faces = shapes[m]
        placed = (0.2 * vertices).astype(np.float64) @ transforms[k, :3, :3].T + transforms[k, :3, 3]
        world.append(placed[faces])
        owner += [k] * len(faces)
    corners = np.concatenate(world).reshape(-1, 3)
    expected, face = brute_force(corners, np.arange(len(corners)).reshape(-1, 3), np.zeros_like(directions), directions)
    distance = np.where(cast.hit_instance.numpy() >= 0, cast.distance.numpy(), np.inf)
    assert agrees(distance, expected)
    assert (cast.hit_instance.numpy() == np.where(face >= 0, np.array(owner)[face], -1)).mean() >= 0.999
    n = cast.count.numpy()[0]
    assert abs(n - np.isfinite(expected).sum()) <= 4
    assert np.all(cast.point_class.numpy()[:n] == 5)
    ranges = np.linalg.norm(cast.points.numpy()[:n, :3], axis=1)
    assert np.allclose(np.sort(ranges)[::50], np.sort(distance[np.isfinite(distance)])[::50], atol=1e-3)


def panes(*labels):
    """Square walls of 20 m before the sensor at x = 5, 6, 7 …, each with its label."""
    meshes = MeshSet("cpu", max_faces=100)
    for k, label in enumerate(labels):
        corners = np.array([[5 + k, -10, -10], [5 + k, 10, -10], [5 + k, 10, 10], [5 + k, -10, 10]], np.float32)
        meshes.add(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.full(2, label))
    directions = beams()
    directions = directions[directions[:, 0] > 0.8]
    cast = caster(meshes, directions)
    cast.place(np.arange(len(labels)), np.tile(np.eye(4), (len(labels), 1, 1)))
    cast.aim(np.eye(4), seed=3)
    cast.launch()
    return cast


def test_porous_faces_let_their_share_of_beams_through():
    assert np.all(panes(GHOST, PLAIN).hit_instance.numpy() == 1)
    share = (panes(HALF, PLAIN).hit_instance.numpy() == 1).mean()
    assert 0.4 < share < 0.6


@pytest.mark.parametrize("moving", [False, True])
def test_packets_and_single_rays_agree(moving):
    """Instances turned and scaled, some of them porous: equal but for rays that meet an edge, one in a thousand."""
    random = np.random.default_rng(12)
    meshes = MeshSet("cpu", max_faces=1000)
    for seed, label in ((1, PLAIN), (2, HALF), (3, GHOST)):
        vertices, faces, _, _ = soup(seed, faces=60)
        meshes.add(vertices * 0.5, faces, np.full(len(faces), label + 256 * seed))
    which, transforms = random.integers(0, 3, 40), affine(random, 40)
    end = np.eye(4)
    end[:3, 3] = 0.8, 0.1, 0.0
    results = []
    for method in ("packets", "single"):
        cast = caster(meshes, beams(5000), range_noise=0.02, drop_out=0.1, method=method)
        cast.place(which, transforms)
        cast.aim(np.eye(4), end if moving else None, seed=4)
        cast.launch()
        results.append([getattr(cast, name).numpy() for name in ("distance", "hit_instance", "hit_label")])
    for packets, single in zip(*results, strict=True):
        assert (packets == single).mean() > 0.999
    assert (results[0][1] >= 0).mean() > 0.2


@pytest.mark.parametrize("threads", [2, 3, 7])
def test_a_sweep_does_not_depend_on_the_number_of_threads(threads):
    before = thread_count()
    meshes = MeshSet("cpu", max_faces=1000)
    vertices, faces, _, _ = soup(8)
    meshes.add(vertices, faces, np.full(len(faces), HALF))
    sweeps = []
    try:
        for count in (1, threads):
            set_thread_count(count)
            cast = caster(meshes, beams(2000), range_noise=0.02, drop_out=0.1)
            cast.place(np.zeros(1, int), np.eye(4)[None])
            cast.aim(np.eye(4), seed=1)
            cast.launch()
            sweeps.append(cast.points.numpy()[: cast.count.numpy()[0]].tobytes())
    finally:
        set_thread_count(before)
    assert sweeps[0] == sweeps[1]


def test_the_same_seed_gives_the_same_bytes_and_another_does_not():
    meshes = MeshSet("cpu", max_faces=1000)
    vertices, faces, _, _ = soup(8)
    meshes.add(vertices, faces, np.full(len(faces), HALF))
    cast = caster(meshes, beams(), range_noise=0.02, drop_out=0.1)
    cast.place(np.zeros(1, int), np.eye(4)[None])

    def sweep(seed):
        cast.aim(np.eye(4), seed=seed)
        cast.launch()
        return cast.points.numpy()[: cast.count.numpy()[0]].tobytes()

    one, other, again = sweep(1), sweep(2), sweep(1)
    assert one == again
    assert one != other


def test_a_moving_sensor_shears_the_sweep():
    # A wall 50 m ahead; the sensor drives 1 m towards it during the sweep.
    meshes = MeshSet("cpu", max_faces=10)
    corners = np.array([[50, -90, -90], [50, 90, -90], [50, 90, 90], [50, -90, 90]], np.float32)
    meshes.add(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.full(2, PLAIN))
    directions = np.tile(np.array([[1.0, 0, 0]], np.float32), (11, 1))
    cast = caster(meshes, directions)
    end = np.eye(4)
    end[0, 3] = 1.0
    cast.place(np.zeros(1, int), np.eye(4)[None])
    cast.aim(np.eye(4), end)
    cast.launch()
    assert np.allclose(cast.distance.numpy(), np.linspace(50, 49, 11), atol=1e-3)


def placed_at(transform, motion, fraction):
    """World from local of an instance that has gone and turned a fraction of its way."""
    c, s = np.cos(fraction * motion[3]), np.sin(fraction * motion[3])
    turn = np.eye(4)
    turn[:2, :2] = [[c, -s], [s, c]]
    placed = transform @ turn
    placed[:3, 3] += fraction * np.asarray(motion[:3])
    return placed


@pytest.mark.parametrize("method", ["packets", "single"])
def test_each_beam_meets_moving_things_where_they_are_at_its_time(method):
    """Against a scene at rest for each of eleven times: equal but for beams that graze an edge, 1 %."""
    random = np.random.default_rng(21)
    meshes = MeshSet("cpu", max_faces=1000)
    for seed in (1, 2):
        vertices, faces, _, _ = soup(seed, faces=40)
        meshes.add(vertices * 0.3, faces, np.full(len(faces), PLAIN))
    which = random.integers(0, 2, 9)
    transforms = np.tile(np.eye(4), (9, 1, 1))
    transforms[:, :3, 3] = random.normal(0, 8, (9, 3))
    motion = random.normal(0, [1.0, 1.0, 0.3, 0.4], (9, 4))
    motion[:3] = 0.0  # of those at rest too
    motion[3, 3] = 0.0
    fan = beams(300)
    directions = np.tile(fan, (11, 1))
    fraction = np.repeat(np.linspace(0, 1, 11), len(fan))
    cast = LidarCast(meshes=meshes, beams=directions, ring=np.zeros(len(directions)), time=0.1 * fraction,
                     max_range=500.0, min_range=0.01, method=method)  # fmt: skip
    cast.set_materials(materials())
    cast.place(which, transforms, motion)
    cast.aim(np.eye(4))
    cast.launch()
    same, hits = 0, 0
    for k, f in enumerate(np.linspace(0, 1, 11)):
        still = LidarCast(meshes=meshes, beams=fan, ring=np.zeros(len(fan)), time=np.zeros(len(fan)),
                          max_range=500.0, min_range=0.01, method=method)  # fmt: skip
        still.set_materials(materials())
        still.place(which, np.array([placed_at(t, m, f) for t, m in zip(transforms, motion, strict=True)]))
        still.aim(np.eye(4))
        still.launch()
        own = slice(k * len(fan), (k + 1) * len(fan))
        agree = np.abs(cast.distance.numpy()[own] - still.distance.numpy()) < 5e-3
        agree &= cast.hit_instance.numpy()[own] == still.hit_instance.numpy()
        seen = still.hit_instance.numpy() >= 0
        assert np.allclose(cast.hit_normal.numpy()[own][agree], still.hit_normal.numpy()[agree], atol=1e-2)
        same, hits = same + agree.sum(), hits + seen.sum()
    assert same >= 0.99 * len(directions)
    assert hits > 300


@pytest.mark.parametrize("method", ["packets", "single"])
def test_several_worlds_in_one_launch_are_what_each_is_alone(method):
    random = np.random.default_rng(22)
    meshes = MeshSet("cpu", max_faces=1000)
    for seed in (1, 2, 3):
        vertices, faces, _, _ = soup(seed, faces=60)
        meshes.add(vertices * 0.4, faces, np.full(len(faces), (PLAIN, HALF, PLAIN)[seed - 1] + 256 * seed))
    directions = beams(1500)
    options = {"range_noise": 0.02, "drop_out": 0.1, "method": method, "max_instances": 16, "edge_share": 0.5}
    together = caster(meshes, directions, worlds=3, **options)
    alone = [caster(meshes, directions, **options) for _ in range(3)]
    for w, one in enumerate(alone):
        k = 5 + 3 * w
        which, transforms = random.integers(0, 3, k), affine(random, k)
        motion = random.normal(0, 0.5, (k, 4)) * (random.random((k, 1)) < 0.5)
        end = np.eye(4)
        end[0, 3] = 0.3 * w
        for cast, world in ((together, w), (one, 0)):
            cast.place(which, transforms, motion, world=world)
            cast.aim(np.eye(4), end, seed=70 + w, world=world)
            cast.set_rain(5.0 * w, world=world)
        one.launch()
    together.launch()
    n = len(directions)
    for w, one in enumerate(alone):
        count = one.count.numpy()[0]
        assert together.count.numpy()[w] == count > 100
        for name in ("points", "point_ring", "point_time", "point_class", "point_instance"):
            got = getattr(together, name).numpy()[w * n : w * n + count]
            assert got.tobytes() == getattr(one, name).numpy()[:count].tobytes(), name
    with pytest.raises(ValueError, match="world must be 0 to 2, not 3"):
        together.aim(np.eye(4), world=3)
    with pytest.raises(ValueError, match="worlds must be at least 1"):
        caster(meshes, directions, worlds=0)


def test_noise_has_the_spread_asked_for_and_far_dark_echoes_are_lost():
    meshes = MeshSet("cpu", max_faces=10)
    corners = np.array([[20, -90, -90], [20, 90, -90], [20, 90, 90], [20, -90, 90]], np.float32)
    meshes.add(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.full(2, PLAIN))
    directions = np.tile(np.array([[1.0, 0, 0]], np.float32), (20_000, 1))
    cast = caster(meshes, directions, range_noise=0.03)
    cast.place(np.zeros(1, int), np.eye(4)[None])
    cast.aim(np.eye(4))
    cast.launch()
    x = cast.points.numpy()[: cast.count.numpy()[0], 0]
    assert abs(x.mean() - 20) < 0.002
    assert abs(x.std() - 0.03) < 0.002
    weak = caster(meshes, directions, reach=20 / np.sqrt(10.0))
    weak.place(np.zeros(1, int), np.eye(4)[None])
    weak.aim(np.eye(4))
    weak.launch()
    # A full reflector at this range has a signal of 1: the point where half of the echoes are seen.
    assert 0.4 < weak.count.numpy()[0] / len(directions) < 0.6


def test_a_replaced_mesh_is_the_one_that_is_hit():
    meshes = MeshSet("cpu", max_faces=100)
    number = meshes.reserve(4)
    faces, labels = np.array([[0, 1, 2], [0, 2, 3]]), np.full(2, PLAIN)
    cast = caster(meshes, np.array([[1.0, 0, 0]], np.float32))
    for x in (5.0, 9.0):
        meshes.replace(number, np.array([[x, -1, -1], [x, 1, -1], [x, 1, 1], [x, -1, 1]]), faces, labels)
        cast.place(np.array([number]), np.eye(4)[None])
        cast.aim(np.eye(4))
        cast.launch()
        assert cast.distance.numpy()[0] == pytest.approx(x)
    with pytest.raises(ValueError, match="at most 4"):
        meshes.replace(number, np.zeros((3, 3)), np.zeros((5, 3), int), np.zeros(5, int))


def test_wrong_meshes_and_scenes_are_refused():
    meshes = MeshSet("cpu", max_faces=3)
    with pytest.raises(ValueError, match="faces must name vertices"):
        meshes.add(np.zeros((3, 3)), np.array([[0, 1, 3]]), np.zeros(1, int))
    with pytest.raises(ValueError, match="labels"):
        meshes.add(np.zeros((3, 3)), np.array([[0, 1, 2]]), np.zeros(2, int))
    with pytest.raises(ValueError, match="max_faces"):
        meshes.add(np.zeros((3, 3)), np.zeros((4, 3), int), np.zeros(4, int))
    cast = caster(meshes, beams(10), max_instances=2)
    with pytest.raises(ValueError, match="1 to 2 instances"):
        cast.place(np.zeros(3, int), np.tile(np.eye(4), (3, 1, 1)))
    with pytest.raises(ValueError, match="table"):
        cast.set_materials(np.zeros((3, 4)))
    with pytest.raises(ValueError, match="method must be 'auto', 'packets' or 'single', not 'both'"):
        caster(meshes, beams(10), method="both")


@pytest.mark.cuda
def test_the_sweep_can_be_captured(device):
    if device == "cpu":
        pytest.skip("graphs are captured on CUDA devices")
    meshes = MeshSet(device, max_faces=1000)
    vertices, faces, _, _ = soup(9)
    meshes.add(vertices, faces, np.full(len(faces), PLAIN))
    cast = caster(meshes, beams())
    cast.place(np.zeros(1, int), np.eye(4)[None])
    cast.aim(np.eye(4))
    cast.launch()
    once = cast.points.numpy()
    with wp.ScopedCapture(device=device) as capture:
        cast.launch()
    wp.capture_launch(capture.graph)
    assert np.array_equal(once, cast.points.numpy())


@pytest.mark.parametrize("threads", [2, 3, 7])
def test_results_do_not_depend_on_the_number_of_threads(threads):
    """To the byte, for ray counts around the size of a part's turn."""
    before = thread_count()
    try:
        for rays in (1, 255, 256, 257, 1500):
            given = soup(5, faces=200, rays=rays)
            set_thread_count(1)
            one = raycast(*given)
            set_thread_count(threads)
            many = raycast(*given)
            for name in ("distance", "face", "normal"):
                assert getattr(one, name).tobytes() == getattr(many, name).tobytes(), name
    finally:
        set_thread_count(before)
