from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import levels_of, random_records

from lpc.page import child_counts
from lpc.spacing import level_bounds, spacings


def parents(records: np.ndarray) -> np.ndarray:
    return np.concatenate([[-1], np.repeat(np.arange(len(records)), child_counts(records))])


def test_the_root_is_thinned_by_its_share() -> None:
    assert spacings([400], [100], np.array([-1]), 1.5) == pytest.approx([3.0])
    assert spacings([7], [7], np.array([-1]), 1.5) == pytest.approx([1.5])


def test_even_halving_has_the_ratios_of_the_equations() -> None:
    # 2^20 - 1 clouds of M samples in a full tree. By (1), M_tot is M, 1.5 M, 1.75 M, ...; by (2) the ratios are
    # sqrt(1/3), sqrt(3/7), sqrt(7/15), ... towards sqrt(1/2).
    M, levels = 1000, 20
    subtree = np.array([M * (2 ** (levels - depth) - 1) for depth in range(levels)])
    r = spacings(subtree, np.full(levels, M), np.arange(levels) - 1, 1.0)  # one path down is enough
    ratio = r[1:] / r[:-1]
    assert ratio[:3] == pytest.approx([math.sqrt(1 / 3), math.sqrt(3 / 7), math.sqrt(7 / 15)])
    assert ratio[:2] == pytest.approx([0.577, 0.655], abs=5e-4)
    assert ratio[-1] == pytest.approx(0.7071, abs=1e-4)
    assert r[0] == pytest.approx(math.sqrt(2**levels - 1))


def test_uneven_children_by_hand() -> None:
    # Root: N 1000, M 100, r_0 = 2 sqrt(10). Children get 600 and 300 of the other 900.
    # (1) 600/900 * 100 + 150 = 216.67; 300/900 * 100 + 50 = 83.33
    # (2) r_0 sqrt(600 * 100 / (900 * 216.67)) = r_0 * 0.5547; r_0 sqrt(300 * 100 / (900 * 83.33)) = r_0 * 0.63246
    r = spacings([1000, 600, 300], [100, 150, 50], np.array([-1, 0, 0]), 2.0)
    assert r == pytest.approx([6.324555, 6.324555 * 0.554700, 6.324555 * 0.632456], rel=1e-5)


@given(st.lists(st.sampled_from([0, 1, 2, 3, 3]), max_size=60), st.integers(0, 2**32 - 1))
def test_every_tree_follows_the_equations_node_by_node(shape: list[int], seed: int) -> None:
    records = random_records(shape, np.random.default_rng(seed))
    N, M, parent = records["subtree"].astype(int), records["samples"].astype(int), parents(records)
    total, expected = {0: float(M[0])}, {0: 0.1 * math.sqrt(N[0] / M[0])}
    for j in range(1, len(records)):
        p = int(parent[j])
        total[j] = N[j] / (N[p] - M[p]) * total[p] + M[j]
        expected[j] = expected[p] * math.sqrt(N[j] * total[p] / ((N[p] - M[p]) * total[j]))
    r = spacings(N, M, parent, 0.1)
    assert r == pytest.approx([expected[j] for j in range(len(records))], rel=1e-12)
    assert (r[1:] < r[parent[1:]]).all()  # a child always refines
    bounds = level_bounds(parent)
    assert np.repeat(np.arange(len(bounds) - 1), np.diff(bounds)).tolist() == levels_of(records)


@pytest.mark.parametrize("parent", [[], [0], [-1, -1], [-1, 1], [-1, 0, 1, 0], [-1, 2, 0]])
def test_an_order_that_is_not_breadth_first_is_refused(parent: list[int]) -> None:
    with pytest.raises(ValueError, match=r"root|breadth-first"):
        level_bounds(np.array(parent, dtype=np.int64))
