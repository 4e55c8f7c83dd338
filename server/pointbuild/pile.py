"""A bucket of samples at one place, however many: no path tells them apart, so none is sorted in memory with all.

Their tree is a chain of nodes that takes them by priority. So a pile is sorted by priority, in slices of priorities
that fit into memory, and its clouds are cut off one after another. The result is that of `bucket.partition`. Equal
samples have equal priorities, and there may be more of them than fit: these are only counted.
"""

from __future__ import annotations

import os
from collections import Counter
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from lpc.errors import BuildError
from lpc.header_checks import MAX_LEVELS
from lpc.page import COINCIDENT

from .areas import Probing, pile_spacing
from .bucket import BucketTree, Clouds, summarise
from .priority import COPY
from .rows import positions, priorities_of
from .spool import read_all, write_all
from .tree import TOO_MANY, Tree

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from .cells import Cells
    from .plan import Bucket
    from .rows import Rows

SLICE_BITS = 16
"""Priorities with the same first bits stay in one slice; hashes, they are few, or they are equal."""

CHUNK = 1 << 14
"""Rows looked at together where a few arrays of them are made."""


def check_piles(buckets: Sequence[Bucket]) -> None:
    """Raise BuildError if more samples coincide than a chain of nodes can hold."""
    if any(bucket.coincident and bucket.count > COINCIDENT * MAX_LEVELS for bucket in buckets):
        raise BuildError(TOO_MANY)


def partition_pile(
    first_row: int,
    bucket: Bucket,
    above: list[int],
    shares: list[int],
    *,
    most: int,
    cells: Cells,
    probing: Probing,
    cloud_size: int,
    seed: int,
    regions: Rows,
    normal_bits: int,
) -> BucketTree:
    """Sort a pile's rows by node, on disk.

    Parameters
    ----------
    most : int
        Rows to hold in memory.
    first_row, bucket, above, shares, cells, probing, cloud_size, seed, regions, normal_bits
        As for `bucket.partition`.

    Raises
    ------
    BuildError
        If more samples coincide than a chain of nodes can hold.
    """
    taken = np.array(shares, np.int64)
    _sort_by_priority(first_row, bucket.count, most, seed, regions)
    ordered = regions.replaced()
    left = bucket.count - int(taken.sum())
    first = cells.fixed(positions(next(regions.chunks(first_row, 1, 1))))
    tree = _chain(bucket, left, cloud_size, cells, first[0])
    counts = np.concatenate([taken, tree.samples])
    clouds, at = [], first_row
    for count in counts.tolist():
        rows = np.empty(count, regions.dtype)
        ordered.read(at, rows)
        part = summarise(rows, np.zeros(1, np.int64), np.array([count]), normal_bits)
        part.first[:] += at
        clouds.append(part.arrays())
        at += count
    whole = Clouds(*(np.concatenate(parts) for parts in zip(*clouds, strict=True)))
    used = np.flatnonzero(taken)
    (face,) = cells.faces(first, np.array([bucket.depth]))
    asked = next(ordered.chunks(first_row, min(bucket.count, probing.region), probing.region))
    priority = priorities_of(asked, seed)
    spacing = pile_spacing(positions(asked), priority, face, probing, bucket.count)
    measured = [spacing] if spacing > 0 else []
    area = spacing**2 * bucket.count
    return BucketTree(
        tree=tree,
        clouds=whole.part(slice(len(taken), None)),
        upper=np.array(above, np.int64)[used],
        fragments=whole.part(used),
        area=np.full(len(tree), area * bucket.count / bucket.count),
        cell_area=area,
        spacing=np.array(measured),
        weight=np.full(len(measured), bucket.count),
    )


def _sort_by_priority(first_row: int, count: int, most: int, seed: int, regions: Rows) -> None:
    """Sort the rows, about `most` at a time, and let copies come last."""
    shift = np.uint64(64 - SLICE_BITS)
    histogram = np.zeros(1 << SLICE_BITS, np.int64)
    for rows in regions.chunks(first_row, count, CHUNK):
        histogram += np.bincount((priorities_of(rows, seed) >> shift).astype(np.int64), minlength=len(histogram))
    slice_of = np.maximum(np.cumsum(histogram) - 1, 0) // most
    sizes = np.bincount(slice_of, histogram).astype(np.int64)
    starts = np.cumsum(sizes) - sizes
    heavy = sizes > 2 * most
    size = regions.dtype.itemsize

    def parts(wanted: NDArray[np.bool_]) -> Iterator[tuple[int, NDArray[Any]]]:
        for rows in regions.chunks(first_row, count, CHUNK):
            number = slice_of[(priorities_of(rows, seed) >> shift).astype(np.int64)]
            for each in np.unique(number[wanted[number]]).tolist():
                yield each, rows[number == each]

    with regions.rewriting(first_row) as file:
        filled = count + starts  # behind the place of the rows, which copies are still among
        for each, part in parts(~heavy):
            write_all(file, part, int(filled[each]) * size)
            filled[each] += len(part)
        for start, length in zip((count + starts[~heavy]).tolist(), sizes[~heavy].tolist(), strict=True):
            rows = np.empty(length, regions.dtype)
            read_all(file, rows, start * size)
            write_all(file, rows[np.argsort(priorities_of(rows, seed))], start * size)
        for each in np.flatnonzero(heavy).tolist():
            _place_equals(partial(parts, np.arange(len(heavy)) == each), count + int(starts[each]), seed, file, size)
        _split_copies(count, seed, file, regions.dtype)
        os.truncate(file, count * size)


def _place_equals(
    parts: Callable[[], Iterator[tuple[int, NDArray[Any]]]], start: int, seed: int, file: int, size: int
) -> None:
    """Write rows in order from row `start` on: many rows, but of few priorities, since most are equal."""
    counts: Counter[int] = Counter()
    for _, part in parts():
        values, times = np.unique(priorities_of(part, seed), return_counts=True)
        counts.update(dict(zip(values.tolist(), times.tolist(), strict=True)))
    place = {}
    for value in sorted(counts):
        place[value] = start
        start += counts[value]
    for _, part in parts():
        priority = priorities_of(part, seed)
        order = np.argsort(priority)
        values, first = np.unique(priority[order], return_index=True)
        for value, run in zip(values.tolist(), np.split(part[order], first[1:]), strict=True):
            write_all(file, run, place[value] * size)
            place[value] += len(run)


def _split_copies(count: int, seed: int, file: int, dtype: np.dtype[Any]) -> None:
    """Move `count` sorted rows from row `count` on to the start, first those that are no copies."""

    def parts() -> Iterator[tuple[NDArray[Any], NDArray[np.bool_]]]:
        last = COPY  # no row has it
        for at in range(count, 2 * count, CHUNK):
            rows = np.empty(min(CHUNK, 2 * count - at), dtype)
            read_all(file, rows, at * dtype.itemsize)
            priority = priorities_of(rows, seed)
            yield rows, priority == np.append(last, priority[:-1])
            last = priority[-1]

    places = [0, sum(int((~copy).sum()) for _, copy in parts())]
    for rows, copy in parts():
        for kind, which in enumerate((~copy, copy)):
            chosen = rows[which]  # as they are: a build that was killed may sort them again
            write_all(file, chosen, places[kind] * dtype.itemsize)
            places[kind] += len(chosen)


def _chain(bucket: Bucket, left: int, cloud_size: int, cells: Cells, fixed: NDArray[np.uint64]) -> Tree:
    """Nodes for `left` samples, one below the other."""
    full = max(cloud_size, COINCIDENT)
    nodes = -(-left // full)
    if bucket.depth + nodes > MAX_LEVELS:
        raise BuildError(TOO_MANY)
    depth = bucket.depth + np.arange(nodes)
    half = np.zeros(nodes, np.int64)
    for node in range(1, nodes):
        split = bucket.depth + node - 1
        if split < cells.depths:
            half[node] = int(fixed[cells.axes[split]] >> np.uint64(cells.shifts[split])) & 1
    subtree = left - full * np.arange(nodes)
    return Tree(
        parent=np.arange(nodes) - 1,
        half=half,
        depth=depth,
        low=np.zeros(nodes, np.int64),
        high=np.full(nodes, bucket.count),
        subtree=subtree,
        samples=np.minimum(subtree, full),
    )
