import contextlib
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.components.sources import read, read_scan
from warploom.components.sources.scan_files import natural_key, read_times, scan_files, versions_for
from warploom.errors import SourceError
from warploom.models.geometry import points_in_boxes


def cloud(n=50, seed=0):
    return np.random.default_rng(seed).normal(size=(n, 4)).astype(np.float32)


def test_a_bin_comes_back_bit_for_bit(tmp_path):
    points = cloud()
    points[3, 0], points[4, 2] = np.nan, np.inf
    points.tofile(tmp_path / "a.bin")
    np.testing.assert_array_equal(read_scan(tmp_path / "a.bin").points, points)


@pytest.mark.parametrize("name", ["a.bin", "a.npy", "a.pcd"])
def test_an_empty_scan_is_an_empty_frame(tmp_path, name):
    if name.endswith("npy"):
        np.save(tmp_path / name, np.empty((0, 4), np.float32))
    elif name.endswith("pcd"):
        (tmp_path / name).write_text("FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 0\nHEIGHT 1\nPOINTS 0\nDATA ascii\n")
    else:
        (tmp_path / name).touch()
    (frame,) = read(tmp_path / name)
    assert frame.points.shape == (0, 4)
    assert frame.points.dtype == np.float32


@given(st.integers(0, 16 * 7))
@settings(max_examples=40, deadline=None)
def test_a_truncated_bin_is_refused_unless_whole_points_are_left(tmp_path_factory, length):
    path = tmp_path_factory.mktemp("truncated") / "a.bin"
    points = cloud(7)
    path.write_bytes(points.tobytes()[:length])
    if length % 16:
        with pytest.raises(SourceError, match=r"a\.bin.*truncated.*bytes"):
            read_scan(path)
    else:
        np.testing.assert_array_equal(read_scan(path).points, points[: length // 16])


@pytest.mark.parametrize("dtype", [np.float32, np.float64, ">f4", np.float16])
@pytest.mark.parametrize("columns", [3, 4])
def test_an_npy_of_any_float_type_is_read(tmp_path, dtype, columns):
    points = cloud()[:, :columns].astype(dtype)
    np.save(tmp_path / "a.npy", points)
    scan = read_scan(tmp_path / "a.npy")
    np.testing.assert_array_equal(scan.points[:, :columns], points.astype(np.float32))
    assert (scan.points[:, columns:] == 0).all()


@pytest.mark.parametrize(
    "array",
    [
        np.zeros(4, np.float32),
        np.zeros((5, 2), np.float32),
        np.zeros((5, 4), int),
        np.zeros((2, 5, 4)),
        np.zeros((3, 4), "U1"),
    ],
)
def test_an_npy_of_another_shape_or_type_says_what_is_expected(tmp_path, array):
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(SourceError, match=r"shape \(.*expected a float array of shape \(n, 3\) or \(n, 4\)") as error:
        read_scan(tmp_path / "a.npy")
    assert str(array.shape) in str(error.value)


def test_a_pickled_npy_is_never_loaded(tmp_path):
    np.save(tmp_path / "a.npy", np.array([{"a": 1}], object), allow_pickle=True)
    with pytest.raises(SourceError, match="allow_pickle"):
        read_scan(tmp_path / "a.npy")


def test_an_npy_that_lies_about_its_size_is_refused(tmp_path):
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (99999999999999, 4), }"
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    with pytest.raises(SourceError, match="truncated"):
        read_scan(tmp_path / "a.npy")


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_a_damaged_npy_is_a_source_error_or_a_scan(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("damaged")
    np.save(folder / "a.npy", cloud(20))
    raw = bytearray((folder / "a.npy").read_bytes()[: data.draw(st.integers(0, 448))])
    for _ in range(data.draw(st.integers(0, 3))):
        if raw:
            raw[data.draw(st.integers(0, min(len(raw), 130) - 1))] = data.draw(st.integers(0, 255))
    (folder / "a.npy").write_bytes(raw)
    with contextlib.suppress(SourceError):
        assert read_scan(folder / "a.npy").points.shape[1] == 4


def test_nuscenes_axes_are_turned_to_x_forward_y_left(tmp_path):
    rows = np.array([[1, 20, 3, 255, 31], [-4, 5, 6, 0, 0]], np.float32)  # x right, y forward
    rows.tofile(tmp_path / "a.pcd.bin")
    scan = read_scan(tmp_path / "a.pcd.bin")
    np.testing.assert_array_equal(scan.points, [[20, -1, 3, 1], [5, 4, 6, 0]])
    np.testing.assert_array_equal(scan.ring, np.array([31, 0], np.uint16))
    (tmp_path / "b.pcd.bin").write_bytes(rows.tobytes()[:-4])
    with pytest.raises(SourceError, match="truncated"):
        read_scan(tmp_path / "b.pcd.bin")


def test_a_folder_is_read_in_natural_order_and_the_index_gives_the_version(tmp_path):
    for number in (10, 2, 1, 100):
        np.full((1, 4), number, np.float32).tofile(tmp_path / f"s{number}.bin")
    (tmp_path / "notes.txt").touch()
    frames = list(read(tmp_path))
    assert [frame.points[0, 0] for frame in frames] == [1, 2, 10, 100]
    assert [frame.version for frame in frames] == [0, 100_000_000, 200_000_000, 300_000_000]
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    assert len(read(tmp_path)) == 4


def test_a_bad_scan_in_a_folder_is_skipped_and_told_and_its_neighbours_are_kept(tmp_path):
    for number in range(5):
        cloud().tofile(tmp_path / f"{number}.bin")
    (tmp_path / "2.bin").write_bytes(b"1234567")
    source = read(tmp_path)
    assert [frame.index for frame in source] == [0, 1, 3, 4]
    (skipped,) = source.skipped
    assert (skipped.index, skipped.path) == (2, str(tmp_path / "2.bin"))
    assert "truncated" in skipped.reason
    assert [frame.version for frame in source] == [0, 100_000_000, 300_000_000, 400_000_000]
    assert len(source.skipped) == 1  # counted anew each time


def test_a_folder_without_one_good_scan_is_an_error(tmp_path):
    for number in range(2):
        (tmp_path / f"{number}.bin").write_bytes(b"123")
    with pytest.raises(SourceError, match="none of its 2 scans"):
        list(read(tmp_path))


def test_a_single_bad_scan_is_an_error(tmp_path):
    (tmp_path / "a.bin").write_bytes(b"123")
    with pytest.raises(SourceError, match=r"a\.bin"):
        list(read(tmp_path / "a.bin"))


def test_next_goes_on_and_a_loop_starts_again(tmp_path):
    for number in range(3):
        cloud().tofile(tmp_path / f"{number}.bin")
    source = read(tmp_path)
    assert [next(source).index, next(source).index] == [0, 1]
    assert [frame.index for frame in itertools.islice(source, 2)] == [0, 1]
    assert next(source).index == 2
    with pytest.raises(StopIteration):
        next(source)


def test_missing_empty_and_unknown_paths_are_told(tmp_path):
    (tmp_path / "a.xyz").touch()
    (tmp_path / "empty").mkdir()
    for path, message in (
        (tmp_path / "b.bin", "no such file"),
        (tmp_path / "a.xyz", r"known endings: .*\.pcd"),
        (tmp_path / "empty", "no scans in this folder"),
    ):
        with pytest.raises(SourceError, match=message):
            read(path)


def test_times_are_seconds_or_dates(tmp_path):
    path = tmp_path / "times.txt"
    path.write_text("0.000000e+00\n1.037359e-01\n\n2011-09-26 13:02:25.594360375\n")
    date = np.datetime64("2011-09-26T13:02:25.594360375").astype(int)
    assert read_times(path) == [0, 103735900, date]
    path.write_text("0.0\nnever\n")
    with pytest.raises(SourceError, match=r"times.txt, line 2: 'never'"):
        read_times(path)
    for bad in ("inf", "nan", "-1.0", "1e300", "2011-99-99 00:00:00", "1800-01-01 00:00:00", "1500-01-01 00:00:00"):
        path.write_text(f"{bad}\n")
        with pytest.raises(SourceError, match="line 1"):
            read_times(path)


def test_versions_come_from_the_time_file_else_the_names(tmp_path):
    for number in (3, 5):
        cloud().tofile(tmp_path / f"{number:06}.bin")
    paths = scan_files(tmp_path)
    times = tmp_path / "times.txt"
    times.write_text("\n".join(f"{k}.5" for k in range(8)))
    assert [frame.version for frame in read(tmp_path)] == [3_500_000_000, 5_500_000_000]  # by the number
    times.write_text("7.0\n8.0\n")
    assert versions_for(paths, times) == [7_000_000_000, 8_000_000_000]  # a line a scan
    times.write_text("7.0\n8.0\n9.0\n")
    with pytest.raises(SourceError, match="3 lines for 2 scans"):
        versions_for(paths, times)
    stamped = [tmp_path / "1585897255376374245.pcd", tmp_path / "1585897255476374245.pcd"]
    assert versions_for(stamped, None) == [1585897255376374245, 1585897255476374245]
    assert versions_for([tmp_path / "n015__LIDAR_TOP__1532402927647951.pcd.bin"], None) == [1532402927647951000]


def test_natural_order_puts_2_before_10(tmp_path):
    names = ["10.bin", "2.bin", "a10b2.bin", "a10b10.bin", "a9.bin"]
    assert [p.name for p in sorted((tmp_path / n for n in names), key=natural_key)] == [
        "2.bin",
        "10.bin",
        "a9.bin",
        "a10b2.bin",
        "a10b10.bin",
    ]


@pytest.mark.real
def test_boxes_of_nuscenes_hold_their_points_in_our_axes(shared_data):
    import json

    folder = shared_data / "nuscenes_sample"
    (frame,) = read(folder)
    assert frame.version == 1532402927647951000
    instances = json.loads((folder / "info.json").read_text())["data_list"][0]["instances"]
    boxes = np.array([instance["bbox_3d"] for instance in instances])
    counts = np.array([instance["num_lidar_pts"] for instance in instances])
    turned = boxes.copy()  # the same turn by hand: x right, y forward → x forward, y left
    turned[:, 0], turned[:, 1], turned[:, 6] = boxes[:, 1], -boxes[:, 0], boxes[:, 6] - np.pi / 2
    found = points_in_boxes(frame.points, turned).sum(axis=1)
    # The set counts with boxes of its own global frame: nearly, not exactly, the same points.
    seen = counts >= 5
    assert seen.sum() > 20
    assert (found[seen] >= 0.7 * counts[seen]).all()
    assert points_in_boxes(frame.points, boxes).sum() < 0.6 * found.sum()  # without the turn they miss
