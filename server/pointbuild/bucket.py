"""One bucket in memory: sorted along the curve, measured, grown into a tree, and written back node by node."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from lpc.octahedral_compiled import unit_vectors

from .areas import Probing, measure
from .priority import defer_copies
from .rows import as_words, positions, priorities_of
from .tree import Tree, grow

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .cells import Cells
    from .plan import Bucket
    from .rows import Rows

INDEX_BITS = 22
MAX_BUCKET = 1 << INDEX_BITS
"""Samples of a bucket: a place in it and 42 path bits share a word while sorting."""

NORMAL_UNIT = 1 << 24
"""Normals are summed as whole multiples of 1 / NORMAL_UNIT, so that no sum depends on an order."""


@dataclass(frozen=True, slots=True)
class Clouds:
    """Runs of rows that belong together, and what the bounds of nodes are made from.

    Parameters
    ----------
    first, samples : ndarray, (n,) int64
        Rows of each run.
    box : ndarray, (n, 6) float64
        Low and high corner.
    normals : ndarray, (n, 3) int64
        Sum of the unit normals times `NORMAL_UNIT`.
    bare : ndarray, (n,) int64
        Samples without a normal.
    """

    first: NDArray[np.int64]
    samples: NDArray[np.int64]
    box: NDArray[np.float64]
    normals: NDArray[np.int64]
    bare: NDArray[np.int64]

    def part(self, which: slice | NDArray[np.int64]) -> Clouds:
        """Take some of the runs."""
        return Clouds(self.first[which], self.samples[which], self.box[which], self.normals[which], self.bare[which])

    def arrays(self) -> list[NDArray[Any]]:
        """Give what `Clouds` is called with."""
        return [self.first, self.samples, self.box, self.normals, self.bare]


@dataclass(frozen=True, slots=True)
class BucketTree:
    """What is kept of a bucket when its rows are back on disk.

    Parameters
    ----------
    tree : Tree
        Its own nodes.
    clouds : Clouds
        Of those nodes.
    upper : ndarray, (u,) int64
        Upper nodes that take samples of the bucket.
    fragments : Clouds
        What they take, in the same order.
    area : ndarray, (n,) float64
        Of the nodes' cells; nan if the whole bucket is too small to be measured.
    cell_area : float
        Of the bucket's cell.
    spacing, weight : ndarray
        Of the regions that were measured, and their samples.
    """

    tree: Tree
    clouds: Clouds
    upper: NDArray[np.int64]
    fragments: Clouds
    area: NDArray[np.float64]
    cell_area: float
    spacing: NDArray[np.float64]
    weight: NDArray[np.int64]

    def arrays(self) -> list[NDArray[Any]]:
        """Everything, for a journal."""
        cell = np.array(self.cell_area)
        rest = [self.upper, self.area, cell, self.spacing, self.weight]
        return [self.tree.table(), *self.clouds.arrays(), *self.fragments.arrays(), *rest]

    @classmethod
    def from_arrays(cls, arrays: list[NDArray[Any]]) -> BucketTree:
        """Inverse of `arrays`."""
        table, *rest = arrays
        upper, area, cell, spacing, weight = rest[10:]
        return cls(Tree(*table), Clouds(*rest[:5]), upper, Clouds(*rest[5:10]), area, float(cell), spacing, weight)


def partition(
    first_row: int,
    bucket: Bucket,
    above: list[int],
    shares: list[int],
    *,
    cells: Cells,
    probing: Probing,
    cloud_size: int,
    seed: int,
    regions: Rows,
    normal_bits: int,
) -> BucketTree:
    """Sort a bucket's rows by node and put them back; `Rows.settle` may be called once the result is safe.

    Parameters
    ----------
    first_row, bucket
        Which rows.
    above, shares : list of int
        Upper nodes from the root to the bucket, and how many samples each takes.
    cells, probing, cloud_size, seed
        How to divide and measure.
    regions : Rows
        Where they are.
    normal_bits : int
        Of their normals; 0: they have none.
    """
    rows = np.empty(bucket.count, regions.dtype)
    regions.read(first_row, rows)
    rows, scratch = sort_by_path(rows, cells, bucket)
    xyz = positions(rows)
    fixed = cells.fixed(xyz)
    priority = priorities_of(rows, seed)
    defer_copies(fixed, priority)
    areas = measure(cells, probing, fixed, xyz, priority, bucket.depth)
    del xyz
    taken, floor = _smallest(priority, sum(shares))
    tree, owner = grow(cells, fixed, priority, scratch, bucket.depth, taken, floor, cloud_size)
    del fixed
    group = owner + np.int32(len(above))
    group[taken] = np.repeat(np.arange(len(above), dtype=np.int32), shares)
    counts = np.bincount(group, minlength=len(above) + len(tree))
    ends = np.cumsum(counts)
    order = np.empty(len(rows), np.int32)
    _order(group, ends - counts, order)
    del owner, group, priority
    out = np.empty_like(rows)
    np.take(as_words(rows), order, axis=0, out=as_words(out), mode="clip")  # "raise" would copy once more
    clouds = summarise(out, ends - counts, counts, normal_bits)
    regions.replace(first_row, out)
    clouds.first[:] += first_row
    used = np.flatnonzero(counts[: len(above)])
    measured = np.flatnonzero(areas.region & (areas.spacing > 0))
    return BucketTree(
        tree=tree,
        clouds=clouds.part(slice(len(above), None)),
        upper=np.array(above, np.int64)[used],
        fragments=clouds.part(used),
        area=areas.of(tree.low, tree.high),
        cell_area=float(areas.area[0]),
        spacing=areas.spacing[measured],
        weight=(areas.high - areas.low)[measured],
    )


def _smallest(priority: NDArray[np.uint64], count: int) -> tuple[NDArray[np.int64], np.uint64]:
    """Find the samples of smallest priority, in its order, and the largest of theirs."""
    if not count:
        return np.empty(0, np.int64), np.uint64(0)
    limit = np.partition(priority, count - 1)[count - 1]
    found = np.flatnonzero(priority <= limit)
    return found[np.argsort(priority[found], kind="stable")][:count], limit


def sort_by_path(rows: NDArray[Any], cells: Cells, bucket: Bucket) -> tuple[NDArray[Any], NDArray[np.uint64]]:
    """Rows in the order of their paths, and a spare array of one word per row.

    Rows of equal paths come in any order.
    """
    window = cells.window(bucket.depth, 64 - INDEX_BITS)
    xyz = positions(rows)
    packed = cells.keys(xyz, window)
    _pack(packed)
    packed.sort()
    order = np.empty(len(rows), np.int32)
    if _unpack(packed, xyz, order):
        # 42 bits did not tell some apart: the rest of the path does. Rare, so a general sort will do.
        _sort_ties(packed, order, cells.fixed(xyz), cells.axes, cells.shifts, bucket.depth + window.bits)
    out = np.empty_like(rows)
    np.take(as_words(rows), order, axis=0, out=as_words(out), mode="clip")  # "raise" would copy once more
    return out, packed


@njit(cache=True, nogil=True)
def _pack(keys: Any) -> None:
    for i in range(len(keys)):
        keys[i] = keys[i] << np.uint64(22) | np.uint64(i)


@njit(cache=True, nogil=True)
def _unpack(packed: Any, xyz: Any, order: Any) -> Any:
    """Fill `order`; whether samples of different places share a key."""
    tied = False
    for i in range(len(packed)):
        order[i] = packed[i] & np.uint64(4194303)
        if i > 0 and packed[i] >> np.uint64(22) == packed[i - 1] >> np.uint64(22):
            a, b = order[i], order[i - 1]
            tied |= xyz[a, 0] != xyz[b, 0] or xyz[a, 1] != xyz[b, 1] or xyz[a, 2] != xyz[b, 2]
    return tied


@njit(cache=True, nogil=True)
def _sort_ties(packed: Any, order: Any, fixed: Any, axes: Any, shifts: Any, start: int) -> None:
    """Put runs of equal keys in the order of the path bits from `start` on: a binary radix exchange sort."""
    waiting = np.empty((300, 3), np.int64)
    begin = 0
    while begin < len(packed):
        end = begin + 1
        while end < len(packed) and packed[end] >> np.uint64(22) == packed[begin] >> np.uint64(22):
            end += 1
        stacked = 0
        if end > begin + 1:
            waiting[0] = (begin, end, start)
            stacked = 1
        while stacked:
            stacked -= 1
            low, high, depth = waiting[stacked]
            same = True
            while same and depth < len(axes):  # skip the bits that all share
                axis, shift = axes[depth], np.uint64(shifts[depth])
                bit = (fixed[order[low], axis] >> shift) & np.uint64(1)
                for i in range(low + 1, high):
                    if (fixed[order[i], axis] >> shift) & np.uint64(1) != bit:
                        same = False
                        break
                depth += same
            if same:
                continue
            i, j = low, high - 1
            while i <= j:
                if (fixed[order[i], axes[depth]] >> np.uint64(shifts[depth])) & np.uint64(1):
                    order[i], order[j] = order[j], order[i]
                    j -= 1
                else:
                    i += 1
            if i - low > 1:
                waiting[stacked] = (low, i, depth + 1)
                stacked += 1
            if high - i > 1:
                waiting[stacked] = (i, high, depth + 1)
                stacked += 1
        begin = end


@njit(cache=True, nogil=True)
def _order(group: Any, place: Any, order: Any) -> None:
    """Stable counting sort; `place` is where each group begins, and is used up."""
    for i in range(len(group)):
        order[place[group[i]]] = i
        place[group[i]] += 1


def summarise(rows: NDArray[Any], first: NDArray[np.int64], samples: NDArray[np.int64], normal_bits: int) -> Clouds:
    """Box and sum the normals of runs of rows."""
    box = np.empty((len(first), 6))
    sums, bare = np.zeros((len(first), 3), np.int64), np.zeros(len(first), np.int64)
    _boxes(positions(rows), first, samples, box)
    if normal_bits:
        _sum_normals(unit_vectors(rows["normal"], normal_bits), first, samples, sums, bare)
    return Clouds(first.copy(), samples, box, sums, bare)


@njit(cache=True, nogil=True)
def _boxes(xyz: Any, first: Any, samples: Any, box: Any) -> None:
    for cloud in range(len(first)):
        for axis in range(3):
            low, high = np.inf, -np.inf
            for i in range(first[cloud], first[cloud] + samples[cloud]):
                low, high = min(low, xyz[i, axis]), max(high, xyz[i, axis])
            box[cloud, axis], box[cloud, 3 + axis] = low, high


@njit(cache=True, nogil=True)
def _sum_normals(normals: Any, first: Any, samples: Any, sums: Any, bare: Any) -> None:
    for cloud in range(len(first)):
        x, y, z = np.int64(0), np.int64(0), np.int64(0)
        for i in range(first[cloud], first[cloud] + samples[cloud]):
            a, b, c = np.float64(normals[i, 0]), np.float64(normals[i, 1]), np.float64(normals[i, 2])
            x += np.int64(np.rint(a * NORMAL_UNIT))
            y += np.int64(np.rint(b * NORMAL_UNIT))
            z += np.int64(np.rint(c * NORMAL_UNIT))
            bare[cloud] += a == 0.0 and b == 0.0 and c == 0.0
        sums[cloud, 0], sums[cloud, 1], sums[cloud, 2] = x, y, z
