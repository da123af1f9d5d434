"""Clouds to torch, Open3D and PCD files, and back: what is shared is shared, and every value is the same."""

import os
import sys

import numpy as np
import pytest

from warploom.components.conversions import from_open3d, from_torch, read_pcd, to_open3d, to_torch, write_pcd
from warploom.datamesh import freeze
from warploom.datamesh.messages.sensor import PointCloud
from warploom.datamesh.messages.std import Header
from warploom.errors import SinkError, SourceError

LAYOUT = [
    ("x", "f4"),
    ("y", "f4"),
    ("z", "f4"),
    ("intensity", "f4"),
    ("ring", "u2"),
    ("line", "u2"),
    ("pair", "i4", (2,)),
]
HEADER = Header(frame_id="lidar")


def points(n=100, seed=0, layout=LAYOUT):
    rng = np.random.default_rng(seed)
    made = np.zeros(n, layout)
    for name in made.dtype.names:
        made[name] = rng.integers(0, 100, made[name].shape) / (8 if made[name].dtype.kind == "f" else 1)
    return made


@pytest.fixture
def torch():
    return pytest.importorskip("torch", exc_type=ImportError)


@pytest.fixture
def o3d():
    return pytest.importorskip("open3d", exc_type=ImportError)


def test_fields_of_a_type_become_one_tensor_that_shares_the_memory(torch):
    made = points()
    cloud = PointCloud.from_array(made, HEADER)
    tensor = to_torch(cloud, "x", "y", "z")
    assert (tensor.shape, tensor.dtype) == ((100, 3), torch.float32)
    assert tensor.data_ptr() == made.ctypes.data
    made["y"][7] = -5
    assert tensor[7, 1] == -5


def test_fields_that_do_not_lie_evenly_are_copied_in_the_order_named(torch):
    made = points()
    tensor = to_torch(PointCloud.from_array(made), "z", "x", "intensity")
    np.testing.assert_array_equal(tensor.numpy(), np.stack([made[n] for n in ("z", "x", "intensity")], axis=1))


def test_every_field_becomes_a_tensor_also_of_a_committed_cloud(torch):
    made = points()
    cloud = PointCloud.from_array(made)
    freeze(cloud)
    tensors = to_torch(cloud)
    assert list(tensors) == list(made.dtype.names)
    assert tensors["pair"].shape == (100, 2)
    assert tensors["ring"].data_ptr() == made["ring"].ctypes.data
    for name, tensor in tensors.items():
        np.testing.assert_array_equal(tensor.numpy(), made[name])


@pytest.mark.parametrize(
    "layout",
    [
        [("x", ">f4"), ("y", ">f4"), ("z", ">f4")],  # torch has the machine's byte order alone
        {"names": ["x", "y", "z"], "formats": ["f4"] * 3, "offsets": [0, 4, 8], "itemsize": 13},  # as some drivers send
    ],
)
def test_layouts_that_torch_does_not_have_are_copied(layout, torch):
    made = points(layout=np.dtype(layout))
    cloud = PointCloud.from_array(made)
    np.testing.assert_array_equal(to_torch(cloud, "x", "y", "z").numpy(), cloud.to_xyz())
    np.testing.assert_array_equal(to_torch(cloud)["z"].numpy(), made["z"])


def test_a_tensor_becomes_a_cloud_that_shares_the_memory(torch):
    tensor = torch.arange(20.0).reshape(5, 4)
    cloud = from_torch(tensor, HEADER)
    assert cloud.header.frame_id == "lidar"
    assert [one.name for one in cloud.fields] == ["x", "y", "z", "intensity"]
    tensor[2, 1] = 77
    assert cloud.to_array()["y"][2] == 77
    again = to_torch(cloud, "x", "y", "z", "intensity")
    assert torch.equal(again, tensor)
    assert again.data_ptr() == tensor.data_ptr()


def test_a_tensor_with_a_gradient_and_one_that_is_not_contiguous(torch):
    tensor = torch.arange(12.0).reshape(3, 4).T.requires_grad_()
    np.testing.assert_array_equal(from_torch(tensor).to_xyz(), tensor.detach().numpy())


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (("x", "nowhere"), "no field 'nowhere'; it has: x, y"),
        (("x", "ring"), "of one type, not x: float32, ring: uint16"),
        (("pair", "pair"), "single values of one type"),
    ],
)
def test_fields_that_are_no_tensor_are_named(names, said, torch):
    with pytest.raises(ValueError, match=said):
        to_torch(PointCloud.from_array(points()), *names)


@pytest.mark.parametrize("n", [0, 100])
def test_open3d_takes_all_fields_and_gives_them_back(n, o3d):
    made = points(n)
    cloud = PointCloud.from_array(made, HEADER)
    there = to_open3d(cloud)
    np.testing.assert_array_equal(there.point.positions.numpy(), cloud.to_xyz())
    assert there.point["pair"].shape == (n, 2)
    back = from_open3d(there, HEADER).to_array()
    assert set(back.dtype.names) == set(made.dtype.names)
    for name in made.dtype.names:
        assert back[name].dtype == made[name].dtype
        np.testing.assert_array_equal(back[name], made[name])


def test_positions_are_shared_with_open3d_unless_they_are_read_only(o3d):
    made = np.zeros((10, 3), np.float32)
    cloud = PointCloud.from_array(made)
    there = to_open3d(cloud)
    made[3, 1] = 4.0
    assert there.point.positions[3, 1].item() == 4.0
    freeze(cloud)
    np.testing.assert_array_equal(to_open3d(cloud).point.positions.numpy(), made)


def test_a_library_that_is_not_there_is_named_with_how_to_get_it(monkeypatch):
    cloud = PointCloud.from_array(np.zeros((3, 3), np.float32), Header(), ("x", "y", "z"))
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(ImportError, match=r"needs torch.*pip install 'warploom\[torch\]'"):
        to_torch(cloud)
    with pytest.raises(ImportError, match=r"needs Open3D.*pip install open3d"):
        to_open3d(cloud)


def test_the_older_class_of_open3d(o3d):
    xyz = np.random.default_rng(5).normal(size=(20, 3)).astype(np.float32)
    older = to_open3d(PointCloud.from_array(xyz)).to_legacy()
    np.testing.assert_array_equal(from_open3d(older).to_xyz(), xyz)
    with pytest.raises(TypeError, match="expected a point cloud of Open3D, not list"):
        from_open3d([1, 2])


def test_a_cloud_without_x_has_no_positions(o3d):
    with pytest.raises(ValueError, match="no field 'x'"):
        to_open3d(PointCloud.from_array(points(layout=[("u", "f4")])))


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_a_file_gives_back_the_cloud(form, tmp_path):
    made = points()
    write_pcd(tmp_path / "a.pcd", PointCloud.from_array(made), form)
    back = read_pcd(tmp_path / "a.pcd", HEADER)
    assert back.header.frame_id == "lidar"
    assert back.to_array().dtype == made.dtype
    assert back.to_array().tobytes() == made.tobytes()
    assert os.listdir(tmp_path) == ["a.pcd"]


def test_rows_stay_rows(tmp_path):
    made = points(12).reshape(3, 4)
    write_pcd(tmp_path / "a.pcd", PointCloud.from_array(made))
    back = read_pcd(tmp_path / "a.pcd")
    assert (back.height, back.width) == (3, 4)
    np.testing.assert_array_equal(back.to_array()["x"], made["x"])


def test_what_cannot_be_read_or_written_is_told(tmp_path):
    cloud = PointCloud.from_array(points(3))
    with pytest.raises(SourceError, match=r"none\.pcd: No such file"):
        read_pcd(tmp_path / "none.pcd")
    (tmp_path / "text.pcd").write_text("x y z\n")
    with pytest.raises(SourceError, match=r"text\.pcd: not a PCD file"):
        read_pcd(tmp_path / "text.pcd")
    with pytest.raises(SinkError, match=r"a\.pcd: cannot be written: No such file"):
        write_pcd(tmp_path / "nowhere" / "a.pcd", cloud)
    with pytest.raises(ValueError, match="form must be"):
        write_pcd(tmp_path / "a.pcd", cloud, "gzip")
    assert not (tmp_path / "a.pcd").exists()


def test_real_scans_with_integers_of_64_bits_are_refused_by_name(tmp_path):
    text = "VERSION 0.7\nFIELDS x stamp\nSIZE 4 8\nTYPE F U\nCOUNT 1 1\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n1 2\n"
    (tmp_path / "a.pcd").write_text(text)
    with pytest.raises(SourceError, match="field 'stamp' has integers of 64 bits"):
        read_pcd(tmp_path / "a.pcd")
