"""Echoes: edges that mix, rain that takes and adds; ranges of the hits themselves are tested with the ray caster."""

import itertools

import numpy as np
import pytest

from warploom.kernels.meshes import MeshSet
from warploom.kernels.raycast import MATERIALS, LidarCast
from warploom.kernels.threads import set_thread_count, thread_count

PLAIN, NOISE = 1, 256 * 9


def wall(x, low, high):
    return np.array([[x, low, -90], [x, high, -90], [x, high, 90], [x, low, 90]], np.float32)


def sweep(walls, directions, *, ring=None, rain=0.0, seed=1, **options):
    """One sweep at walls facing the sensor; returns the plan."""
    meshes = MeshSet("cpu", max_faces=1000)
    for corners in walls:
        meshes.add(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.full(2, PLAIN))
    n = len(directions)
    settings = {"range_noise": 0.0, "drop_out": 0.0, "min_range": 0.5, "reach": 1e4, "max_range": 120.0} | options
    cast = LidarCast(meshes=meshes, beams=directions, ring=np.zeros(n) if ring is None else ring, time=np.zeros(n),
                     noise_label=NOISE, **settings)  # fmt: skip
    table = np.zeros((MATERIALS, 6), np.float32)
    table[PLAIN, 0] = 1.0
    cast.set_materials(table)
    cast.place(np.arange(len(walls)), np.tile(np.eye(4), (len(walls), 1, 1)))
    cast.aim(np.eye(4), seed=seed)
    cast.set_rain(rain)
    cast.launch()
    return cast


def fan(n=4001, half=0.6):
    azimuth = np.linspace(-half, half, n)
    return np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], 1).astype(np.float32)


def depth(cast):
    """x of each point: the walls stand across it."""
    return cast.points.numpy()[: cast.count.numpy()[0], 0]


def edges(count, gap):
    """Pairs of beams on a near wall with slits, through which the far wall is seen."""
    at = np.linspace(-4, 4, count + 1)
    near = [wall(8.0, a, 0.5 * (a + b)) for a, b in itertools.pairwise(at)]
    return [wall(8.0 + gap, -90, 90), *near]


def test_a_footprint_over_an_edge_gives_an_echo_in_between():
    walls = edges(150, gap=0.5)
    x = depth(sweep(walls, fan(), edge_share=0.6))
    between = (x > 8.01) & (x < 8.49)
    # 300 edges, each with a beam on either side whose footprint reaches over it in half of 0.6 of the cases.
    assert 300 * 0.6 * 0.6 < between.sum() < 300 * 0.6 * 1.4
    assert not ((depth(sweep(walls, fan())) > 8.01) & (depth(sweep(walls, fan())) < 8.49)).any()
    # No echo lies outside of the two surfaces.
    assert x.min() > 8 - 5e-3  # a neighbour on the same wall is a little nearer or farther
    assert x.max() < 8.5 + 5e-3


def test_surfaces_farther_apart_than_the_pulse_give_echoes_of_their_own():
    x = depth(sweep(edges(150, gap=3.0), fan(), edge_share=1.0, pulse=1.0))
    assert ((np.abs(x - 8) < 5e-3) | (np.abs(x - 11) < 5e-3)).all()


def test_beams_of_other_rings_do_not_mix():
    x = depth(sweep(edges(150, gap=0.5), fan(), ring=np.arange(4001) % 2, edge_share=1.0))
    assert ((np.abs(x - 8) < 1e-3) | (np.abs(x - 8.5) < 1e-3)).all()


def test_rain_takes_far_echoes_and_adds_near_ones():
    directions = np.tile(np.array([[1.0, 0, 0]], np.float32), (200_000, 1))
    far = [wall(30.0, -90, 90)]
    reach = 30.0 / np.sqrt(10.0)  # half of the echoes come back when it is dry
    dry, wet = sweep(far, directions, reach=reach), sweep(far, directions, rain=2.0, reach=reach)
    surface = depth(wet) > 29.9
    # Of a signal of 1, 0.5 is seen; of exp(−0.02 · 2^0.6 · 30), by the law of the third power, and texture of 20 %.
    signal = np.exp(-0.02 * 2**0.6 * 30.0)
    expected = signal**3 / (1 + signal**3)
    assert depth(dry).size == pytest.approx(0.5 * len(directions), rel=0.05)
    assert surface.sum() == pytest.approx(expected * len(directions), rel=0.2)
    drops = wet.points.numpy()[: wet.count.numpy()[0]][~surface]
    share = 5e-4 * 2**0.6 * 10.0
    assert len(drops) == pytest.approx(share * len(directions), rel=0.2)
    assert np.median(drops[:, 0]) == pytest.approx(0.5 + 4.0 * np.log(2.0), rel=0.15)
    assert drops[:, 3].max() < 0.05
    n = wet.count.numpy()[0]
    assert (wet.point_class.numpy()[:n][~surface] == 9).all()
    assert (wet.point_instance.numpy()[:n][~surface] == -1).all()
    assert (wet.point_class.numpy()[:n][surface] == 0).all()


def test_harder_rain_is_worse_and_its_measure_is_checked():
    directions = np.tile(np.array([[1.0, 0, 0]], np.float32), (5000, 1))
    counts = [(depth(sweep([wall(40.0, -90, 90)], directions, rain=r, reach=40.0)) > 39).sum() for r in (0, 5, 20, 60)]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > counts[-1]
    for rate in (-1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="rate"):
            sweep([wall(40.0, -90, 90)], directions[:3], rain=rate)
    with pytest.raises(ValueError, match="edge_share"):
        sweep([wall(40.0, -90, 90)], directions[:3], edge_share=1.5)


def own_polish(instance):
    """The share of the full polish that a thing has, by the finaliser of MurmurHash3: from 0.2 to 1."""
    h = 0x9E3779B9 ^ (instance * 2654435761 % 2**32) ^ (31 * 2246822519 % 2**32)
    h = (h ^ (h >> 16)) * 2246822507 % 2**32
    h = (h ^ (h >> 13)) * 3266489909 % 2**32
    return 0.2 + 0.8 * ((h ^ (h >> 16)) >> 8) / 2**24


def glossy(directions, *, mirror=0.5, polish=1.0, things=1, flipped=False):
    """The beams that come back from walls at x = 10, one a thing side by side, of which `mirror` is the last column."""
    meshes = MeshSet("cpu", max_faces=1000)
    at = np.linspace(-90, 90, things + 1)
    for low, high in itertools.pairwise(at):
        corners = wall(10.0, high, low)  # its front to the sensor
        meshes.add(corners[::-1] if flipped else corners, np.array([[0, 1, 2], [0, 2, 3]]), np.full(2, PLAIN))
    n = len(directions)
    cast = LidarCast(meshes=meshes, beams=directions, ring=np.zeros(n), time=np.zeros(n), range_noise=0.0, drop_out=0.0,
                     reach=1e6)  # fmt: skip
    table = np.zeros((MATERIALS, 6), np.float32)
    table[PLAIN] = 1.0, 0.0, 0.0, 0.0, 0.0, mirror
    cast.set_materials(table)
    cast.place(np.arange(things), np.tile(np.eye(4), (things, 1, 1)))
    cast.aim(np.eye(4), seed=4)
    cast.set_polish(polish)
    cast.launch()
    n = int(cast.count.numpy()[0])
    return cast.points.numpy()[:n, :3], cast.point_instance.numpy()[:n]


@pytest.mark.parametrize(("mirror", "polish"), [(0.5, 1.0), (0.5, 0.4), (0.9, 1.5)])
def test_polished_things_mirror_grazing_beams_away(mirror, polish):
    cosine = np.repeat([0.15, 0.3, 0.5, 0.8, 1.0], 20_000)
    directions = np.stack([cosine, 0 * cosine, np.sqrt(1 - cosine**2)], 1).astype(np.float32)
    points, _ = glossy(directions, mirror=mirror, polish=polish)
    came = points[:, 0] / np.linalg.norm(points, axis=1)
    half = mirror * polish * own_polish(0)
    for c in (0.15, 0.3, 0.5, 0.8, 1.0):
        # 20,000 beams: five standard deviations are 0.018.
        assert (np.abs(came - c) < 1e-3).sum() / 20_000 == pytest.approx(c**3 / (c**3 + half**3), abs=0.018)


def test_every_thing_has_a_polish_of_its_own_and_keeps_it():
    azimuth = np.linspace(-1.2, 1.2, 60_000)
    directions = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], 1).astype(np.float32)
    _, instance = glossy(directions, mirror=1.0, things=36)
    hit = np.floor((10.0 * np.tan(azimuth) + 90.0) / 5.0).astype(int)
    shares = []
    for k in np.unique(hit):
        c = np.cos(azimuth[hit == k])
        wanted = (c**3 / (c**3 + own_polish(int(k)) ** 3)).mean()
        shares.append(wanted)
        n = len(c)
        # Beams on the border of two walls may be of either.
        assert (instance == k).sum() / n == pytest.approx(wanted, abs=5 * np.sqrt(0.25 / n) + 2 / n)
    assert np.ptp(shares) > 0.2


def test_from_within_a_polished_shell_little_comes_back():
    directions = np.tile(np.array([[1.0, 0, 0]], np.float32), (50_000, 1))
    front, _ = glossy(directions, mirror=1e-6)
    back, _ = glossy(directions, mirror=1e-6, flipped=True)
    dull, _ = glossy(directions, mirror=0.0, flipped=True)
    assert len(front) == len(dull) == 50_000
    assert len(back) == pytest.approx(0.08 * 50_000, rel=0.1)


@pytest.mark.parametrize("polish", [-0.1, np.nan, np.inf])
def test_wrong_polish_is_refused(polish):
    with pytest.raises(ValueError, match="polish"):
        glossy(fan(3), polish=polish)


@pytest.mark.parametrize("rain", [0.0, 8.0])
def test_blocks_of_beams_give_the_bytes_of_one_beam_a_thread(rain):
    """What a CPU does in vector instructions, against the kernel that a GPU runs, from the same hits in two worlds."""
    random = np.random.default_rng(3)
    meshes = MeshSet("cpu", max_faces=1000)
    for corners in edges(40, gap=0.4):
        meshes.add(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.array([PLAIN, PLAIN + 1]))
    n = 3001  # no multiple of a block
    cast = LidarCast(
        meshes=meshes, beams=fan(n, half=1.2), ring=np.arange(n) // 700, time=np.linspace(0, 0.1, n), worlds=2,
        min_range=0.5, reach=9.0, range_noise=0.02, drop_out=0.05, edge_share=0.7, noise_label=NOISE,
    )  # fmt: skip
    table = np.zeros((MATERIALS, 6), np.float32)
    table[PLAIN], table[PLAIN + 1] = (0.6, 0.0, 0.05, 0.3, 0.02, 0.9), (0.2, 0.0, 0.0, 0.0, 0.0, 0.0)
    cast.set_materials(table)
    for world in range(2):
        places = np.tile(np.eye(4), (len(meshes), 1, 1))
        places[:, :3, 3] += random.normal(0, 0.2, (len(meshes), 3))
        cast.place(np.arange(len(meshes)), places, world=world)
        turned = np.eye(4)
        turned[:2, :2] = [[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]]
        cast.aim(np.eye(4), turned, seed=5 + world, world=world)
        cast.set_rain(rain, world=world)
        cast.set_polish(0.5 + world, world=world)

    def said():
        cast.launch()
        own = [slice(w * n, w * n + count) for w, count in enumerate(cast.count.numpy())]
        arrays = (cast.points, cast.point_ring, cast.point_time, cast.point_class, cast.point_instance)
        return [array.numpy()[part].tobytes() for part in own for array in arrays]

    in_blocks = said()
    assert all(300 < count < n for count in cast.count.numpy())
    object.__setattr__(cast, "cast", lambda: None)  # the hits stay
    object.__setattr__(cast, "_packets", False)
    assert said() == in_blocks


def test_echoes_are_the_same_in_any_number_of_parts():
    walls, said = edges(60, gap=0.5), set()
    before = thread_count()
    try:
        for threads in (1, 2, 3, 7):
            set_thread_count(threads)
            cast = sweep(walls, fan(), edge_share=0.6, rain=3.0, range_noise=0.02, drop_out=0.1)
            said.add(cast.points.numpy()[: cast.count.numpy()[0]].tobytes())
    finally:
        set_thread_count(before)
    assert len(said) == 1
