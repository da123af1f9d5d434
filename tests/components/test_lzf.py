"""LZF: Open3D packs and unpacks the same in the tests of PCD files."""

import contextlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.components.lzf import lzf_compress, lzf_decompress


@given(st.lists(st.sampled_from([b"abc", b"\0" * 40, b"x", bytes(range(256)), b"ab" * 300]), max_size=30).map(b"".join))
@settings(max_examples=60, deadline=None)
def test_lzf_unpacks_what_was_packed(data):
    assert lzf_decompress(lzf_compress(data), len(data)) == data


@given(st.binary(max_size=60), st.integers(0, 3000))
@settings(max_examples=200, deadline=None)
def test_damaged_lzf_is_refused_or_has_the_size_said(data, size):
    with contextlib.suppress(ValueError):
        assert len(lzf_decompress(data, size)) == size


def test_lzf_that_claims_gigabytes_is_refused_before_memory_is_taken():
    with pytest.raises(ValueError, match="cannot make"):
        lzf_decompress(b"\xff" * 100, 1 << 40)


@given(st.binary(max_size=300))
@settings(max_examples=100, deadline=None)
def test_anything_is_packed_and_unpacked_and_grows_by_a_byte_in_32_at_most(data):
    packed = lzf_compress(data)
    assert lzf_decompress(packed, len(data)) == data
    assert len(packed) <= len(data) + -(-len(data) // 32) + len(data) // 3


def test_what_repeats_becomes_small_also_where_it_is_farther_back_than_a_copy_reaches():
    zeros = lzf_compress(bytes(100_000))
    assert len(zeros) < 1300  # three bytes for 264
    noise = np.random.default_rng(3).integers(0, 256, 9000, np.uint8).tobytes()
    packed = lzf_compress(noise + noise)
    assert lzf_decompress(packed, 18000) == noise + noise
    assert len(packed) > 18000
    assert len(lzf_compress(noise[:8000] * 2)) < 8400
