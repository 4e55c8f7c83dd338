"""The small pure parts: ranges that fill up, what is wanted, when to ask a host again."""

from __future__ import annotations

import random
from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pointstream.arrivals import Assembly
from pointstream.offers import Item
from pointstream.recovery import Recovery, RecoveryOptions
from pointstream.wanted import Wanted

FILE = random.Random(1).randbytes(2000)


@given(
    st.lists(st.integers(0, 1000), min_size=2, max_size=12, unique=True),
    st.lists(st.tuples(st.integers(1, 300), st.booleans()), max_size=30),
)
def test_each_object_comes_once_and_whole(cuts: list[int], pieces: list[tuple[int, bool]]) -> None:
    """A piece may start the range again; bytes from before that never make an object complete."""
    cuts = sorted(cuts)
    start = 100
    items = [Item(key, start + a, start + b) for key, (a, b) in enumerate(pairwise(cuts))]
    assembly, offset, here, got = Assembly(start, items[::2]), start, 0, []
    assembly.expect(items[1::2])
    for size, again in pieces:
        offset = start if again else offset
        here += assembly.feed(offset, FILE[offset : offset + size])
        offset = min(offset + size, len(FILE))
        assert here == offset - start
        for item, data in assembly.complete():
            assert item.stop <= offset
            assert data == FILE[item.start : item.stop]
            got.append(item.key)
    assert len(got) == len(set(got))
    list(assembly.complete())
    assembly.feed(offset, FILE[offset : start + 1000])
    got += [item.key for item, _ in assembly.complete()]
    assert sorted(got) == list(range(len(items)))


def test_wanted_time_counts_while_anything_is_missing() -> None:
    wanted = Wanted(10.0)
    assert wanted.anything
    wanted.begin(8)
    wanted.frame(12.0, np.array([3]), np.array([1, 2]))
    for now, key in ((13.0, 1), (14.0, 1), (15.0, ~3), (16.0, 7)):
        wanted.came(now, key)
        assert wanted.anything
    wanted.came(17.0, 2)
    assert not wanted.anything
    assert wanted.seconds(100.0) == 7.0
    wanted.frame(100.0, np.empty(0, dtype=np.int64), np.array([5]))
    assert wanted.seconds(101.0) == 8.0
    wanted.frame(102.0, np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64))
    assert wanted.seconds(200.0) == 9.0


def test_pauses_double_and_end() -> None:
    recovery, now, pauses = Recovery(RecoveryOptions()), 0.0, []
    for _ in range(7):
        recovery.failed(now)
        recovery.failed(now)  # all requests in flight fail together: one failure
        start = now
        while recovery.paused(now):
            now += 0.5
        pauses.append(now - start)
    assert pauses == [1, 2, 4, 8, 10, 10, 10]
    recovery.answered()
    recovery.failed(now)
    assert not recovery.paused(now + 1.0)


def test_changes_are_followed_a_few_times_a_minute() -> None:
    recovery = Recovery(RecoveryOptions())
    assert [recovery.may_reload(float(now)) for now in (0, 1, 2, 3, 59)] == [True, True, True, False, False]
    assert recovery.may_reload(61.0)
