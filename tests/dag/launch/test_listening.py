"""What `echo` and `hz` show."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from warploom.dag.launch.listening import RateMeter, listen, plain_value
from warploom.errors import WarploomError


@dataclass
class Scan:
    frame_id: str
    points: np.ndarray
    parts: list = field(default_factory=list)


def test_values_are_shown_plainly_and_briefly():
    scan = Scan("lidar", np.arange(60.0).reshape(20, 3), [1, 2.123456789, None, True])
    assert plain_value(scan) == {
        "frame_id": "lidar",
        "points": "float64[20, 3] 0 … 59",
        "parts": [1, 2.123457, None, True],
    }
    assert plain_value(np.array([1, 2])) == [1, 2]
    assert plain_value(np.float32(2.5)) == 2.5
    assert plain_value(b"abc") == "3 bytes"
    assert plain_value(np.full(100, np.nan)) == "float64[100]"
    assert plain_value(np.array([np.inf, *range(20)])) == "float64[21] 0 … 19"
    assert plain_value(list(range(30)))[-1] == "… 30 in all"
    assert plain_value({n: n for n in range(30)})["…"] == "30 in all"
    assert plain_value("x" * 1000).endswith("… (1000 characters)")


class Supervisor:
    """As much of one as a listener asks."""

    ended = False

    def ask(self, request, **arguments):
        self.ended = request == "export"  # gone right afterwards
        return {"topics": []}


def test_who_listens_is_told_that_the_node_has_ended(run_base):
    with pytest.raises(WarploomError, match="node 'gone' has ended"):
        next(listen(Supervisor(), "gone", "ticks", "listener"))


def test_what_holds_itself_is_shown_to_a_depth():
    endless = []
    endless.append(endless)
    assert "list" in str(plain_value(endless))


def test_the_rate_and_its_evenness():
    meter = RateMeter()
    assert meter.figures() == {"count": 0}
    for now in (0.0, 0.1, 0.2, 0.4):
        meter.add(now)
    figures = meter.figures(0.5)
    assert figures["hz"] == pytest.approx(7.5)
    assert (figures["min_ms"], figures["max_ms"], figures["count"]) == (100.0, 200.0, 4)
    assert figures["std_ms"] == pytest.approx(np.std([100, 100, 200]), abs=1e-3)


def test_the_rate_is_of_the_last_commits():
    meter = RateMeter(window=2)
    for now in (0.0, 100.0, 100.1, 100.2):
        meter.add(now)
    assert meter.figures(100.3)["hz"] == pytest.approx(10.0)


def test_a_topic_that_has_fallen_silent_has_no_rate():
    meter = RateMeter()
    for now in (0.0, 0.1, 0.2, 0.4):
        meter.add(now)
    assert meter.figures(1.3)["hz"] == pytest.approx(7.5)
    assert meter.figures(1.5) == {"count": 4, "hz": 0.0, "silent_s": 1.1}
    meter.add(1.6)
    assert meter.figures(2.7)["hz"] == pytest.approx(2.5), "it comes as seldom as that"


def test_what_is_not_finite_is_shown_as_json_has_it():
    shown = plain_value({"a": float("inf"), "b": np.array([1.0, np.nan]), "c": np.float32("-inf")})
    assert shown == {"a": "inf", "b": [1.0, "nan"], "c": "-inf"}
