"""Pass 1: how many samples each cell holds, and which cells become buckets.

A *bucket* is a cell of few enough samples to be sorted in memory. The cells above are the *upper tree*. Cells are
counted by a table over the first path bits; a table's entry that holds too many samples gets a table of its own for
the next bits, in another sweep over the spool, until every entry is small or its samples are all at one place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from .cells import Cells, Window
    from .journal import Journal
    from .progress import Progress
    from .work import Crew

TABLE_BITS = 18
TABLE_ENTRIES = 1 << 19  # of all tables of one sweep together; every thread counts into its own

Positions = Callable[[int], NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class Table:
    """Tables of one sweep: entry [t, key] of table t is a bucket, or ``-1 - t'`` for table t' of the next sweep."""

    window: Window
    entries: NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Cell:
    """A cell of the upper tree, or the cell of a bucket.

    Parameters
    ----------
    depth, count : int
        How often the root was halved, and how many samples the cell holds.
    buckets : (int, int)
        First bucket in the cell, and one past the last.
    children : tuple of two Cells or None
        Lower and upper half, None where empty. Both None: the cell is a bucket.
    """

    depth: int
    count: int
    buckets: tuple[int, int]
    children: tuple[Cell | None, Cell | None] = (None, None)

    @property
    def is_bucket(self) -> bool:
        """Its samples are sorted in memory together."""
        return self.children == (None, None)


@dataclass(frozen=True, slots=True)
class Bucket:
    """A cell whose samples are sorted in memory together.

    `coincident`: they are all at one place, so there may be more of them than a bucket usually has.
    """

    depth: int
    count: int
    coincident: bool = False


@dataclass(frozen=True, slots=True)
class Plan:
    """The upper tree, and its buckets in the order of their paths."""

    root: Cell
    buckets: list[Bucket]
    tables: list[Table] = field(repr=False)

    def locate(self, cells: Cells, xyz: NDArray[np.float64]) -> NDArray[np.int32]:
        """Bucket of each position."""
        if len(self.buckets) == 1:
            return np.zeros(len(xyz), np.int32)
        return _descend(cells, self.tables, xyz)


def make_plan(
    cells: Cells,
    samples: int,
    most: int,
    positions: Positions,
    blocks: int,
    crew: Crew,
    progress: Progress,
    journal: Journal | None = None,
) -> Plan:
    """Count the samples of cells and choose the buckets.

    Parameters
    ----------
    cells : Cells
    samples : int
        In all.
    most : int
        Samples of a bucket.
    positions : callable
        Gives the positions (n, 3) of one of `blocks` blocks by its number; each block is asked for once a sweep.
    crew, progress
        Threads, and who is told; each sweep counts as all samples.
    journal : Journal, optional
        Of sweeps; those that it knows are not made again.
    """
    if samples <= most or not cells.depths:
        return Plan(Cell(0, samples, (0, 1)), [Bucket(0, samples, coincident=not cells.depths)], [])
    tables: list[Table] = []
    sums: list[NDArray[np.int64]] = []
    waiting, start = 1, 0
    known = iter(journal or ())
    while waiting:
        window = cells.window(start, min(TABLE_BITS, max((TABLE_ENTRIES // waiting).bit_length() - 1, 1)))

        def count(number: int, window: Window = window, waiting: int = waiting) -> tuple[int, NDArray[np.int32]]:
            xyz = positions(number)
            counts = np.zeros((waiting, 1 << window.bits), np.int32)  # half the room in the processor's caches
            cells.count(xyz, window, _descend(cells, tables, xyz), counts)
            return len(xyz), counts

        recalled = next(known, None)
        if recalled is None:
            counts = np.zeros((waiting, 1 << window.bits), np.int64)
            for _, (done, part) in crew.map(count, range(blocks)):
                counts += part
                progress.advance(done)
            if journal is not None:
                journal.add(counts)
        else:
            (counts,) = recalled
            progress.advance(samples)
        start += window.bits
        entries = np.zeros(counts.shape, np.int32)
        crowded = (counts > most) & (start < cells.depths)
        waiting = int(crowded.sum())
        entries[crowded] = -1 - np.arange(waiting, dtype=np.int32)
        tables.append(Table(window, entries))
        sums.append(np.concatenate([np.zeros((len(counts), 1), np.int64), np.cumsum(counts, axis=1)], axis=1))
    planner = _Planner(most, tables, sums, [])
    root = planner.cell(0, 0, 0, 0)
    assert root is not None
    return Plan(root, planner.buckets, tables)


def _descend(cells: Cells, tables: list[Table], xyz: NDArray[np.float64]) -> NDArray[np.int32]:
    """Entry in which each position ends up: a bucket, or a table that has no entries yet."""
    cell = np.full(len(xyz), -1, np.int32)
    for table in tables:
        cells.descend(xyz, table.window, table.entries, cell)
    return cell


@dataclass(frozen=True, slots=True)
class _Planner:
    """Descends the counts from the root, and writes the buckets that it meets into the tables' entries."""

    most: int
    tables: list[Table]
    sums: list[NDArray[np.int64]]
    buckets: list[Bucket]

    def cell(self, level: int, table: int, depth: int, first: int) -> Cell | None:
        """Cell at `depth` whose entries in a table begin with `first`; None if it is empty."""
        window, entries = self.tables[level].window, self.tables[level].entries[table]
        width = 1 << (window.start + window.bits - depth)
        count = int(self.sums[level][table, first + width] - self.sums[level][table, first])
        if count == 0:
            return None
        here = len(self.buckets)
        if count > self.most and width > 1:
            low = self.cell(level, table, depth + 1, first)
            high = self.cell(level, table, depth + 1, first + width // 2)
            only = low if high is None else high
            if (low is None or high is None) and only is not None and only.is_bucket:
                # More samples than a bucket holds, all at one place: so are those of the larger cell, the same ones.
                self.buckets[here] = replace(self.buckets[here], depth=depth)
                return Cell(depth, count, (here, here + 1))
            return Cell(depth, count, (here, len(self.buckets)), (low, high))
        if count > self.most and entries[first] < 0:
            return self.cell(level + 1, -1 - int(entries[first]), depth, 0)
        entries[first : first + width] = here
        self.buckets.append(Bucket(depth, count, coincident=count > self.most))
        return Cell(depth, count, (here, here + 1))
