"""Beams and chance, for device code, against the same in NumPy and SciPy."""

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation, Slerp

from warploom.kernels.beams import ray_of, uniform, world_normal


@wp.kernel
def _uniforms(seed: wp.uint32, out: wp.array2d(dtype=wp.float32)):
    a, b = wp.tid()
    out[a, b] = uniform(seed, wp.uint32(a), wp.uint32(b))


@wp.kernel
def _rays(
    world: int,
    beams: wp.array(dtype=wp.vec3),
    fraction: wp.array(dtype=wp.float32),
    pose: wp.array(dtype=wp.transform),
    origin: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    o, d = ray_of(i, world, beams, fraction, pose)
    origin[i] = o
    direction[i] = d


@wp.kernel
def _normals(normal: wp.vec3, rows: wp.array(dtype=wp.vec4), out: wp.array(dtype=wp.vec3)):
    out[0] = world_normal(normal, rows[0], rows[1], rows[2])


def uniforms(seed, shape, device="cpu"):
    out = wp.zeros(shape, dtype=wp.float32, device=device)
    wp.launch(_uniforms, shape, inputs=[seed], outputs=[out], device=device)
    return out.numpy()


def test_chance_is_the_hash_it_says(device):
    """MurmurHash3's finaliser, in unsigned integers of NumPy; equal on every device."""
    seed, (a, b) = np.uint32(77), np.meshgrid(*[np.arange(50, dtype=np.uint32)] * 2, indexing="ij")
    h = seed ^ (a * np.uint32(2654435761)) ^ (b * np.uint32(2246822519))
    h = (h ^ (h >> np.uint32(16))) * np.uint32(2246822507)
    h = (h ^ (h >> np.uint32(13))) * np.uint32(3266489909)
    h ^= h >> np.uint32(16)
    expected = (h >> np.uint32(8)).astype(np.float32) / np.float32(2**24)
    assert np.array_equal(uniforms(77, (50, 50), device), expected)


def test_chance_is_even():
    """A quarter of a million numbers: each tenth of [0, 1) has its share within five standard deviations (0.15 %)."""
    numbers = uniforms(5, (500, 500)).ravel()
    assert 0.0 <= numbers.min() < numbers.max() < 1.0
    share = np.histogram(numbers, 10, (0, 1))[0] / numbers.size
    assert np.abs(share - 0.1).max() < 0.003


def test_rays_turn_and_move_with_the_sensor():
    """Beside SciPy's slerp, in the second of two worlds: within 1e-4, of a turn of 6° in a sweep."""
    random = np.random.default_rng(1)
    n = 100
    beams = random.normal(size=(n, 3))
    beams /= np.linalg.norm(beams, axis=1, keepdims=True)
    fraction = np.linspace(0, 1, n)
    turns = Rotation.from_rotvec([[0.1, 0.2, 0.3], [0.1, 0.2, 0.4]])
    places = np.array([[1.0, 2.0, 3.0], [1.8, 2.1, 3.0]])
    poses = np.c_[places, turns.as_quat()]
    pose = wp.array(np.r_[poses[::-1] + 1.0, poses].astype(np.float32), dtype=wp.transform)
    got = [wp.zeros(n, dtype=wp.vec3) for _ in range(2)]
    inputs = [1, wp.array(beams, dtype=wp.vec3), wp.array(fraction, dtype=wp.float32), pose]
    wp.launch(_rays, n, inputs=inputs, outputs=got)
    assert np.abs(got[0].numpy() - (places[0] + fraction[:, None] * (places[1] - places[0]))).max() < 1e-5
    expected = Slerp([0.0, 1.0], turns)(fraction).apply(beams)
    assert np.abs(got[1].numpy() - expected).max() < 1e-4


def test_normals_stand_on_faces_that_are_stretched():
    """The transposed inverse, as for any affine map: a face's edges, carried into the world, are at right angles."""
    random = np.random.default_rng(2)
    world_from_local = random.normal(size=(3, 3))
    corners = random.normal(size=(3, 3))
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    rows = wp.array(np.c_[np.linalg.inv(world_from_local), np.zeros(3)].astype(np.float32), dtype=wp.vec4)
    out = wp.zeros(1, dtype=wp.vec3)
    wp.launch(_normals, 1, inputs=[wp.vec3(*normal.astype(np.float32)), rows], outputs=[out])
    edges = (corners[1:] - corners[0]) @ world_from_local.T
    edges /= np.linalg.norm(edges, axis=1, keepdims=True)
    assert np.abs(edges @ out.numpy()[0]).max() < 1e-5
    assert abs(np.linalg.norm(out.numpy()[0]) - 1) < 1e-6
