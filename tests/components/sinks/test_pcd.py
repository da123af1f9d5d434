"""PCD files as they are written: Open3D reads them, and our own reader gives back every bit."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from warploom.components.sinks.pcd import encode_pcd
from warploom.components.sources.pcd import decode_pcd_columns

FORMS = ["ascii", "binary", "binary_compressed"]
LAYOUT = [
    ("x", "f4"),
    ("y", "f4"),
    ("z", "f4"),
    ("intensity", "f4"),
    ("ring", "u2"),
    ("stamp", "f8"),
    ("pair", "i4", (2,)),
]


def cloud(n, seed=0):
    rng = np.random.default_rng(seed)
    points = np.zeros(n, LAYOUT)
    for axis in "xyz":
        points[axis] = rng.normal(scale=40, size=n)
    points["intensity"] = rng.uniform(size=n)
    points["ring"] = rng.integers(0, 128, n)
    points["stamp"] = 1.7e9 + rng.uniform(size=n)
    points["pair"] = rng.integers(-(2**31), 2**31 - 1, (n, 2))
    return points


@pytest.mark.parametrize("form", FORMS)
def test_open3d_reads_what_was_written(form, tmp_path):
    o3d = pytest.importorskip("open3d", exc_type=ImportError)
    points = cloud(3000)[["x", "y", "z", "intensity"]]
    points["x"][500:900] = 1.5  # runs for the packer
    path = tmp_path / "a.pcd"
    path.write_bytes(encode_pcd(points, form))
    read = o3d.t.io.read_point_cloud(str(path))
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1)
    assert read.point.positions.numpy().dtype == np.float32
    # Open3D may round a number that it reads as text to the one beside it.
    tolerance = 1.2e-7 if form == "ascii" else 0.0
    np.testing.assert_allclose(read.point.positions.numpy(), xyz, rtol=tolerance, atol=0)
    np.testing.assert_allclose(read.point.intensity.numpy()[:, 0], points["intensity"], rtol=tolerance, atol=0)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("n", [0, 1, 500])
def test_every_field_comes_back_to_the_bit(form, n):
    points = cloud(n, 1)
    columns, rows, kind = decode_pcd_columns(encode_pcd(points, form), "a.pcd")
    assert (rows, kind, list(columns)) == (1, form, list(points.dtype.names))
    for name, values in columns.items():
        assert values.dtype == points[name].dtype
        assert values.tobytes() == points[name].tobytes()


@given(st.data(), st.sampled_from(["f4", "f8"]), st.sampled_from(FORMS))
@settings(max_examples=60, deadline=None)
def test_any_float_comes_back_to_the_bit(data, code, form):
    floats = st.floats(width=8 * int(code[1]), allow_nan=False)
    points = np.zeros(5, [("x", code)])
    points["x"] = data.draw(hnp.arrays(code, 5, elements=floats))
    columns, _, _ = decode_pcd_columns(encode_pcd(points, form), "a.pcd")
    assert columns["x"].tobytes() == points["x"].tobytes()


@pytest.mark.parametrize("form", FORMS)
def test_rows_unfinished_numbers_and_byte_orders(form):
    points = cloud(12, 2).reshape(3, 4)
    points["x"][1, 2] = np.nan
    big = points.astype(points.dtype.newbyteorder(">"))
    columns, rows, _ = decode_pcd_columns(encode_pcd(big, form), "a.pcd")
    assert rows == 3
    np.testing.assert_array_equal(columns["x"], points["x"].ravel())
    np.testing.assert_array_equal(columns["pair"], points["pair"].reshape(12, 2))


@pytest.mark.parametrize(
    ("points", "form", "said"),
    [
        (np.zeros(2, [("x", "f4")]), "text", "form must be ascii, binary or binary_compressed, not 'text'"),
        (np.zeros(2, [("x", "f2")]), "binary", "field 'x' is of float16: PCD has integers and floats"),
        (np.zeros(2, [("x y", "f4")]), "binary", "field 'x y': a name in a PCD file is one word"),
        (np.zeros(2, [("x", "U4")]), "binary", "field 'x' is of <U4"),
    ],
)
def test_what_pcd_has_no_place_for_is_refused(points, form, said):
    with pytest.raises(ValueError, match=said):
        encode_pcd(points, form)
