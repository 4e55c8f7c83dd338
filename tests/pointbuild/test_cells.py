"""Paths, windows and plans: against bits read one by one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import surfaces

from pointbuild.cells import BITS, Cells
from pointbuild.plan import Cell, Plan, make_plan
from pointbuild.progress import Silent
from pointbuild.upper import ALL, candidate_limits, share_out
from pointbuild.work import Crew

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray


def path(cells: Cells, fixed: NDArray[np.uint64]) -> list[int]:
    """All bits of one sample's path."""
    return [int(fixed[axis]) >> int(shift) & 1 for axis, shift in zip(cells.axes, cells.shifts, strict=True)]


def over(xyz: NDArray[np.float64]) -> Cells:
    return Cells.over(xyz.min(axis=0), xyz.max(axis=0))


def test_the_longest_side_is_halved() -> None:
    cells = Cells.over(np.zeros(3), np.array([8.0, 3.0, 1.0]))
    assert cells.axes[:7].tolist() == [0, 0, 1, 0, 1, 0, 2]  # 8 3 1, 4 3 1, 2 3 1, 2 1.5 1, 1 1.5 1, 1 .75 1, .5 .75 1
    assert cells.depths == 3 * BITS
    assert Cells.over(np.zeros(3), np.array([1.0, 0.0, 0.0])).depths == BITS
    assert Cells.over(np.zeros(3), np.zeros(3)).depths == 0


def test_midpoints_belong_to_the_upper_half() -> None:
    xyz = np.array([[10.0, 0, 0], [10.1, 0, 0], [10.15, 0, 0], [10.3, 0, 0], [10.6, 0, 0]])
    xyz[2, 0] = 10.0 + (xyz[4, 0] - 10.0) / 4
    xyz[3, 0] = 10.0 + (xyz[4, 0] - 10.0) / 2
    cells = over(xyz)
    assert cells.fixed(xyz)[:, 0].tolist()[2:] == [2**46, 2**47, 2**48 - 1]


@settings(max_examples=60)
@given(
    extent=st.tuples(*[st.sampled_from([0.0, 1.0, 1e-3, 3.7, 1e9])] * 3),
    start=st.integers(0, 100),
    bits=st.integers(1, 63),
    seed=st.integers(0, 1000),
)
def test_windows_are_runs_of_path_bits(extent: tuple[float, float, float], start: int, bits: int, seed: int) -> None:
    xyz = np.random.default_rng(seed).random((20, 3)) * extent
    cells = over(xyz)
    start = min(start, cells.depths)
    window = cells.window(start, bits)
    assert window.bits == min(bits, cells.depths - start)
    expected = []
    for fixed in cells.fixed(xyz):
        run = path(cells, fixed)[start : start + bits]
        expected.append(int("0" + "".join(map(str, run)), 2))
    assert cells.keys(xyz, window).tolist() == expected


def test_faces_are_those_of_the_cell_and_open_where_the_model_ends() -> None:
    xyz = np.random.default_rng(1).random((300, 3)) * [4.0, 2.0, 1.0]
    cells = over(xyz)
    fixed = cells.fixed(xyz)
    for depth in (0, 1, 5, 11):
        faces = cells.faces(fixed, np.full(300, depth))
        low, high = faces[:, :3], faces[:, 3:]
        assert ((low <= xyz) & (xyz <= high)).all()
        runs = [tuple(path(cells, sample)[:depth]) for sample in fixed]
        for i in range(0, 300, 37):
            inside = ((low[i] <= xyz) & (xyz < high[i])).all(axis=1)
            assert inside.tolist() == [run == runs[i] for run in runs]


def plan_of(xyz: NDArray[np.float64], most: int) -> tuple[Cells, Plan]:
    cells = over(xyz)
    with Crew(1) as crew:
        halves = np.array_split(xyz, 3)
        return cells, make_plan(cells, len(xyz), most, halves.__getitem__, 3, crew, Silent())


def all_cells(cell: Cell) -> Iterator[Cell]:
    yield cell
    for child in cell.children:
        if child is not None:
            yield from all_cells(child)


CLUMP = np.concatenate([surfaces.sphere(3000, seed=2).xyz * 1e-6, surfaces.sphere(500, seed=3).xyz * 1e5])


@pytest.mark.parametrize("xyz", [surfaces.bumpy(4000).xyz, CLUMP])
@pytest.mark.parametrize("most", [50, 700])
def test_buckets_are_the_largest_cells_that_fit(xyz: NDArray[np.float64], most: int) -> None:
    cells, plan = plan_of(xyz, most)
    bucket = plan.locate(cells, xyz)
    assert np.bincount(bucket, minlength=len(plan.buckets)).tolist() == [entry.count for entry in plan.buckets]
    assert max(entry.count for entry in plan.buckets) <= most
    fixed = cells.fixed(xyz)
    paths = {}
    for number, entry in enumerate(plan.buckets):
        runs = {tuple(path(cells, sample)[: entry.depth]) for sample in fixed[bucket == number]}
        assert len(runs) == 1
        paths[number] = runs.pop()
    assert list(paths.values()) == sorted(paths.values())
    for cell in all_cells(plan.root):
        begin, end = cell.buckets
        assert cell.count == sum(entry.count for entry in plan.buckets[begin:end])
        assert cell.is_bucket == (cell.count <= most)


def test_a_pile_is_one_bucket_however_large() -> None:
    xyz = np.concatenate([np.full((900, 3), 0.3), np.random.default_rng(4).random((600, 3))])
    _, plan = plan_of(xyz, 200)
    piles = [entry for entry in plan.buckets if entry.coincident]
    assert [pile.count for pile in piles] == [900]


def test_too_few_candidates_are_noticed_and_more_give_the_same_shares() -> None:
    from pointbuild.priority import priorities
    from pointbuild.scatter import Candidates

    xyz = surfaces.torus(20_000, seed=5).xyz
    cells, plan = plan_of(xyz, 1500)
    bucket, priority = plan.locate(cells, xyz), priorities(xyz.view(np.uint64), 3)

    def found(slack: float) -> list[list[int]] | None:
        limits = candidate_limits(plan, 100, slack)
        chosen = priority <= limits[bucket]
        upper = share_out(plan, Candidates(priority[chosen], bucket[chosen]), limits, 100)
        return None if upper is None else upper.shares

    assert found(0.0) is None
    assert found(8.0) is not None
    assert found(8.0) == found(32.0) == found(1e9)


def test_an_upper_node_may_take_all_that_is_left() -> None:
    """With buckets smaller than clouds the upper tree has leaves, and buckets below them are empty."""
    from pointbuild.priority import priorities
    from pointbuild.scatter import Candidates

    xyz = surfaces.torus(900, seed=6).xyz
    cells, plan = plan_of(xyz, 30)
    bucket, priority = plan.locate(cells, xyz), priorities(xyz.view(np.uint64), 0)
    limits = np.full(len(plan.buckets), ALL)
    upper = share_out(plan, Candidates(priority, bucket), limits, 400)
    assert upper is not None
    assert sum(node.samples for node in upper.nodes) == 900
    assert [sum(shares) for shares in upper.shares] == [entry.count for entry in plan.buckets]
