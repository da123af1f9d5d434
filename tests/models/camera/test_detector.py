"""Detectors in images against decoding as their authors write it, as loops, on what ONNX Runtime gives."""

import re

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from warploom.errors import ModelError
from warploom.models.camera.coco import COCO_CLASSES
from warploom.models.camera.detector import ImageDetector
from warploom.models.importers.image_detectors import import_fastestdet, import_yolox

cv2 = pytest.importorskip("cv2")


def constant_model(path, shape, values, source="images", size=32):
    """A network that says the same of every image: the decoding is what is tested."""
    graph = helper.make_graph(
        [helper.make_node("ReduceSum", ["x", "axes"], ["sum"], keepdims=0),
         helper.make_node("Mul", ["sum", "zero"], ["nothing"]),
         helper.make_node("Add", ["values", "nothing"], ["out"])],
        "g",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, size, size])],
        [helper.make_tensor_value_info("out", TensorProto.FLOAT, list(shape))],
        [numpy_helper.from_array(values.astype(np.float32).reshape(shape), "values"),
         numpy_helper.from_array(np.zeros(1, np.float32), "zero"),
         numpy_helper.from_array(np.arange(4, dtype=np.int64), "axes")],
    )  # fmt: skip
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), str(path))


def overlap(a, b):
    low, high = np.maximum(a[:2], b[:2]), np.minimum(a[2:], b[2:])
    common = np.prod(np.clip(high - low, 0, None))
    return common / (np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - common)


def suppressed(found, iou):
    kept = []
    for each in sorted(found, key=lambda one: -one[1]):
        if all(overlap(each[0], other[0]) <= iou for other in kept):
            kept.append(each)
    return kept


def yolox_loops(raw, size, least):
    """demo_postprocess and the scores of YOLOX's ONNX demo."""
    found, row = [], 0
    for stride in (8, 16, 32):
        for y in range(size[0] // stride):
            for x in range(size[1] // stride):
                cx, cy = (raw[row, 0] + x) * stride, (raw[row, 1] + y) * stride
                w, h = np.exp(raw[row, 2]) * stride, np.exp(raw[row, 3]) * stride
                scores = raw[row, 4] * raw[row, 5:]
                if scores.max() >= least:
                    box = np.array([cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2])
                    found.append((box, scores.max(), int(scores.argmax())))
                row += 1
    return found


def fastestdet_loops(raw, least):
    """FastestDet's ONNX demo, in shares of the image."""
    found = []
    for y in range(raw.shape[1]):
        for x in range(raw.shape[2]):
            data = raw[:, y, x].astype(float)
            score = data[0] ** 0.6 * data[5:].max() ** 0.4
            if score >= least:
                w, h = 1 / (1 + np.exp(-data[3])), 1 / (1 + np.exp(-data[4]))
                cx, cy = (x + np.tanh(data[1])) / raw.shape[2], (y + np.tanh(data[2])) / raw.shape[1]
                box = np.array([cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2])
                found.append((box, score, int(data[5:].argmax())))
    return found


def agree(found, expected, size, atol):
    """The same boxes, cut at the image's edges."""
    assert len(found) == len(expected) > 0
    for k, (box, score, label) in enumerate(expected):
        assert found.scores[k] == pytest.approx(score, abs=1e-5)
        assert found.labels[k] == label
        np.testing.assert_allclose(found.boxes[k], np.clip(box, 0, [size[1], size[0]] * 2), atol=atol)


def test_yolox_is_decoded_as_its_authors_do(tmp_path):
    rng = np.random.default_rng(0)
    raw = rng.normal(0, 0.7, (84, 8)).astype(np.float32)
    raw[:, 4:] = rng.random((84, 4))
    constant_model(tmp_path / "m.onnx", (1, 84, 8), raw, size=64)
    card = import_yolox(tmp_path / "m.onnx", tmp_path / "head", classes=("a", "b", "c"))
    found = ImageDetector(card, score_threshold=0.4).detect(np.zeros((90, 100, 3), np.uint8))
    ratio = 64 / 100  # the letterbox keeps the shape: what is wider than high is scaled by its width
    expected = [(box / ratio, score, label) for box, score, label in yolox_loops(raw, (64, 64), 0.4)]
    agree(found, suppressed(expected, 0.45), (90, 100), 1e-3)


def test_fastestdet_is_decoded_as_its_author_does(tmp_path):
    rng = np.random.default_rng(1)
    raw = rng.normal(0, 1.0, (8, 3, 3)).astype(np.float32)
    raw[0], raw[5:] = rng.random((3, 3)), rng.random((3, 3, 3))
    raw[3:5] -= 1.5
    constant_model(tmp_path / "m.onnx", (1, 8, 3, 3), raw, size=48)
    card = import_fastestdet(tmp_path / "m.onnx", tmp_path / "head", classes=("a", "b", "c"))
    found = ImageDetector(card, score_threshold=0.4).detect(np.zeros((90, 200, 3), np.uint8))
    scale = np.array([200, 90, 200, 90])
    expected = [(box * scale, score, label) for box, score, label in fastestdet_loops(raw, 0.4)]
    agree(found, suppressed(expected, 0.45), (90, 200), 1e-3)


@pytest.mark.real
def test_yolox_nano_on_a_real_image(shared_data, tmp_path):
    """The network's own answer for the letterboxed image, decoded by loops: boxes to 0.1 of 1242 pixels."""
    import onnxruntime as ort

    model = shared_data / "weights" / "yolox_nano" / "yolox_nano.onnx"
    image = cv2.imread(str(shared_data / "kitti_object" / "image_2" / "000008.png"))
    ratio = min(416 / image.shape[0], 416 / image.shape[1])
    padded = np.full((416, 416, 3), 114, np.uint8)
    small = cv2.resize(image, (int(image.shape[1] * ratio), int(image.shape[0] * ratio)))
    padded[: small.shape[0], : small.shape[1]] = small
    session = ort.InferenceSession(str(model), providers=["CPUExecutionProvider"])
    raw = session.run(None, {"images": padded.transpose(2, 0, 1)[None].astype(np.float32)})[0][0]
    expected = [(box / ratio, score, label) for box, score, label in yolox_loops(raw, (416, 416), 0.3)]
    found = ImageDetector(import_yolox(model, tmp_path)).detect(image)
    agree(found, suppressed(expected, 0.45), image.shape, 0.1)
    assert finds_cars(found, shared_data) >= 5


@pytest.mark.real
def test_fastestdet_on_a_real_image(shared_data, tmp_path):
    import onnxruntime as ort

    model = shared_data / "weights" / "fastestdet" / "FastestDet.onnx"
    image = cv2.imread(str(shared_data / "kitti_object" / "image_2" / "000008.png"))
    small = cv2.resize(image, (352, 352)).transpose(2, 0, 1)[None].astype(np.float32) / 255.0
    raw = ort.InferenceSession(str(model), providers=["CPUExecutionProvider"]).run(None, {"input.1": small})[0][0]
    scale = np.array([image.shape[1], image.shape[0]] * 2)
    expected = [(box * scale, score, label) for box, score, label in fastestdet_loops(raw, 0.5)]
    found = ImageDetector(import_fastestdet(model, tmp_path)).detect(image)
    agree(found, suppressed(expected, 0.45), image.shape, 0.1)
    assert finds_cars(found, shared_data) >= 4


def finds_cars(found, shared_data):
    """Labelled cars of the scan that a car's box overlaps by half."""
    rows = [line.split() for line in (shared_data / "kitti_object" / "label_2" / "000008.txt").read_text().splitlines()]
    cars = [np.array([float(v) for v in row[4:8]]) for row in rows if row[0] == "Car"]
    boxes = found.boxes[found.labels == COCO_CLASSES.index("car")]
    return sum(any(overlap(car, box) > 0.5 for box in boxes) for car in cars)


@pytest.fixture
def small_head(tmp_path):
    raw = np.zeros((84, 8))
    raw[:, 4:6] = 0.9
    constant_model(tmp_path / "m.onnx", (1, 84, 8), raw, size=64)
    return import_yolox(tmp_path / "m.onnx", tmp_path / "head", classes=("a", "b", "c"))


def test_an_import_that_fails_leaves_the_one_before_as_it_was(small_head, tmp_path):
    constant_model(tmp_path / "other.onnx", (1, 84, 9), np.zeros((84, 9)), size=64)
    with pytest.raises(ModelError, match="not a yolox of 3 classes"):
        import_yolox(tmp_path / "other.onnx", small_head.parent, classes=("a", "b", "c"))
    ImageDetector(small_head)


def test_what_is_no_image_is_refused(small_head):
    head = ImageDetector(small_head)
    for image in (np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3)), np.zeros((0, 4, 3), np.uint8)):
        with pytest.raises(ValueError, match="image must be uint8 of shape"):
            head.detect(image)
    assert len(head.detect(np.zeros((1, 1000, 3), np.uint8))) >= 0


def test_objects_beyond_the_cards_limit_are_told(small_head, caplog):
    small_head.write_text(re.sub(r"max_objects: \d+", "max_objects: 5", small_head.read_text()))
    head = ImageDetector(small_head)
    assert len(head.detect(np.zeros((64, 64, 3), np.uint8))) == 5
    there = head.overflow + 5
    assert f"beyond the card's limits: dropped {there - 5} of {there}, for read.max_objects is 5" in caplog.text


def test_a_card_of_other_classes_is_refused(small_head):
    text = small_head.read_text()
    small_head.write_text(text.replace("- c\n", ""))
    with pytest.raises(ModelError, match=r"output.shape \(1, 84, 8\) does not follow from input, strides and classes"):
        ImageDetector(small_head)
    small_head.write_text(re.sub(r"strides:\n *- 8", "strides:\\n  - 0", text))
    with pytest.raises(ModelError, match=r"read\.strides\.0: Input should be greater than or equal to 1"):
        ImageDetector(small_head)


@pytest.mark.parametrize("cut", [0, 50, 900])
def test_damaged_files_are_refused(cut, tmp_path):
    constant_model(tmp_path / "m.onnx", (1, 84, 8), np.zeros((84, 8)), size=64)
    bad = tmp_path / "bad.onnx"
    bad.write_bytes((tmp_path / "m.onnx").read_bytes()[:cut])
    with pytest.raises(ModelError, match=r"bad.onnx: (this is not an ONNX model|ONNX Runtime cannot load it)"):
        import_yolox(bad, tmp_path / "head")


def test_other_networks_are_refused(tmp_path):
    constant_model(tmp_path / "m.onnx", (1, 84, 8), np.zeros((84, 8)), size=64)
    with pytest.raises(ModelError, match="not a yolox of 80 classes"):
        import_yolox(tmp_path / "m.onnx", tmp_path / "head")
    assert not list((tmp_path / "head").iterdir())
    with pytest.raises(ModelError, match="not a fastestdet of 3 classes"):
        import_fastestdet(tmp_path / "m.onnx", tmp_path / "head", classes=("a", "b", "c"))
    with pytest.raises(ModelError, match="No such file"):
        import_yolox(tmp_path / "none.onnx", tmp_path)
