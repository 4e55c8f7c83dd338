"""Slots: what is drawn now is never evicted, the oldest goes first, and the books agree with a plain dictionary."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pointview.render.arena import Arena

NODES = 20


def place(arena: Arena, nodes: list[int]) -> list[int]:
    absent, slots = arena.place(np.array(nodes, dtype=np.int64))
    assert len(absent) == len(slots) == len(set(slots.tolist()))
    assert arena.slots_of(absent).tolist() == slots.tolist()
    return absent.tolist()


def test_the_least_recently_drawn_goes_first():
    arena = Arena(NODES, 3)
    assert place(arena, [0, 1]) == [0, 1]
    assert place(arena, [1, 2]) == [2]
    assert place(arena, [0]) == []
    assert place(arena, [5]) == [5]  # of 0, 1 and 2, node 1 and 2 were drawn before 0
    assert (arena.slots_of(np.array([0, 5])) >= 0).all()
    assert (arena.slots_of(np.array([1, 2])) >= 0).sum() == 1


@given(st.integers(1, 6), st.lists(st.sets(st.integers(0, NODES - 1), max_size=6), max_size=12))
def test_agrees_with_a_dictionary(slots, draws):
    arena = Arena(NODES, slots)
    last_drawn: dict[int, int] = {}
    for number, wanted in enumerate(draws):
        nodes = sorted(wanted)
        if len(nodes) > slots:
            with pytest.raises(ValueError, match="do not fit"):
                place(arena, nodes)
            continue
        absent = place(arena, nodes)
        assert absent == [node for node in nodes if node not in last_drawn]
        last_drawn.update(dict.fromkeys(nodes, number))
        here = {node for node in range(NODES) if arena.slots_of(np.array([node]))[0] >= 0}
        gone = set(last_drawn) - here
        assert here <= set(last_drawn)
        assert here >= wanted
        assert len(here) == min(slots, len(last_drawn))
        assert all(last_drawn[out] <= last_drawn[node] for out in gone for node in here)
        for node in gone:
            del last_drawn[node]
        taken = arena.slots_of(np.array(sorted(here), dtype=np.int64))
        assert len(set(taken.tolist())) == len(taken)


def test_growing_keeps_what_is_here():
    arena = Arena(NODES, 2)
    place(arena, [3, 4])
    before = arena.slots_of(np.array([3, 4])).tolist()
    arena.grow(4)
    assert place(arena, [3, 4, 5, 6]) == [5, 6]
    assert arena.slots_of(np.array([3, 4])).tolist() == before


def test_what_could_not_be_filled_is_asked_again():
    arena = Arena(NODES, 4)
    place(arena, [1, 2, 3])
    arena.forget(np.array([2, 3]))
    assert place(arena, [1, 2, 3]) == [2, 3]
