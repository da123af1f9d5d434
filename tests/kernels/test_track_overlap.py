"""The overlap that tracking takes, against the one of whole tables."""

import numpy as np
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels.track_overlap import Vec7, giou
from warploom.models.geometry import box_overlap


@wp.kernel
def _overlaps(a: wp.array(dtype=Vec7), b: wp.array(dtype=Vec7), out: wp.array(dtype=wp.float64)):
    i = wp.tid()
    out[i] = giou(a[i], b[i])


def overlaps(a, b):
    out = wp.zeros(len(a), dtype=wp.float64, device="cpu")
    given = [wp.array(np.ascontiguousarray(boxes), dtype=Vec7, device="cpu") for boxes in (a, b)]
    wp.launch(_overlaps, len(a), inputs=given, outputs=[out], device="cpu")
    return out.numpy()


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 10_000), st.floats(0.0, 20.0), st.floats(-1e4, 1e4))
def test_as_the_overlap_of_tables(seed, apart, far):
    rng = np.random.default_rng(seed)
    a, b = (
        np.c_[rng.normal(far, apart + 0.1, (40, 3)), rng.uniform(0.2, 12, (40, 3)), rng.uniform(-9, 9, (40, 1))]
        for _ in range(2)
    )
    b[:, :3] = a[:, :3] + rng.normal(0, apart, (40, 3))
    # 1e-9: as float64 has it ten kilometres from the origin
    np.testing.assert_allclose(overlaps(a, b), box_overlap(a, b)[2], atol=1e-9)


def test_equal_boxes_and_boxes_at_right_angles():
    a = np.array([[1, 2, 3, 4, 2, 1, 0.3]] * 3)
    b = a.copy()
    b[1, 6] += np.pi / 2
    b[2, 2] += 1.0
    # A cross of two 4 × 2: 4 of 12 shared, 16 enclose; stacked: none shared, nothing more enclosed.
    np.testing.assert_allclose(overlaps(a, b), [1.0, 4 / 12 - 4 / 16, 0.0], atol=1e-12)
