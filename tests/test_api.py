"""The public names, and the promise they share: any family of arrays in, the same family out, the same values."""

import numpy as np
import pytest

import warploom as wl

torch = pytest.importorskip("torch")

RANGE = (-20.0, -20.0, -3.0, 20.0, 20.0, 3.0)


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    """A plane with boxes on it, x y z intensity."""
    rng = np.random.default_rng(11)
    ground = np.column_stack([rng.uniform(-18, 18, (6000, 2)), rng.normal(-1.7, 0.02, 6000), rng.random(6000)])
    centres = rng.uniform(-15, 15, (12, 1, 2))
    things = np.concatenate(
        [centres + rng.uniform(-0.8, 0.8, (12, 150, 2)), rng.uniform(-1.5, 0, (12, 150, 1))], axis=2
    )
    things = np.column_stack([things.reshape(-1, 3), rng.random(12 * 150)])
    return np.concatenate([ground, things]).astype(np.float32)


CALLS = {
    "voxel_downsample": lambda p: (wl.voxel_downsample(p, 0.5),),
    "voxelize": lambda p: (lambda v: (v.features, v.coords, v.counts))(wl.voxelize(p, 0.5, RANGE, 16, 8000)),
    "segment_ground": lambda p: (lambda g: (g.mask, g.height))(wl.segment_ground(p)),
    "cluster": lambda p: (wl.cluster(p, 0.4, 5),),
    "bev": lambda p: (wl.bev(p, RANGE, (64, 64)),),
    "fit_boxes": lambda p: (wl.fit_boxes(p, wl.cluster(p, 0.4, 5)),),
}


def test_every_public_name_is_there_and_listed_once():
    assert len(set(wl.__all__)) == len(wl.__all__)
    for name in wl.__all__:
        assert getattr(wl, name) is not None, name
    assert set(wl.__all__) == set(wl._HOME_OF)
    assert set(wl.__all__) <= set(dir(wl))


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'clutser'"):
        _ = wl.clutser


@pytest.mark.parametrize("name", CALLS)
def test_numpy_in_numpy_out(name, points):
    for array in CALLS[name](points):
        assert isinstance(array, np.ndarray)
        assert array.flags.owndata or array.base is not None
        assert len(array) > 0


@pytest.mark.parametrize("name", CALLS)
def test_torch_in_torch_out_with_the_same_values(name, points):
    for expected, actual in zip(CALLS[name](points), CALLS[name](torch.from_numpy(points.copy())), strict=True):
        assert isinstance(actual, torch.Tensor)
        assert actual.device.type == "cpu"
        np.testing.assert_array_equal(actual.numpy(), expected)


@pytest.mark.parametrize("name", CALLS)
def test_warp_in_warp_out_with_the_same_values(name, points):
    import warp as wp

    given = wp.array(points, dtype=wp.float32, device="cpu")
    for expected, actual in zip(CALLS[name](points), CALLS[name](given), strict=True):
        assert isinstance(actual, wp.array)
        np.testing.assert_array_equal(actual.numpy().reshape(expected.shape), expected)


@pytest.mark.parametrize("name", CALLS)
def test_the_input_is_left_as_it_is_and_may_be_read_only(name, points):
    given = points.copy()
    given.setflags(write=False)
    CALLS[name](given)
    np.testing.assert_array_equal(given, points)


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.parametrize("n", [0, 1])
def test_no_point_and_one_point_are_fine(name, n, points):
    for array in CALLS[name](points[:n]):
        assert isinstance(array, np.ndarray)


@pytest.mark.parametrize("name", CALLS)
def test_a_list_and_a_wrong_shape_are_refused_by_name(name, points):
    with pytest.raises(TypeError, match="points must be a NumPy, torch, Warp or DLPack array"):
        CALLS[name](points.tolist())
    with pytest.raises(ValueError, match="points must have shape"):
        CALLS[name](points[:, :2])
    with pytest.raises(TypeError, match="floating type"):
        CALLS[name](points.astype(np.int32))
