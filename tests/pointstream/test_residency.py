"""Residency against an obvious list, and what must hold after every step."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pointstream.residency import Residency

NODES = 12
steps = st.lists(
    st.one_of(
        st.tuples(st.just("add"), st.integers(0, NODES - 1), st.integers(1, 40)),
        st.tuples(st.just("ahead"), st.integers(0, NODES - 1), st.integers(1, 40)),
        st.tuples(st.just("pin"), st.sets(st.integers(0, NODES - 1), max_size=5), st.just(0)),
    ),
    max_size=60,
)


class Obvious:
    """Never drawn first, then least recently touched, deepest first among equals, down to the low-water mark."""

    def __init__(self, capacity: int, slack: int) -> None:
        self.capacity, self.low = capacity, capacity - capacity // slack
        self.size: dict[int, int] = {}
        self.touched: dict[int, tuple[bool, int]] = {}
        self.pinned: set[int] = set()
        self.tick = 0

    def evict(self, newest: int) -> list[int]:
        gone = []
        if sum(self.size.values()) > self.capacity:
            for node in sorted(self.size, key=lambda node: (self.touched[node], -node)):
                if node in self.pinned or node == newest:
                    continue
                gone.append(node)
                del self.size[node]
                if sum(self.size.values()) <= self.low:
                    break
        return gone

    def add(self, node: int, size: int) -> list[int]:
        self.tick += 1
        self.size[node], self.touched[node] = size, (True, self.tick)
        return self.evict(node)

    def ahead(self, node: int, size: int) -> list[int]:
        if sum(self.size.values()) + size > self.capacity:
            return [node]
        self.tick += 1
        self.size[node], self.touched[node] = size, (False, self.tick)
        return []

    def pin(self, nodes: set[int]) -> list[int]:
        self.tick += 1
        self.pinned = nodes
        self.touched.update(dict.fromkeys(nodes, (True, self.tick)))
        return self.evict(-1)


@given(steps, st.integers(0, 200), st.sampled_from([1, 4, 16]))
def test_same_as_the_obvious_one(steps: list[tuple[str, object, int]], capacity: int, slack: int) -> None:
    residency, obvious = Residency(NODES, capacity, slack=slack), Obvious(capacity, slack)
    for kind, what, size in steps:
        if kind == "add":
            assert isinstance(what, int)
            assert residency.add(what, size) == obvious.add(what, size)
            assert residency.resident[what]
        elif kind == "ahead":
            assert isinstance(what, int)
            if not residency.resident[what]:
                drawn = residency.resident.copy()
                assert residency.add(what, size, ahead=True) == obvious.ahead(what, size)
                assert (residency.resident >= drawn).all(), "something went for what nobody wants yet"
        else:
            assert isinstance(what, set)
            nodes = np.array(sorted(node for node in what if residency.resident[node]), dtype=np.int64)
            before = residency.resident[nodes].copy()
            assert residency.pin(nodes) == obvious.pin(set(nodes.tolist()))
            assert (residency.resident[nodes] == before).all(), "a pinned cloud was dropped"
        assert set(np.flatnonzero(residency.resident).tolist()) == set(obvious.size)
        assert residency.bytes == sum(obvious.size.values())
        assert residency.over == max(0, residency.bytes - capacity)


def test_a_cut_above_the_capacity_stays_and_is_reported() -> None:
    residency = Residency(10, 100)
    for node in range(10):
        residency.add(node, 30)
        residency.pin(np.arange(node + 1))
    assert residency.resident.all()
    assert residency.over == 200
    assert residency.full
    dropped = residency.pin(np.array([0, 1]))
    assert dropped == [9, 8, 7, 6, 5, 4, 3]
    assert not residency.full


def test_parents_outlive_their_children() -> None:
    residency = Residency(7, 70, slack=100)
    for node in range(7):
        residency.add(node, 10)
    residency.pin(np.arange(7))
    residency.pin(np.array([0]))
    assert residency.add(0, 11) == [6]


def test_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match="capacity"):
        Residency(3, -1)
