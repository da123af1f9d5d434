"""Choosing points by what earlier stages found: by height above the ground, and by boxes."""

from __future__ import annotations

import numpy as np
import warp as wp

from .device import DEFAULT_DEVICE

__all__ = ["label_outside_boxes", "select_heights"]

_NONE = wp.constant(-1)
_UPLOADED = (wp.float32, wp.int32, wp.int32)


@wp.kernel
def _select_heights(
    # in
    ground_in: wp.array(dtype=wp.bool),
    height_in: wp.array(dtype=wp.float32),
    count_in: wp.array(dtype=wp.int32),
    lowest: float,
    highest: float,
    # out
    selected_out: wp.array(dtype=wp.bool),
):
    i = wp.tid()
    selected = bool(False)
    if i < count_in[0] and not ground_in[i]:
        selected = height_in[i] >= lowest and height_in[i] <= highest
    selected_out[i] = selected


def select_heights(
    ground: wp.array, height: wp.array, count: wp.array, bounds: tuple[float, float], selected: wp.array
) -> None:
    """Selects the points that stand on the ground, within a band of heights. Allocates nothing, reads nothing back.

    Args:
        ground: True where a point is ground, shape (n,), bool.
        height: Above the ground [m], shape (n,), float32; a point whose height is NaN is not selected.
        count: Number of points, shape (1,), int32, on the device.
        bounds: Lowest and highest height [m], both included.
        selected: Filled: shape (n,), bool.
    """
    device = selected.device
    wp.launch(_select_heights, selected.shape[0], [ground, height, count, *bounds], [selected], device=device)


@wp.kernel
def _label_outside_boxes(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    labels_in: wp.array(dtype=wp.int32),
    count_in: wp.array(dtype=wp.int32),
    boxes_in: wp.array2d(dtype=wp.float32),
    start_in: wp.array(dtype=wp.int32),
    box_in: wp.array(dtype=wp.int32),
    margin: float,
    # out
    labels_out: wp.array(dtype=wp.int32),
):
    i = wp.tid()
    label = int(_NONE)
    if i < count_in[0]:
        label = labels_in[i]
    if label >= 0 and label + 1 < start_in.shape[0]:
        point = xyz_in[i]
        first = start_in[label]
        last = start_in[label + 1]
        for j in range(first, last):
            k = box_in[j]
            x = point[0] - boxes_in[k, 0]
            y = point[1] - boxes_in[k, 1]
            half_length = 0.5 * boxes_in[k, 3] + margin
            half_width = 0.5 * boxes_in[k, 4] + margin
            if x * x + y * y <= half_length * half_length + half_width * half_width:
                cosine = wp.cos(boxes_in[k, 6])
                sine = wp.sin(boxes_in[k, 6])
                inside = wp.abs(x * cosine + y * sine) <= half_length and wp.abs(y * cosine - x * sine) <= half_width
                if inside and wp.abs(point[2] - boxes_in[k, 2]) <= 0.5 * boxes_in[k, 5] + margin:
                    label = int(_NONE)
    labels_out[i] = label


def label_outside_boxes(
    xyz: wp.array,
    labels: wp.array,
    count: wp.array,
    boxes: np.ndarray,
    cluster_boxes: np.ndarray,
    margin: float,
    outside: wp.array,
) -> None:
    """Takes the points inside boxes out of their clusters.

    A point is tried against those boxes alone that the box of its cluster comes near.

    Args:
        xyz: Positions [m], shape (n,), vec3.
        labels: Of the clusters, shape (n,), int32.
        count: Number of points, shape (1,), int32, on the device.
        boxes: x y z l w h [m], yaw [rad], shape (k, 7), float32.
        cluster_boxes: Likewise, by label, each around its cluster; points of labels without one keep their label.
        margin: By how much each box is grown on every side [m].
        outside: Filled with the labels, −1 for points in a box, shape (n,), int32.
    """
    device = outside.device
    reach = [_extent(b) for b in (cluster_boxes, boxes)]
    with np.errstate(invalid="ignore"):  # a label without points has no box: NaN is near nothing
        apart = np.abs(cluster_boxes[:, None, :2] - boxes[None, :, :2])
        near = (apart <= reach[0][:, None] + reach[1][None] + 2.0 * margin + 0.1).all(axis=2)
    start = np.concatenate([[0], near.sum(axis=1).cumsum()])

    hosts = (
        np.ascontiguousarray(boxes, np.float32).reshape(-1, 7),
        start.astype(np.int32),
        np.nonzero(near)[1].astype(np.int32),
    )
    is_host = str(device) == DEFAULT_DEVICE
    uploads = [wp.array(h, dtype=t, device=device, copy=not is_host) for h, t in zip(hosts, _UPLOADED, strict=True)]
    inputs = [xyz, labels, count, *uploads, margin]
    wp.launch(_label_outside_boxes, outside.shape[0], inputs, [outside], device=device)


def _extent(boxes: np.ndarray) -> np.ndarray:
    """How far each box reaches along x and y from its centre, shape (k, 2)."""
    c, s = np.abs(np.cos(boxes[:, 6])), np.abs(np.sin(boxes[:, 6]))
    length, width = boxes[:, 3] / 2, boxes[:, 4] / 2
    return np.stack([c * length + s * width, s * length + c * width], axis=1)
