import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.components.sources import read, read_scan
from warploom.components.sources.ply import decode_ply
from warploom.errors import SourceError


def ply(format="binary_little_endian", points=3, body=None, before="", properties="float x\nfloat y\nfloat z"):
    lines = "".join(f"property {line}\n" for line in properties.split("\n"))
    head = f"ply\nformat {format} 1.0\ncomment made for a test\n{before}element vertex {points}\n{lines}end_header\n"
    return head.encode() + (np.arange(3 * points, dtype="<f4").tobytes() if body is None else body)


@pytest.mark.parametrize("ascii", [True, False])
def test_what_open3d_wrote_comes_back(tmp_path, ascii):
    o3d = pytest.importorskip("open3d", exc_type=ImportError)
    rng = np.random.default_rng(1)
    xyz, intensity = rng.normal(size=(1000, 3)).astype(np.float32), rng.uniform(size=(1000, 1)).astype(np.float32)
    written = o3d.t.geometry.PointCloud(o3d.core.Tensor(xyz))
    written.point["intensity"] = o3d.core.Tensor(intensity)
    assert o3d.t.io.write_point_cloud(str(tmp_path / "a.ply"), written, write_ascii=ascii)
    # Open3D writes six digits into text.
    np.testing.assert_allclose(
        read_scan(tmp_path / "a.ply").points, np.hstack([xyz, intensity]), atol=2e-5 if ascii else 0, rtol=0
    )


@pytest.mark.parametrize("format", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_properties_of_any_order_and_type_are_found_after_another_element(format):
    dtype = np.dtype([("intensity", "u1"), ("z", "f8"), ("x", "f4"), ("y", "f4"), ("ring", "u2")])
    table = np.zeros(5, dtype.newbyteorder(">" if format.endswith("big_endian") else "<"))
    for name in "xyz":
        table[name] = np.random.default_rng(3).normal(size=5)
    table["intensity"], table["ring"] = 255, np.arange(5)
    if format == "ascii":
        lines = ["1 2", *(" ".join(str(value) for value in row.tolist()) for row in table), "3 0 1 2"]
        body = "\n".join(lines).encode()
    else:
        body = b"\0" * 8 + table.tobytes() + b"\3\0\0\0\0"
    data = ply(
        format,
        5,
        body,
        before="element camera 1\nproperty float a\nproperty int b\n",
        properties="uchar intensity\ndouble z\nfloat x\nfloat32 y\nuint16 ring",
    )
    scan = decode_ply(data, "a.ply")
    for axis, name in enumerate("xyz"):
        np.testing.assert_array_equal(scan.points[:, axis], table[name].astype(np.float32))
    np.testing.assert_array_equal(scan.points[:, 3], 1.0)
    np.testing.assert_array_equal(scan.ring, np.arange(5))


@pytest.mark.parametrize("format", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_a_file_without_vertices_is_an_empty_scan(format):
    assert decode_ply(ply(format, 0, b""), "a.ply").points.shape == (0, 4)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "not a PLY file"),
        (b"# .PCD\n", "not a PLY file"),
        (ply()[:-1], "truncated"),
        (ply("ascii", 3, b"1 2 3\n4 5 6\n"), "2 lines follow"),
        (ply("ascii", 2, b"1 2\n4 5\n"), "2 numbers"),
        (ply("zipped"), "not known"),
        (ply(properties="float x\nfloat y"), "no field z"),
        (ply(properties="float x\nfloat x\nfloat z"), "same name"),
        (ply(properties="float x\nfloat y\nlist uchar int z"), "a list"),
        (b"ply\nformat ascii 1.0\nelement face 1\nproperty float x\nend_header\n1\n", "no element vertex"),
    ],
)
def test_a_bad_file_says_where_and_what(data, message):
    with pytest.raises(SourceError, match=message) as error:
        decode_ply(data, "folder/a.ply")
    assert "folder/a.ply" in str(error.value)


@given(st.data())
@settings(max_examples=200, deadline=None)
def test_damage_anywhere_is_a_source_error_or_a_scan(data):
    whole = data.draw(st.sampled_from([ply(), ply("binary_big_endian"), ply("ascii", 2, b"1 2 3\nnan 5 6\n")]))
    damaged = bytearray(whole[: data.draw(st.integers(0, len(whole)))])
    for _ in range(data.draw(st.integers(0, 3))):
        if damaged:
            damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    try:
        scan = decode_ply(bytes(damaged), "a.ply")
    except SourceError:
        return
    assert scan.points.shape[1] == 4


@pytest.mark.real
def test_a_real_pair_of_scans_is_read(shared_data):
    target, source = sorted(read(shared_data / "registration_pair"), key=lambda frame: len(frame.points))
    assert (len(target.points), len(source.points)) == (69088, 69792)
    assert np.isfinite(source.points).all()
