from hypothesis import given
from hypothesis import strategies as st

from warploom.dag.launch.order import consumers_first


def test_a_row_starts_from_its_end():
    exports = {"source": {"a"}, "middle": {"b"}, "sink": set()}
    imports = {"source": set(), "middle": {"a"}, "sink": {"b"}}
    assert consumers_first(exports, imports) == ["sink", "middle", "source"]


def test_a_cycle_has_an_order_too():
    assert sorted(consumers_first({"a": {"x"}, "b": {"y"}}, {"a": {"y"}, "b": {"x"}})) == ["a", "b"]
    assert consumers_first({}, {}) == []


@given(st.lists(st.tuples(st.integers(0, 7), st.integers(0, 7)), max_size=20))
def test_without_a_cycle_every_consumer_is_before_its_producers(pairs):
    names = [str(n) for n in range(8)]
    edges = {(str(a), str(b)) for a, b in pairs if a < b}
    exports = {n: {f"{a}{b}" for a, b in edges if a == n} for n in names}
    imports = {n: {f"{a}{b}" for a, b in edges if b == n} for n in names}
    order = consumers_first(exports, imports)
    assert sorted(order) == names
    assert all(order.index(b) < order.index(a) for a, b in edges)
