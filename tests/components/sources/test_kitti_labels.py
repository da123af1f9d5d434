import numpy as np
import pytest

from warploom.components.sources.kitti_labels import KITTI_CLASSES, read_labels, read_point_labels
from warploom.errors import SourceError
from warploom.models.classes import CLASSES

ROW = "0.00 0 1.0 0 0 50 50 1.5 1.6 4.0 3.0 1.5 10.0 0.1"


def test_every_type_of_kitti_has_a_class(tmp_path):
    path = tmp_path / "000000.txt"
    path.write_text("\n".join(f"{kind} {ROW}" for kind in (*KITTI_CLASSES, "DontCare")))
    labels = read_labels(path, tracking=False)[0]
    assert len(labels.classes) == len(KITTI_CLASSES)
    names = dict(zip(KITTI_CLASSES, (CLASSES[index] for index in labels.classes), strict=True))
    assert names["Van"] == "vehicle"
    assert names["Person_sitting"] == "pedestrian"
    assert names["Misc"] == "unknown"
    np.testing.assert_array_equal(labels.camera_boxes[0], [1.5, 1.6, 4.0, 3.0, 1.5, 10.0, 0.1])


def test_a_frame_of_regions_only_is_a_frame_without_objects(tmp_path):
    path = tmp_path / "0000.txt"
    path.write_text(f"40 -1 DontCare {ROW}\n41 3 Car {ROW} 0.9\n\n")
    labels = read_labels(path, tracking=True)
    assert sorted(labels) == [40, 41]
    assert len(labels[40].ids) == 0
    assert labels[41].ids.tolist() == [3]


def test_a_line_that_is_no_label_is_told_by_its_number(tmp_path):
    path = tmp_path / "0000.txt"
    for bad in ("Car 1 2", "Tank " + ROW, "Car " + ROW.replace("4.0", "nan"), "0 1 Car " + ROW):
        path.write_text(f"Car {ROW}\n{bad}\n")
        with pytest.raises(SourceError, match=r"0000\.txt, line 2: not a KITTI label"):
            read_labels(path, tracking=False)
    with pytest.raises(SourceError, match="cannot read the labels"):
        read_labels(tmp_path / "none.txt", tracking=True)


def test_point_labels_must_be_one_a_point(tmp_path):
    path = tmp_path / "a.label"
    np.array([40, 10 | 5 << 16, 70], "<u4").tofile(path)
    truth = read_point_labels(path, 3)
    assert truth.ground.tolist() == [True, False, False]
    assert truth.ground_scored.tolist() == [True, True, False]
    assert len(truth.boxes) == 0
    with pytest.raises(SourceError, match="12 bytes, expected 4 for each of the 4 points"):
        read_point_labels(path, 4)
