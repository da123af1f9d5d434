"""The 3D FCN vehicle detector as a head: its boxes are those of its reference; other files are refused."""

import json

import numpy as np
import pytest
import torch

from warploom.errors import ModelError
from warploom.models.classes import VEHICLE
from warploom.models.importers.fcn3d import _Fcn3d, import_fcn3d
from warploom.models.occupancy_head import OccupancyHead, boxes_of_corners


def arrays(seed=0):
    rng = np.random.default_rng(seed)
    made = {"objectness.weights": (3, 3, 3, 64, 2), "cordinate.weights": (3, 3, 3, 64, 24)}
    for k, (size, inputs, outputs) in enumerate(((5, 1, 16), (5, 16, 32), (3, 32, 64), (3, 64, 64)), 1):
        made[f"layer{k}.weights"] = (size, size, size, inputs, outputs)
        made |= {f"layer{k}.{name}": (outputs,) for name in ("bias", "pop_mean", "pop_var", "gamma", "beta")}
    return {name: (rng.random(shape) * 0.1).astype(np.float32) for name, shape in made.items()}


@pytest.fixture
def one_thread():
    """Threads that spin for each other take long where the cores are busy."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def slow_layer(x, weights, stride):
    """TensorFlow's SAME convolution as loops over the kernel, x y z in, by NumPy."""
    out = []
    pads = []
    for size, kernel in zip(x.shape[:3], weights.shape[:3], strict=True):
        count = -(-size // stride)
        total = max((count - 1) * stride + kernel - size, 0)
        pads.append((total // 2, total - total // 2))
        out.append(count)
    padded = np.pad(x, [*pads, (0, 0)])
    result = np.zeros((*out, weights.shape[4]))
    for i, j, k in np.ndindex(weights.shape[:3]):
        part = padded[i : i + stride * (out[0] - 1) + 1 : stride, j : j + stride * (out[1] - 1) + 1 : stride,
                      k : k + stride * (out[2] - 1) + 1 : stride]  # fmt: skip
        result += part @ weights[i, j, k]
    return result


def test_the_network_is_that_of_its_graph(one_thread):
    """On a small grid, with random weights; relative 1e-4 in single precision."""
    a = arrays()
    occupied = (np.random.default_rng(1).random((16, 24, 10)) < 0.2).astype(np.float32)
    x = occupied[..., None].astype(float)
    for k, stride in enumerate((2, 2, 2, 1), 1):
        x = np.maximum(slow_layer(x, a[f"layer{k}.weights"], stride) + a[f"layer{k}.bias"], 0)
        x = (x - a[f"layer{k}.pop_mean"]) / np.sqrt(a[f"layer{k}.pop_var"] + 1e-5) * a[f"layer{k}.gamma"]
        x = x + a[f"layer{k}.beta"]
    logits = slow_layer(x, a["objectness.weights"], 1)
    scores = 1 / (1 + np.exp(logits[..., 1] - logits[..., 0]))
    corners = slow_layer(x, a["cordinate.weights"], 1)
    with torch.no_grad():
        found = _Fcn3d(a)(torch.from_numpy(occupied[None]))
    np.testing.assert_allclose(found[0][0].numpy(), scores, atol=1e-4)
    np.testing.assert_allclose(found[1].numpy(), corners.transpose(3, 0, 1, 2), rtol=1e-4, atol=1e-4)


def test_boxes_come_from_their_corners():
    signs = [(-1, -1, 0), (1, -1, 0), (-1, 1, 0), (-1, -1, 1), (-1, 1, 1), (1, 1, 0), (1, -1, 1), (1, 1, 1)]
    local = np.array(signs) * (2.0, 0.8, 1.5)
    c, s = np.cos(0.7), np.sin(0.7)
    corners = local @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + (10.0, -3.0, -1.6)
    np.testing.assert_allclose(boxes_of_corners(corners[None]), [[10, -3, -0.85, 4, 1.6, 1.5, 0.7]], atol=1e-12)


@pytest.mark.slow
@pytest.mark.real
def test_its_boxes_are_those_of_its_reference(shared_data, tmp_path, one_thread):
    """To 1 cm, 0.01 rad and 0.002 of the score: the reference is rounded to 1 mm, in single precision elsewhere."""
    head = OccupancyHead(import_fcn3d(shared_data / "weights" / "fcn3d_vehicle" / "fcn3d_vehicle.npz", tmp_path))
    for name in ("000001", "000008"):
        points = np.fromfile(shared_data / "kitti_object" / "velodyne" / f"{name}.bin", np.float32).reshape(-1, 4)
        found = head.detect_points(points, 1.73)
        reference = json.loads((shared_data / "kitti_object" / "ref_fcn3d" / f"{name}.json").read_text())
        expected = boxes_of_corners(np.array([each["corners_velo"] for each in reference]))
        assert len(found) == len(expected)
        assert set(found.classes.tolist()) == {VEHICLE}
        nearest = np.linalg.norm(found.boxes[:, None, :3] - expected[None, :, :3], axis=2).argmin(axis=1)
        assert sorted(nearest.tolist()) == list(range(len(expected)))
        np.testing.assert_allclose(found.boxes[:, :6], expected[nearest, :6], atol=0.01)
        turn = found.boxes[:, 6] - expected[nearest, 6]
        assert (np.abs((turn + np.pi) % (2 * np.pi) - np.pi) < 0.01).all()
        scores = np.array([each["score"] for each in reference])[nearest]
        np.testing.assert_allclose(found.scores, scores, atol=2e-3)
    again = head.detect_points(torch.from_numpy(points), 1.73)
    assert again.boxes.tobytes() == found.boxes.tobytes()
    for wrong, height, message in (
        (points, np.nan, "sensor_height must be a finite number of metres"),
        (points[:, :2], 1.73, r"points must have shape \(n, 3 or more\)"),
    ):
        with pytest.raises(ValueError, match=message):
            head.detect_points(wrong, height)


def test_other_and_damaged_files_are_refused(tmp_path):
    path = tmp_path / "weights.npz"
    whole = arrays()
    for change, message in (
        (lambda a: a.pop("layer2.bias"), "this is not the 3D FCN vehicle detector: it lacks layer2.bias"),
        (lambda a: a.update({"layer2.bias": np.zeros(3)}), r"layer2.bias has shape \(3,\)"),
        (lambda a: a.update({"layer2.bias": np.full(32, np.inf)}), "layer2.bias has numbers that are not finite"),
    ):
        changed = dict(whole)
        change(changed)
        np.savez(path, **changed)
        with pytest.raises(ModelError, match=message):
            import_fcn3d(path, tmp_path)
    np.savez(path, **{**whole, "layer2.bias": np.array([print], dtype=object)})
    with pytest.raises(ModelError, match="it is no archive of plain arrays"):
        import_fcn3d(path, tmp_path)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ModelError, match="it is no archive of plain arrays"):
        import_fcn3d(path, tmp_path)
    with pytest.raises(ModelError, match="no such checkpoint"):
        import_fcn3d(tmp_path / "none.npz", tmp_path)
