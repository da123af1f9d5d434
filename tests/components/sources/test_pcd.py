import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.components.lzf import lzf_compress
from warploom.components.sources import read, read_scan
from warploom.components.sources.pcd import decode_pcd
from warploom.errors import SourceError


def header(data, fields="x y z", size="4 4 4", kinds="F F F", points=2, extra=""):
    text = f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {size}\nTYPE {kinds}\n{extra}"
    return f"{text}WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n".encode()


@pytest.mark.parametrize(("ascii", "compressed"), [(True, False), (False, False), (False, True)])
def test_what_open3d_wrote_comes_back(tmp_path, ascii, compressed):
    o3d = pytest.importorskip("open3d", exc_type=ImportError)
    rng = np.random.default_rng(1)
    xyz = rng.normal(scale=30, size=(5000, 3)).astype(np.float32)
    intensity = rng.uniform(size=(5000, 1)).astype(np.float32)
    xyz[100:200] = 0  # runs for the packer
    written = o3d.t.geometry.PointCloud(o3d.core.Tensor(xyz))
    written.point["intensity"] = o3d.core.Tensor(intensity)
    path = str(tmp_path / "a.pcd")
    assert o3d.t.io.write_point_cloud(path, written, write_ascii=ascii, compressed=compressed)
    scan = read_scan(path)
    # Text has ten digits after the point in Open3D: float32 comes back to its last bit or the one beside it.
    tolerance = 1e-6 if ascii else 0.0
    np.testing.assert_allclose(scan.points, np.hstack([xyz, intensity]), rtol=tolerance, atol=0)
    assert scan.format.endswith(
        {(True, False): "ascii", (False, False): "binary", (False, True): "compressed"}[ascii, compressed]
    )


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_fields_of_any_order_and_type_are_found(kind):
    dtype = np.dtype(
        [("t", "<u4"), ("z", "<f8"), ("pad", "<u1", 3), ("y", "<f4"), ("x", "<f4"), ("Ring", "<u2"), ("i", "<u1")]
    )
    table = np.zeros(9, dtype)
    rng = np.random.default_rng(2)
    for name in "xyz":
        table[name] = rng.normal(size=9)
    table["t"], table["Ring"], table["i"] = np.arange(9) * 1000, np.arange(9), 51 * (np.arange(9) % 6)
    head = header(
        kind, "t z pad y x Ring intensity", "4 8 1 4 4 2 1", "U F U F F U U", points=9, extra="COUNT 1 1 3 1 1 1 1\n"
    )
    if kind == "ascii":
        lines = [" ".join(str(v) for f in dtype.names for v in np.ravel(row[f]).tolist()) for row in table]
        body = "\n".join(lines).encode()
    elif kind == "binary":
        body = table.tobytes()
    else:
        raw = b"".join(np.ascontiguousarray(table[name]).tobytes() for name in dtype.names)
        packed = lzf_compress(raw)
        body = struct.pack("<II", len(packed), len(raw)) + packed
    scan = decode_pcd(head + body, "a.pcd")
    for axis, name in enumerate("xyz"):
        np.testing.assert_array_equal(scan.points[:, axis], table[name].astype(np.float32))
    np.testing.assert_allclose(scan.points[:, 3], table["i"] / 255, rtol=1e-6)  # bytes are scaled to 0…1
    np.testing.assert_array_equal(scan.ring, np.arange(9))
    np.testing.assert_allclose(scan.t, np.arange(9) * 1e-6, rtol=1e-6)  # integers are nanoseconds


@pytest.mark.parametrize("body", [("ascii", b""), ("binary", b""), ("binary_compressed", bytes(8))])
def test_a_file_without_points_is_an_empty_scan(body):
    scan = decode_pcd(header(body[0], points=0) + body[1], "a.pcd")
    assert scan.points.shape == (0, 4)


def test_stamps_of_a_clock_become_offsets():
    table = np.zeros(3, np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("timestamp", "<f8")]))
    table["timestamp"] = 1.6e9 + np.array([0.25, 0.5, 0.0])
    head = header("binary", "x y z timestamp", "4 4 4 8", "F F F F", points=3)
    np.testing.assert_allclose(decode_pcd(head + table.tobytes(), "a").t, [0.25, 0.5, 0.0], atol=1e-6)


def test_points_that_are_not_numbers_stay(tmp_path):
    (tmp_path / "a.pcd").write_bytes(header("ascii") + b"nan nan nan\n1 2 inf\n")
    (frame,) = read(tmp_path / "a.pcd")
    np.testing.assert_array_equal(frame.points[:, :3], np.array([[np.nan] * 3, [1, 2, np.inf]], np.float32))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "not a PCD file"),
        (b"ply\n", "not a PCD file"),
        (header("zip"), "known are ascii, binary and binary_compressed"),
        (header("binary", fields="x y intensity") + bytes(24), "no field z"),
        (header("binary", size="4 4 3") + bytes(24), "no such type"),
        (header("binary", size="4 4") + bytes(24), "3, 2, 3 and 3 entries"),
        (header("binary", points=-1), "whole numbers"),
        (header("binary", points=10**9) + bytes(24), "truncated"),
        (header("ascii", points=3) + b"1 2 3\n4 5 6\n", "2 lines follow"),
        (header("ascii") + b"1 2 3\n4 5\n", "cannot be read as text"),
        (header("ascii") + b"1 2\n4 5\n", "2 numbers"),
        (header("ascii", kinds="F F U") + b"1 2 -3\n4 5 6\n", "does not fit"),
        (header("binary_compressed") + b"abc", "truncated"),
        (header("binary_compressed") + struct.pack("<II", 5, 24) + b"abc", "truncated"),
        (header("binary_compressed") + struct.pack("<II", 3, 25) + b"abc", "says 25"),
        (header("binary_compressed") + struct.pack("<II", 3, 24) + b"\xff\xff\xff", "damaged"),
    ],
)
def test_a_bad_file_says_where_and_what(data, message):
    with pytest.raises(SourceError, match=message) as error:
        decode_pcd(data, "folder/a.pcd")
    assert "folder/a.pcd" in str(error.value)


@given(st.data())
@settings(max_examples=250, deadline=None)
def test_damage_anywhere_is_a_source_error_or_a_scan(data):
    raw = np.arange(12, dtype="<f4").tobytes()
    packed = lzf_compress(raw)
    whole = data.draw(
        st.sampled_from(
            [
                header("ascii", points=4) + b"1 2 3\n4 5 6\n7 8 9\nnan 1e9 -2\n",
                header("binary", points=4) + raw,
                header("binary_compressed", points=4) + struct.pack("<II", len(packed), len(raw)) + packed,
            ]
        )
    )
    damaged = bytearray(whole[: data.draw(st.integers(0, len(whole)))])
    for _ in range(data.draw(st.integers(0, 3))):
        if damaged:
            damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    try:
        scan = decode_pcd(bytes(damaged), "a.pcd")
    except SourceError:
        return
    assert scan.points.shape[1] == 4


@pytest.mark.real
def test_a_packet_driver_s_pcd_has_ring_intensity_and_time(shared_data):
    (frame,) = read(shared_data / "packets" / "velodyne_vlp16" / "1673400472138016708.pcd")
    assert frame.version == 1673400472138016708
    assert len(frame.points) == 14831
    assert frame.ring.max() < 16
    assert 0 < frame.points[:, 3].max() <= 1
    assert frame.t.min() >= 0
    ranges = np.linalg.norm(frame.points[:, :3], axis=1)
    elevation = np.degrees(np.arcsin(frame.points[:, 2] / ranges))
    # A VLP-16 looks from −15° to 15°; the reference carries the driver's own corrections.
    assert -15.5 < elevation.min() < elevation.max() < 15.5
