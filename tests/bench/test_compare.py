"""Two runs that were made by hand, beside one another."""

import pytest

from warploom.bench.compare import compare_figures, compare_pairs, compare_times


def by_name(changes):
    return {(change.result.on, change.result.who): change for change in changes}


def test_the_machines_share_is_that_of_the_peers_on_the_same_input(run_of, entry):
    old = run_of(entry("warploom", 0.010), entry("scipy", 0.1), entry("open3d", 0.2), entry("spconv", 0.1, on="x"))
    new = run_of(entry("warploom", 0.024), entry("scipy", 0.2), entry("open3d", 0.4), entry("spconv", 0.1, on="x"))
    (change,) = compare_times(old, new)
    assert (change.ratio, change.machine, change.own) == pytest.approx((2.4, 2.0, 1.2))
    assert not change.is_slower
    new["benchmarks"][0]["stats"]["median"] = 0.0241
    assert compare_times(old, new)[0].is_slower


def test_without_a_peer_beside_it_the_others_peers_say_what_the_machine_did(run_of, entry):
    old = run_of(entry("warploom", 0.01), entry("scipy", 0.1), entry("warploom", 0.01, on="alone"))
    new = run_of(entry("warploom", 0.01), entry("scipy", 0.3), entry("warploom", 0.03, on="alone"))
    changes = by_name(compare_times(old, new))
    assert changes["alone", "warploom"].own == pytest.approx(1.0)
    assert changes["KITTI", "warploom"].own == pytest.approx(1 / 3)


def test_without_any_peer_times_are_taken_as_they_are(run_of, entry):
    (change,) = compare_times(run_of(entry("warploom", 0.01)), run_of(entry("warploom", 0.013)))
    assert change.machine == 1.0
    assert change.is_slower


def test_taichi_is_ours_and_says_nothing_of_the_machine(run_of, entry):
    old = run_of(entry("warploom", 0.01), entry("warploom on Taichi", 0.01))
    new = run_of(entry("warploom", 0.01), entry("warploom on Taichi", 0.02))
    changes = by_name(compare_times(old, new))
    assert changes["KITTI", "warploom on Taichi"].is_slower
    assert changes["KITTI", "warploom"].machine == 1.0


def test_only_what_both_runs_have_is_compared_device_by_device(run_of, entry):
    old = run_of(entry("warploom", 0.01), entry("warploom plan", 0.01), entry("warploom", 0.001, device="cuda:0"))
    new = run_of(entry("warploom", 0.01), entry("warploom", 0.002, device="cuda:0"), entry("warploom", 1.0, on="new"))
    assert [(c.result.device, c.ratio) for c in compare_times(old, new)] == [("cpu", 1.0), ("cuda:0", 2.0)]


def test_ratios_to_the_peers_are_paired(run_of, entry):
    old = run_of(entry("warploom", 0.01), entry("scipy", 0.1), entry("gone", 0.1))
    new = run_of(entry("warploom", 0.01), entry("scipy", 0.2), entry("new", 0.1))
    (change,) = compare_pairs(old, new)
    assert change.pair.peer.who == "scipy"
    assert (change.old_ratio, change.ratio) == pytest.approx((0.1, 0.05))


def test_figures_are_compared_and_only_times_share_the_machines_drift(run_of, entry):
    def with_figures(frame, memory, growth):
        figures = [(frame, "ms", "frame"), (memory, "MiB", "memory"), (growth, "MiB", "growth")]
        figures = [{"name": n, "value": v, "unit": u, "goal": None, "note": ""} for v, u, n in figures]
        return {"stats": {}, "extra_info": {"figures": figures}}

    old = run_of(entry("warploom", 0.1), entry("scipy", 0.1), with_figures(40.0, 500.0, 0.0))
    new = run_of(entry("warploom", 0.1), entry("scipy", 0.2), with_figures(100.0, 1000.0, 0.0))
    frame, memory, growth = compare_figures(old, new)
    assert (frame.machine, frame.own, frame.is_slower) == pytest.approx((2.0, 1.25, True))
    assert (memory.machine, memory.own, memory.is_slower) == (1.0, 2.0, False)
    assert growth.own == 1.0
