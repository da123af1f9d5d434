"""Plots of results that were made by hand, read back from the SVG."""

from xml.etree import ElementTree

import numpy as np
import pytest

from warploom.bench.plots import draw_cost, draw_ratios
from warploom.bench.results import read_pairs, read_results

SVG = "{http://www.w3.org/2000/svg}"
SIZES = {"street 10k": 10_000, "street 120k": 120_000, "street 500k": 480_000, "street 2M": 2_000_000}


@pytest.fixture
def growing(run_of, entry):
    """Ours grows in proportion, the peer with the square."""
    entries = []
    for on, size in SIZES.items():
        entries += [entry("warploom", size / 1e8, on=on, size=size), entry("warploom plan", 1.0, on=on, size=size)]
        entries.append(entry("a <peer>", (size / 1e6) ** 2, on=on, size=size))
    return read_results(run_of(*entries, entry("warploom", 1.0), entry("warploom", 2.0, on="street 10k", kernel="k2")))


def curves(drawing):
    root = ElementTree.fromstring(drawing)
    found = root.findall(f"{SVG}polyline")
    return [np.array([point.split(",") for point in line.get("points").split()], float) for line in found]


def test_equal_factors_are_equal_ways_on_both_axes(growing):
    ours, theirs = curves(draw_cost(growing))
    assert ours.shape == theirs.shape == (len(SIZES), 2)
    np.testing.assert_array_equal(ours[:, 0], theirs[:, 0])
    across = np.log10(list(SIZES.values()))
    for curve, power in ((ours, 1), (theirs, 2)):
        x_scale = np.diff(curve[:, 0]) / np.diff(across)
        np.testing.assert_allclose(x_scale, x_scale[0], rtol=0.01)  # coordinates have one digit after the point
        slope = -np.diff(curve[:, 1]) / np.diff(across)
        np.testing.assert_allclose(slope, slope[0], rtol=0.02)
        assert slope[0] / (-np.diff(ours[:, 1]) / np.diff(across))[0] == pytest.approx(power, rel=0.02)


def test_only_what_was_timed_on_three_sizes_is_drawn(growing, run_of, entry):
    text = draw_cost(growing)
    assert "k2" not in text
    assert "a &lt;peer&gt;" in text
    assert draw_cost(read_results(run_of(entry("warploom", 1.0)))) == ""


def test_bars_begin_at_the_goal_and_end_on_its_side(run_of, entry):
    run = run_of(
        entry("warploom", 0.001), entry("scipy", 0.1, goal=0.02),  # twice as good as the goal
        entry("warploom", 0.004, on="b"), entry("scipy", 0.1, on="b", goal=0.02),  # half as good
        entry("warploom", 9.0, on="c"), entry("scipy", 0.1, on="c", goal=0.02),  # beyond the scale
        entry("warploom", 9.0, on="d"), entry("open3d", 0.1, on="d"),  # no goal
    )  # fmt: skip
    drawing = draw_ratios(list(read_pairs(read_results(run))))
    bars = ElementTree.fromstring(drawing).findall(f"{SVG}rect")[1:]
    begin = np.array([float(bar.get("x")) for bar in bars])
    length = np.array([float(bar.get("width")) for bar in bars])
    assert len(bars) == 3
    goal = begin[1]
    np.testing.assert_allclose([begin[0] + length[0], begin[2]], goal, atol=0.11)
    np.testing.assert_allclose(length, length[0] * np.array([1, 1, 3]), atol=0.2)
    assert bars[0].get("fill") != bars[1].get("fill") == bars[2].get("fill")
    assert draw_ratios([]) == ""


def test_the_same_results_give_the_same_bytes(growing):
    assert draw_cost(growing) == draw_cost(list(growing))
