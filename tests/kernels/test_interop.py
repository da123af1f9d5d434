"""Array families in and out: NumPy, torch, Warp, and others that speak DLPack."""

import numpy as np
import pytest
import warp as wp

from warploom.kernels.cluster import cluster
from warploom.kernels.downsample import voxel_downsample
from warploom.kernels.interop import adopt, borrow, borrow_points, count_on, family_of, give
from warploom.kernels.voxel import voxelize

torch = pytest.importorskip("torch", reason="torch is not installed")


class OnlyDlpack:
    """An array of no library we know."""

    def __init__(self, array):
        self.array = array
        self.shape = array.shape

    def __dlpack__(self, **keywords):
        return self.array.__dlpack__(**keywords)

    def __dlpack_device__(self):
        return self.array.__dlpack_device__()


FAMILIES = {
    "numpy": lambda array: array,
    "torch": torch.from_numpy,
    "warp": lambda array: wp.array(array, dtype=wp.float32, device="cpu"),
    "dlpack": OnlyDlpack,
}


def as_numpy(array):
    return array.numpy() if isinstance(array, wp.array | torch.Tensor) else np.asarray(array)


def table(n=200, columns=5, seed=0):
    return np.random.default_rng(seed).uniform(-3, 3, (n, columns)).astype(np.float32)


@pytest.mark.parametrize("family", FAMILIES)
def test_points_are_borrowed_without_a_copy(family):
    points = table()
    array = FAMILIES[family](points)
    borrowed = borrow_points(array)
    assert borrowed.family.name == family
    assert borrowed.device == "cpu"
    assert len(borrowed) == 200
    np.testing.assert_array_equal(borrowed.xyz.numpy(), points[:, :3])
    np.testing.assert_array_equal(borrowed.intensity.numpy(), points[:, 3])
    np.testing.assert_array_equal(borrowed.extra.numpy(), points[:, 3:])
    if family == "warp":
        assert borrowed.xyz.ptr == array.ptr
    else:
        assert borrowed.xyz.ptr == points.ctypes.data


@pytest.mark.parametrize("family", FAMILIES)
def test_results_are_of_the_callers_family(family):
    points = table()
    given = FAMILIES[family](points)
    kind = {"numpy": np.ndarray, "torch": torch.Tensor}.get(family, wp.array)
    for actual, expected in (
        (cluster(given, 0.6), cluster(points, 0.6)),
        (voxel_downsample(given, 0.5), voxel_downsample(points, 0.5)),
        (voxelize(given, 0.5, (-3, -3, -3, 3, 3, 3)).features, voxelize(points, 0.5, (-3, -3, -3, 3, 3, 3)).features),
        (voxelize(given, 0.5, (-3, -3, -3, 3, 3, 3)).counts, voxelize(points, 0.5, (-3, -3, -3, 3, 3, 3)).counts),
    ):
        assert isinstance(actual, kind)
        np.testing.assert_array_equal(as_numpy(actual), expected)
    np.testing.assert_array_equal(as_numpy(given) if family != "dlpack" else points, table())


def read_only():
    points = table()
    points.flags.writeable = False
    return points


LAYOUTS = {
    "columns of a wider table": lambda: table(columns=9)[:, 2:6],
    "every other row": lambda: table(400)[::2],
    "rows in reverse": lambda: table()[::-1],
    "columns in reverse": lambda: table()[:, ::-1],
    "column-major": lambda: np.asfortranarray(table()),
    "one row for all": lambda: np.broadcast_to(table(1), (200, 5)),
    "one column for all": lambda: np.broadcast_to(table(columns=1), (200, 4)),
    "unaligned": lambda: np.frombuffer(b"\0" + table().tobytes(), np.uint8)[1:].view(np.float32).reshape(200, 5),
    "big-endian": lambda: table().astype(">f4"),
    "float64": lambda: table().astype(np.float64),
    "float16": lambda: table().astype(np.float16),
    "read-only": read_only,
    "one row": lambda: table(1),
    "no row": lambda: table(0),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_any_layout_of_numpy_gives_what_its_plain_copy_gives(layout):
    points = LAYOUTS[layout]()
    plain = np.ascontiguousarray(points, dtype=np.float32)
    borrowed = borrow_points(points)
    np.testing.assert_array_equal(borrowed.xyz.numpy().reshape(-1, 3), plain[:, :3])
    np.testing.assert_array_equal(borrowed.extra.numpy(), plain[:, 3:])
    np.testing.assert_array_equal(cluster(points, 0.6), cluster(plain, 0.6))
    np.testing.assert_array_equal(voxel_downsample(points, 0.5), voxel_downsample(plain, 0.5))


@pytest.mark.parametrize(
    "change",
    [
        lambda t: t[:, 1:],
        lambda t: t[::2],
        lambda t: t.double(),
        lambda t: t.half(),
        lambda t: t.T.contiguous().T,
        lambda t: t[:1].expand(7, 5),
        lambda t: t.requires_grad_(),
        lambda t: t[:0],
    ],
    ids=["columns", "rows", "double", "half", "transposed", "expanded", "gradient", "empty"],
)
def test_any_layout_of_torch(change):
    points = change(torch.from_numpy(table()))
    plain = points.detach().to(torch.float32).numpy().copy()
    labels = cluster(points, 0.6)
    assert isinstance(labels, torch.Tensor)
    np.testing.assert_array_equal(labels.numpy(), cluster(plain, 0.6))


@pytest.mark.parametrize(
    "make",
    [
        lambda p: wp.array(p[:, :3], dtype=wp.vec3, device="cpu"),
        lambda p: wp.array(p.astype(np.float64), dtype=wp.float64, device="cpu"),
        lambda p: wp.array(p, dtype=wp.float32, device="cpu")[:, :4],
        lambda p: wp.array(p[::-1].copy()[::-1], dtype=wp.float32, device="cpu"),
    ],
    ids=["vec3", "float64", "columns", "reversed"],
)
def test_any_layout_of_warp(make):
    points = table()
    labels = cluster(make(points), 0.6)
    assert isinstance(labels, wp.array)
    np.testing.assert_array_equal(labels.numpy(), cluster(points, 0.6))


@pytest.mark.parametrize("function", [lambda p: cluster(p, 0.5), lambda p: voxel_downsample(p, 0.5)])
@pytest.mark.parametrize(
    ("points", "error", "message"),
    [
        (np.zeros((4, 2), np.float32), ValueError, r"points must have shape \(n, 3 or more\), not \(4, 2\)"),
        (np.zeros(12, np.float32), ValueError, "points must have shape"),
        (np.zeros((2, 4, 3), np.float32), ValueError, "points must have shape"),
        (np.zeros((4, 3), np.int32), TypeError, "points must be of a floating type, not int32"),
        (np.zeros((4, 3), np.complex64), TypeError, "floating type"),
        (np.zeros((4, 3), object), TypeError, "floating type"),
        (torch.zeros((4, 3), dtype=torch.int64), TypeError, "points must be of a floating type"),
        ([[0.0, 0.0, 0.0]], TypeError, "points must be a NumPy, torch, Warp or DLPack array, not list"),
        (None, TypeError, "not NoneType"),
    ],
)
def test_what_is_not_a_table_of_points_is_refused(function, points, error, message):
    with pytest.raises(error, match=message):
        function(points)


@pytest.mark.parametrize("family", ["numpy", "torch"])
def test_borrow_converts_to_the_type_wanted(family):
    labels = np.arange(6, dtype=np.int64)
    array = FAMILIES[family](labels)
    view, _owner = borrow(array, wp.int32, (None,), "labels")
    assert view.dtype == wp.int32
    np.testing.assert_array_equal(view.numpy(), labels)


def test_borrow_refuses_other_shapes_and_fractions():
    with pytest.raises(ValueError, match=r"labels must have shape \(n\), not \(2, 3\)"):
        borrow(np.zeros((2, 3), np.int32), wp.int32, (None,), "labels")
    with pytest.raises(ValueError, match=r"boxes must have shape \(n, 7\), not \(2, 3\)"):
        borrow(np.zeros((2, 3), np.float32), wp.float32, (None, 7), "boxes")
    with pytest.raises(TypeError, match="labels must be of an integer type, not float32"):
        borrow(np.zeros(3, np.float32), wp.int32, (None,), "labels")
    with pytest.raises(TypeError, match="numeric"):
        borrow(np.zeros(3, "U4"), wp.float32, (None,), "names")


def test_what_is_given_is_a_copy():
    source = wp.array(np.arange(5, dtype=np.int32), device="cpu")
    for family in FAMILIES:
        kept = give(source, family_of(FAMILIES[family](table())))
        source.fill_(9)
        np.testing.assert_array_equal(as_numpy(kept), np.arange(5))
        source.assign(np.arange(5, dtype=np.int32))


def test_what_is_adopted_is_not_a_copy():
    for family in FAMILIES:
        host = np.arange(5, dtype=np.float32)
        adopted = adopt(host, family_of(FAMILIES[family](table())))
        host[0] = 7
        assert as_numpy(adopted)[0] == 7


def test_counts_are_kept(device):
    assert count_on(12, device).numpy().tolist() == [12]
    assert count_on(12, device) is count_on(12, device)
